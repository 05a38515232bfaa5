"""Report section of example clips, frame by frame: errors, latents as colours, and an animation of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from vjepa2_ac.data.windows import spread_with_ends
from vjepa2_ac.evaluation.result import Evaluation, Example
from vjepa2_ac.reports.html.formatting import decimal, seconds
from vjepa2_ac.reports.html.images import colours_of, css_gradient, jpeg_urls, png_url
from vjepa2_ac.reports.html.templates import render

MOST_EXAMPLES = 4
MOST_FRAMES = 16  # of a clip in the animation
_MOST_COLUMNS = 8  # of the strip: the first frame and later ones
_BYTES = 2_400_000  # of all photographs together
_COLOURS = "inferno"
_SECONDS = 0.5  # duration of a frame, at least


@dataclass(frozen=True)
class _Track:
    """What is shown of a clip at each time: a row of the strip, and perhaps a panel of the animation."""

    kind: Literal["frames", "error", "latents"]
    of: str  # the model; of frames and true latents, which the first frame has as well: true
    name: str
    panel: str = ""  # name in the animation; empty: it is not part of it


@dataclass(frozen=True, eq=False)
class _Shown:
    """An example whose photographs have ids that other images refer to."""

    number: int
    example: Example
    photographs: Mapping[int, str]  # time -> URL; empty: there are none, or they do not fit
    tracks: Sequence[_Track]
    seconds_per_step: float

    @property
    def name(self) -> str:
        return f"{self.example.episode_id}, from control step {self.example.start}"

    @property
    def worst(self) -> float:
        """The largest error of a patch: the brightest colour in every image of the example."""
        return max(float(errors.max()) for errors in self.example.errors.values())

    @property
    def columns(self) -> list[int]:
        """The times of the strip."""
        return spread_with_ends(len(self.example.true_colours), _MOST_COLUMNS)

    @property
    def turns(self) -> list[int]:
        """The times of the animation."""
        return spread_with_ends(len(self.example.true_colours), MOST_FRAMES)

    def when(self, time: int) -> str:
        return "now" if time == 0 else f"+{seconds(time * self.seconds_per_step)}"

    def mean(self, track: _Track, time: int) -> str:
        """Return the mean error of all patches."""
        return decimal(float(self.example.errors[track.of][time - 1].mean()))

    def described(self, track: _Track, time: int) -> str:
        """Return the description of an image."""
        if track.kind == "frames":
            return f"True frame, {self.when(time)}"
        if track.kind == "error":
            return f"Error of {track.of}, {self.when(time)}: mean {self.mean(track, time)}"
        whose = "True latents" if track.of == "true" else f"Latents predicted by {track.of}"
        return f"{whose} as colours, {self.when(time)}"

    def image(self, track: _Track, time: int) -> str:
        """Return errors or latents as colours, in a URL; every prediction begins at the true latents."""
        if track.kind == "error":
            return png_url(colours_of(self.example.errors[track.of][time - 1], 0.0, self.worst, _COLOURS))
        if track.of == "true" or time == 0:
            return png_url(self.example.true_colours[time])
        return png_url(self.example.predicted_colours[track.of][time - 1])


def examples_section(evaluation: Evaluation) -> Markup:
    """Return the section of example clips."""
    examples = evaluation.examples[:MOST_EXAMPLES]
    frames = [_frames(example) for example in examples]
    urls = jpeg_urls([list(one.values()) for one in frames], at_most=_BYTES)
    shown = []
    for number, example in enumerate(examples):
        photographs = dict(zip(frames[number], urls[number], strict=False))  # all, or none
        tracks = _tracks(example, tuple(evaluation.models), has_frames=bool(photographs))
        shown.append(_Shown(number, example, photographs, tracks, evaluation.about.seconds_per_step))
    return render("examples", evaluation=evaluation, examples=shown, gradient=css_gradient(_COLOURS))


def _tracks(example: Example, models: Sequence[str], *, has_frames: bool) -> list[_Track]:
    """Return what is shown, in its order; of models, the last one's is animated."""
    return [
        *([_Track("frames", "true", "true frames", "true frames")] if has_frames else []),
        *(
            _Track("error", of, f"error of {of}", f"error of {of}" if of == models[-1] else "")
            for of in ("persistence", *models)
            if of in example.errors
        ),
        _Track("latents", "true", "true latents", "true latents"),
        *(
            _Track("latents", of, f"latents predicted by {of}", f"predicted by {of}" if of == models[-1] else "")
            for of in models
            if of in example.predicted_colours
        ),
    ]


def animation_style(examples: Sequence[Example]) -> str:
    """Return the CSS that shows n frames one after the other, for each n that occurs."""
    counts = sorted({min(len(example.true_colours), MOST_FRAMES) for example in examples[:MOST_EXAMPLES]})
    rules = []
    for count in counts:
        rules.append(f"@keyframes turn-{count}{{0%{{opacity:1}}{100 / count:.4f}%{{opacity:0}}100%{{opacity:0}}}}")
        length = count * _SECONDS
        for place in range(count):
            turn = f"turn-{count} {length:g}s step-end {place * _SECONDS - length:g}s infinite"
            rules.append(f".film-{count} .f{place}{{animation:{turn}}}")
    return "\n".join(rules)


def _frames(example: Example) -> dict[int, UInt8[np.ndarray, "height width 3"]]:
    """Return the visible photographs, by time."""
    if example.frames is None:
        return {}
    times = len(example.true_colours)
    shown = {time for most in (_MOST_COLUMNS, MOST_FRAMES) for time in spread_with_ends(times, most)}
    return {time: example.frames[time] for time in sorted(shown)}
