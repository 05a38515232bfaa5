"""Captioned frames: images side by side with a caption above each, as one frame of a video."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.reports.figures.page import new_figure, pixels_of

_DOTS = 100  # per inch, of text
_LINE = 30  # pixels
_GAP = 6


def side_by_side(
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]], captions: Sequence[str], title: str, *, enlarged: int = 2
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return images of one size in a row, a caption above each, a title above all.

    Args:
        pictures: The images.
        captions: One for each.
        title: A line, at most as long as all images are wide.
        enlarged: Pixels per pixel, along both axes.
    """
    large = [picture.repeat(enlarged, axis=0).repeat(enlarged, axis=1) for picture in pictures]
    columns = [
        np.concatenate([_text_image(text, one.shape[1]), one]) for text, one in zip(captions, large, strict=True)
    ]
    gap = np.full((columns[0].shape[0], _GAP, 3), 255, dtype=np.uint8)
    row = np.concatenate([part for column in columns for part in (column, gap)][:-1], axis=1)
    return np.concatenate([_text_image(title, row.shape[1], points=11.0), row])


@lru_cache(maxsize=512)
def _text_image(text: str, width: int, *, points: float = 9.0) -> UInt8[np.ndarray, "_ width 3"]:
    """Return a line of text on white; read only, since it is drawn once."""
    figure = new_figure(width / _DOTS, _LINE / _DOTS, dpi=_DOTS, facecolor="white")
    figure.text(8 / width, 0.5, text, fontsize=points, va="center", ha="left", parse_math=False)
    return pixels_of(figure)
