"""Report section of example clips, frame by frame: errors, latents as colours, and an animation of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.evaluation.result import Evaluation, Example
from vjepa2_ac.reports.html.formatting import decimal, seconds
from vjepa2_ac.reports.html.images import colours_of, css_gradient, jpeg_urls, png_url
from vjepa2_ac.reports.html.layout import ReportSection, not_measured, paragraph, scrolling, why_not
from vjepa2_ac.reports.html.markup import Markup, element, joined

MOST_EXAMPLES = 4
MOST_FRAMES = 16  # of a clip in the animation
_MOST_COLUMNS = 8  # of the strip: the first frame and later ones
_BYTES = 2_400_000  # of all photographs together
_COLOURS = "inferno"
_SIZE = 100.0  # of an image, in units of its own drawing
_SECONDS = 0.5  # duration of a frame, at least


@dataclass(frozen=True, eq=False)
class _Shown:
    """An example whose photographs have ids that other images refer to."""

    number: int
    example: Example
    models: tuple[str, ...]
    seconds_per_step: float
    has_frames: bool

    @property
    def times(self) -> int:
        return len(self.example.true_colours)

    @property
    def worst(self) -> float:
        """The largest error of a patch: the brightest colour in every image of the example."""
        return max(float(errors.max()) for errors in self.example.errors.values())

    @property
    def columns(self) -> list[int]:
        """The times of the strip."""
        return _spread(self.times, _MOST_COLUMNS)

    @property
    def turns(self) -> list[int]:
        """The times of the animation."""
        return _spread(self.times, MOST_FRAMES)

    def when(self, time: int) -> str:
        return "now" if time == 0 else f"+{seconds(time * self.seconds_per_step)}"


def examples_section(evaluation: Evaluation) -> ReportSection:
    """Return the section of example clips."""
    title = "Example clips"
    examples = evaluation.examples[:MOST_EXAMPLES]
    if not examples:
        why = why_not(evaluation, "example clips", "This evaluation made no example clips.")
        return ReportSection("pictures", title, not_measured("Example clips", why))
    photographs = jpeg_urls([list(_frames(example).values()) for example in examples], at_most=_BYTES)
    models = tuple(evaluation.models)
    parts = []
    for number, (example, urls) in enumerate(zip(examples, photographs, strict=True)):
        shown = _Shown(number, example, models, evaluation.about.seconds_per_step, bool(urls))
        parts.append(joined(_definitions(shown, urls) if urls else Markup(), _example(shown)))
    return ReportSection("pictures", title, joined(_how(), *parts))


def animation_style(examples: Sequence[Example]) -> str:
    """Return the CSS that shows n frames one after the other, for each n that occurs."""
    counts = sorted({len(_spread(len(example.true_colours), MOST_FRAMES)) for example in examples[:MOST_EXAMPLES]})
    rules = []
    for count in counts:
        rules.append(f"@keyframes turn-{count}{{0%{{opacity:1}}{100 / count:.4f}%{{opacity:0}}100%{{opacity:0}}}}")
        length = count * _SECONDS
        for place in range(count):
            turn = f"turn-{count} {length:g}s step-end {place * _SECONDS - length:g}s infinite"
            rules.append(f".film-{count} .f{place}{{animation:{turn}}}")
    return "\n".join(rules)


def _how() -> Markup:
    bar = element("span", class_="bar", style=f"background:{css_gradient(_COLOURS)}", aria_hidden="true")
    return joined(
        paragraph(
            "Rollouts from the first frame of held-out clips. ",
            element("strong", "Errors"),
            " are drawn over the frames in grey: ",
            bar,
            " from 0 to the largest L1 error of a patch in that clip, the same colours for all models of the clip. ",
            element("strong", "Latents"),
            " are shown as colours: the three principal components of the clip's true latents as red, green and blue,"
            " in one basis and one scale for the true and all predicted ones. Where a prediction has the colours of the"
            " truth, it is right; where it keeps those of the first frame, it is no better than persistence; where it"
            " blurs, the model is unsure.",
            class_="how",
        )
    )


def _spread(times: int, most: int) -> list[int]:
    """Return some of the times, the first and the last among them."""
    return sorted({round(x) for x in np.linspace(0, times - 1, min(most, times))})


def _frames(example: Example) -> dict[int, UInt8[np.ndarray, "height width 3"]]:
    """Return the visible photographs, by time."""
    if example.frames is None:
        return {}
    times = len(example.true_colours)
    return {
        time: example.frames[time] for time in sorted({*_spread(times, _MOST_COLUMNS), *_spread(times, MOST_FRAMES)})
    }


def _definitions(shown: _Shown, urls: Sequence[str]) -> Markup:
    """Return each photograph once, hidden; `_photograph` shows them."""
    size = {"width": _SIZE, "height": _SIZE}
    images = [
        element("image", id=f"e{shown.number}f{time}", href=url, preserveAspectRatio="none", **size)
        for time, url in zip(_frames(shown.example), urls, strict=True)
    ]
    return element("svg", element("defs", *images), class_="definitions", aria_hidden="true")


def _example(shown: _Shown) -> Markup:
    example = shown.example
    name = f"{example.episode_id}, from control step {example.start}"
    parts = [element("h3", f"{example.why}: ", element("span", name, class_="id"))]
    if not shown.has_frames:
        why = "The latents come from a cache that holds no frames."
        parts.append(not_measured("Photographs", why if example.frames is None else "They do not fit into a page."))
    parts.append(element("div", _film(shown, name), _strip(shown, name), class_="still-and-moving"))
    return element("article", *parts, class_="example")


def _strip(shown: _Shown, name: str) -> Markup:
    columns = shown.columns
    head = element("tr", element("td"), *(element("th", shown.when(time), scope="col") for time in columns))
    rows = []
    if shown.has_frames:
        rows.append(_row("true frames", [_photograph(shown, time) for time in columns]))
    for of in _measured(shown.example.errors, ("persistence", *shown.models)):
        cells = [Markup() if time == 0 else _error_image(shown, of, time) for time in columns]
        rows.append(_row(f"error of {of}", cells))
    rows.append(_row("true latents", [_colour_image(shown, "true", time) for time in columns]))
    for of in _measured(shown.example.predicted_colours, shown.models):
        cells = [Markup() if time == 0 else _colour_image(shown, of, time) for time in columns]
        rows.append(_row(f"latents predicted by {of}", cells))
    caption = element("caption", element("span", "Frame by frame: errors and latents over the horizon"))
    whole = element("table", caption, element("thead", head), element("tbody", *rows), class_="strip")
    return scrolling(whole, f"Frames of {name}")


def _row(name: str, cells: Sequence[Markup]) -> Markup:
    return element("tr", element("th", name, scope="row"), *(element("td", cell) for cell in cells))


def _measured(given: Mapping[str, object], order: Sequence[str]) -> list[str]:
    return [name for name in order if name in given]


def _film(shown: _Shown, name: str) -> Markup:
    """Return the animations, with a checkbox to stop them; no script is needed."""
    times = shown.turns
    count = len(times)
    trained = shown.models[-1]
    panels = []
    if shown.has_frames:
        panels.append(_panel("true frames", [_photograph_inside(shown, time) for time in times]))
    if trained in shown.example.errors:
        panels.append(_panel(f"error of {trained}", [_error_inside(shown, trained, time) for time in times]))
    panels.append(_panel("true latents", [_colours_inside(shown, "true", time) for time in times]))
    if trained in shown.example.predicted_colours:
        panels.append(_panel(f"predicted by {trained}", [_colours_inside(shown, trained, time) for time in times]))
    clock = [element("span", shown.when(time), class_=f"frame f{place}") for place, time in enumerate(times)]
    box = element("label", element("input", type="checkbox", class_="halt"), " pause")
    controls = element("div", box, element("span", *clock, class_="clock", aria_hidden="true"), class_="controls")
    description = f"Animation of {name}: {count} frames, repeated. The same frames are shown below, side by side."
    parts = element("div", *panels, class_="panels", role="img", aria_label=description)
    return element("div", controls, parts, class_=f"film film-{count}")


def _panel(name: str, frames: Sequence[Markup]) -> Markup:
    turning = [element("g", frame, class_=f"frame f{place}") for place, frame in enumerate(frames)]
    return element("div", _drawing(None, *turning), element("span", name), class_="panel")


def _photograph(shown: _Shown, time: int) -> Markup:
    return _drawing(f"True frame, {shown.when(time)}", _photograph_inside(shown, time))


def _error_image(shown: _Shown, of: str, time: int) -> Markup:
    mean = float(shown.example.errors[of][time - 1].mean())
    description = f"Error of {of}, {shown.when(time)}: mean {decimal(mean)}"
    return joined(
        _drawing(description, _error_inside(shown, of, time)), element("span", decimal(mean), class_="number")
    )


def _colour_image(shown: _Shown, of: str, time: int) -> Markup:
    whose = "True latents" if of == "true" else f"Latents predicted by {of}"
    return _drawing(f"{whose} as colours, {shown.when(time)}", _colours_inside(shown, of, time))


def _photograph_inside(shown: _Shown, time: int) -> Markup:
    return element("use", href=f"#e{shown.number}f{time}")


def _error_inside(shown: _Shown, of: str, time: int) -> Markup:
    """Return the error of each patch over the frame in grey; the first frame has none."""
    below = element("use", href=f"#e{shown.number}f{time}", class_="grey") if shown.has_frames else Markup()
    if time == 0:
        return below
    return joined(below, _grid(_error_pixels(shown.example.errors[of][time - 1], shown.worst), "error"))


def _error_pixels(errors: Float[np.ndarray, "grid grid"], worst: float) -> UInt8[np.ndarray, "grid grid 3"]:
    return colours_of(errors, 0.0, worst, _COLOURS)


def _colours_inside(shown: _Shown, of: str, time: int) -> Markup:
    """Return latents as colours; every model begins at the true ones."""
    if of == "true" or time == 0:
        return _grid(shown.example.true_colours[time], "latents")
    return _grid(shown.example.predicted_colours[of][time - 1], "latents")


def _grid(pixels: UInt8[np.ndarray, "grid grid 3"], class_: str) -> Markup:
    size = {"width": _SIZE, "height": _SIZE}
    return element("image", href=png_url(pixels), class_=f"grid {class_}", preserveAspectRatio="none", **size)


def _drawing(description: str | None, *inside: Markup) -> Markup:
    """Return a square image; one without description is decorative."""
    described = {"role": "img", "aria_label": description} if description else {"aria_hidden": "true"}
    return element("svg", *inside, class_="picture", viewBox=f"0 0 {_SIZE:g} {_SIZE:g}", **described)
