"""Films of what a model imagines, beside what happened: as a strip, and as frames of a video.

Every image says what it is: recorded, what the simulator shows, decoded from the latents of a true frame, or imagined.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from matplotlib.colors import to_rgb

from vjepa2_ac.data.windows import spread_with_ends
from vjepa2_ac.media.image_file import resized
from vjepa2_ac.reports.figures.caption import text_image
from vjepa2_ac.reports.figures.page import BLUE, GREEN, GREY, ORANGE

Kind = Literal["recorded", "simulated", "decoded", "imagined"]

MEANING: dict[Kind, tuple[str, str]] = {
    "recorded": (GREY, "recorded"),
    "simulated": (GREEN, "what really happens, simulated"),
    "decoded": (BLUE, "decoded from the true frame's latents"),
    "imagined": (ORANGE, "imagined from the first frame alone"),
}
"""Colour and meaning of each kind."""

_BORDER, _GAP = 4, 6  # pixels
_LABEL, _HEAD, _FOOT = 190, 34, 26
_MOST_COLUMNS = 9
_HOLD = 3  # how many times as long the first and the last frame of a video are shown


@dataclass(frozen=True, eq=False)
class Row:
    """Frames of one story, the first one at the start."""

    label: str
    kind: Kind  # of all frames, except for the first one of what is imagined: it is given, and decoded
    frames: UInt8[np.ndarray, "time height width 3"]
    captions: tuple[str, ...] = ()  # of each frame, in small letters; none: no line for them


@dataclass(frozen=True, eq=False)
class FilmStrip:
    """Rows of equal length.

    Raises:
        ValueError: No rows, no frames, or of different lengths.
    """

    title: str
    rows: tuple[Row, ...]
    seconds: tuple[float, ...]  # of each frame since the start

    def __post_init__(self) -> None:
        lengths = {len(row.frames) for row in self.rows}
        wrong = any(len(row.captions) not in {0, len(self.seconds)} for row in self.rows)
        if not self.seconds or lengths != {len(self.seconds)} or wrong:
            raise ValueError(f"rows of {sorted(lengths)} frames, at {len(self.seconds)} times")


def draw_strip(film: FilmStrip, *, side: int = 128) -> UInt8[np.ndarray, "height width 3"]:
    """Return all rows below each other, time from left to right; of many times some, evenly spread.

    Args:
        film: What is shown.
        side: Height and width of an image, in pixels.
    """
    places = spread_with_ends(len(film.seconds), _MOST_COLUMNS)
    width = _LABEL + len(places) * (side + 2 * _BORDER + _GAP)
    heads = [f"{film.seconds[place]:.2f} s" if place else "start, given" for place in places]
    lines = [_line(text_image(film.title, width, height=_HEAD, points=10.5, bold=True), width)]
    lines.append(_beside([_blank(_HEAD // 2, _LABEL), *(_head(text, side) for text in heads)]))
    for row in film.rows:
        label = text_image(row.label, _LABEL, height=side + 2 * _BORDER, points=8.5, colour=MEANING[row.kind][0])
        panels = [_framed(resized(row.frames[place], side), _colour(row, place)) for place in places]
        lines.append(_beside([label, *panels]))
        if row.captions:
            captions = [_head(row.captions[place], side) for place in places]
            lines.append(_beside([_blank(_HEAD // 2, _LABEL), *captions]))
    lines.append(_legend({row.kind for row in film.rows}, width))
    return np.concatenate([_line(line, width) for line in lines])


def film_frames(film: FilmStrip, *, side: int = 192, across: int = 4) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield an image of all rows side by side for each time.

    Args:
        film: What is shown.
        side: Height and width of an image, in pixels.
        across: Rows beside each other.
    """
    across = min(across, len(film.rows))
    width = across * (side + 2 * _BORDER + _GAP)
    for place, seconds in enumerate(film.seconds):
        when = f"{seconds:.2f} s" if place else "start: all that is given"
        lines = [text_image(f"{film.title}\n{when}", width, height=48, points=9.5, bold=True)]
        for first in range(0, len(film.rows), across):
            some = film.rows[first : first + across]
            panels = []
            for row in some:
                outer = side + 2 * _BORDER
                label = text_image(row.label, outer, height=40, points=8.0, colour=MEANING[row.kind][0])
                below = [_head(row.captions[place], side)[:, :outer]] if row.captions else []
                panel = _framed(resized(row.frames[place], side), _colour(row, place))
                panels.append(np.concatenate([label, panel, *below]))
            tallest = max(len(panel) for panel in panels)
            lines.append(_beside([_padded(panel, tallest) for panel in panels]))
        lines.append(_legend({row.kind for row in film.rows}, width))
        yield np.concatenate([_line(line, width) for line in lines])


def durations(film: FilmStrip, *, slower: float = 1.0) -> list[float]:
    """Return how many seconds each frame of a video is shown: real time or slower, the first and last one longer."""
    steps = np.diff(film.seconds).tolist() or [1.0]
    shown = [slower * one for one in [*steps, steps[-1]]][: len(film.seconds)]
    shown[0] = max(shown[0], 0.5) * _HOLD
    shown[-1] = max(shown[-1], 0.5) * _HOLD
    return shown


def held(frames: Sequence[np.ndarray], seconds: Sequence[float], rate_hz: float) -> Iterator[np.ndarray]:
    """Yield each frame as often as a video of this rate needs to show it that long."""
    for frame, one in zip(frames, seconds, strict=True):
        for _ in range(max(1, round(one * rate_hz))):
            yield frame


def _colour(row: Row, place: int) -> str:
    kind: Kind = "decoded" if row.kind == "imagined" and place == 0 else row.kind
    return MEANING[kind][0]


def _framed(image: np.ndarray, colour: str) -> np.ndarray:
    side = len(image) + 2 * _BORDER
    framed = np.empty((side, side, 3), np.uint8)
    framed[:] = [round(255 * part) for part in to_rgb(colour)]
    framed[_BORDER:-_BORDER, _BORDER:-_BORDER] = image
    return framed


def _head(text: str, side: int) -> np.ndarray:
    return text_image(text, side + 2 * _BORDER, height=_HEAD // 2, points=7.0, colour=GREY)


def _beside(parts: Sequence[np.ndarray]) -> np.ndarray:
    gap = _blank(len(parts[0]), _GAP)
    return np.concatenate([one for part in parts for one in (part, gap)][:-1], axis=1)


def _padded(panel: np.ndarray, height: int) -> np.ndarray:
    return np.concatenate([panel, _blank(height - len(panel), panel.shape[1])])


def _line(line: np.ndarray, width: int) -> np.ndarray:
    """Return a line filled up with white, and a gap below it."""
    return np.concatenate([_padded_across(line, width), _blank(_GAP, width)])


def _legend(kinds: set[Kind], width: int) -> np.ndarray:
    """Return what the colours mean, as many beside each other as fit."""
    entries = []
    for kind, (colour, meaning) in MEANING.items():
        if kind in kinds or (kind == "decoded" and "imagined" in kinds):
            swatch = _blank(_FOOT, 18)
            swatch[8:-8, 4:-4] = [round(255 * part) for part in to_rgb(colour)]
            words = text_image(meaning, 22 + round(6.2 * len(meaning)), height=_FOOT, points=8.0)
            entries.append(np.concatenate([swatch, words], axis=1))
    lines: list[np.ndarray] = []
    for entry in entries:
        if lines and lines[-1].shape[1] + entry.shape[1] <= width:
            lines[-1] = np.concatenate([lines[-1], entry], axis=1)
        else:
            lines.append(entry)
    return np.concatenate([_padded_across(line, width) for line in lines])


def _padded_across(line: np.ndarray, width: int) -> np.ndarray:
    return np.concatenate([line[:, :width], _blank(len(line), max(0, width - line.shape[1]))], axis=1)


def _blank(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), 255, np.uint8)
