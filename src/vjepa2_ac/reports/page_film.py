"""The film of the report, what happened beside what the models imagine, and its images in data: URLs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.evaluation.result import DecodedStrip, Evaluation
from vjepa2_ac.media.images import encode_webp

LONGEST_S = 6.0
MOST_BYTES = 600_000
_STEP_S, _FIRST_S, _LAST_S = 0.5, 1.2, 1.8  # how long frames are shown
_QUALITIES = (85, 70, 50, 30, 10)
_THIN = 32  # a gap, or the bar of time, is so many times thinner than an image is wide
_GREY, _PASSED = 170, (31, 111, 180)  # of gaps and bar, on white as well as on black

Frame = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class PageFilm:
    """One clip as a film. URLs are data: URLs."""

    url: str  # animated
    still: str  # its last frame
    captions: tuple[str, ...]  # of the columns
    clip: DecodedStrip


def film_of(evaluation: Evaluation) -> PageFilm | None:
    """Return the film of the decoded clip whose last images differ most between base and model; None: none is decoded.

    Without a base it is the clip in which most happens. The first frame is given to all.
    """
    strips = () if evaluation.decoded is None else evaluation.decoded.strips
    if not strips:
        return None
    models = [name for name in (evaluation.base, evaluation.trained) if name is not None]
    strip = max(strips, key=lambda one: _difference(one, models))
    true = "truth" if "truth" in strip.rows else "decoded_truth"
    columns = [strip.rows[name] for name in (true, *models)]
    times = range(len(columns[0]))
    frames = [_frame([column[time] for column in columns], time / times[-1]) for time in times]
    step = min(_STEP_S, (LONGEST_S - _FIRST_S - _LAST_S) / max(len(times) - 2, 1))
    shown = [_FIRST_S, *[step] * (len(times) - 2), _LAST_S]
    (url,), (still,) = webp_urls([frames], shown, at_most=MOST_BYTES), webp_urls([frames[-1:]], at_most=MOST_BYTES)
    return PageFilm(url, still, ("what happened", *(f"the {name} imagines" for name in models)), strip)


def _difference(strip: DecodedStrip, models: Sequence[str]) -> float:
    other = strip.rows[models[-1]][-1 if len(models) > 1 else 0]
    return float(np.abs(strip.rows[models[0]][-1].astype(np.float64) - other).mean())


def _frame(images: Sequence[Frame], passed: float) -> Frame:
    """Return images side by side, and below them a bar for the share of the time that has passed."""
    thin = max(1, images[0].shape[1] // _THIN)
    with_gaps = [np.pad(one, ((0, thin), (0, thin), (0, 0)), constant_values=_GREY) for one in images]
    frame = np.concatenate(with_gaps, axis=1)[:, :-thin]
    frame[-thin:, : round(passed * frame.shape[1])] = _PASSED
    return frame


def webp_urls(films: Sequence[Sequence[Frame]], seconds: Sequence[float] = (1.0,), *, at_most: int) -> list[str]:
    """Return films, or images of one frame each, as WebP in data: URLs, in the best quality in which all fit.

    Args:
        films: The frames of each.
        seconds: How long each frame is shown.
        at_most: Bytes of all together; if even the lowest quality takes more, it is that one.
    """
    encoded: list[bytes] = []
    for quality in _QUALITIES:
        encoded = [base64.b64encode(encode_webp(one, seconds, quality=quality)) for one in films]
        if sum(map(len, encoded)) <= at_most:
            break
    return [f"data:image/webp;base64,{one.decode()}" for one in encoded]
