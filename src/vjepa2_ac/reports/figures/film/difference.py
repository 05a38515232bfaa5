"""The difference of two rows of a film as a heat map: where, and how much, their frames differ."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from matplotlib import colormaps

from vjepa2_ac.reports.figures.film.film import FilmRow

FULL_SCALE = 64  # of 255: a difference from which the map is at its brightest, in every film
COLOURS = "magma"  # even steps look even; black is no difference, and it reads without colour


def difference_row(row: FilmRow, reference: FilmRow, label: str = "") -> FilmRow:
    """Return a row of heat maps: the absolute difference of two rows, mean over red, green and blue.

    The scale is fixed (`FULL_SCALE`), so maps of different films are comparable. There is a map in every column in
    which both rows have a frame.

    Args:
        row: Compared.
        reference: With this.
        label: Of the row; empty: made of theirs.

    Raises:
        ValueError: Frames of different sizes, or no column in which both have one.
    """
    if row.size != reference.size:
        raise ValueError(f"frames of {row.size} and {reference.size} pixels have no difference")
    start, end = max(row.start, reference.start), min(row.end, reference.end)
    if start >= end:
        raise ValueError(f"rows '{row.label}' and '{reference.label}' have no column in common")
    ours, theirs = (each.frames[start - each.start : end - each.start].astype(np.float32) for each in (row, reference))
    frames = heat_colours(abs(ours - theirs).mean(axis=-1) / FULL_SCALE)
    return FilmRow(label or f"{row.label} minus {reference.label}", frames, "difference", given=0, start=start)


def heat_colours(share: np.ndarray) -> UInt8[np.ndarray, "*shape 3"]:
    """Return the colours of numbers from 0 (none) to 1 (full scale and above)."""
    rgba = colormaps[COLOURS](np.clip(share, 0.0, 1.0))
    return np.asarray((255 * rgba[..., :3]).round().astype(np.uint8))
