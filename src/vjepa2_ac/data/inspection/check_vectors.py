"""Checks of vector states (`data.states: vector`), whose meaning is unknown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from vjepa2_ac.data.inspection.finding import Finding

_LARGE = 100.0  # beyond plausible radians, metres and shares
_FAR = 0.05  # of the range of a number


def vector_findings(
    states: Float[np.ndarray, "steps state_dim"], actions: Float[np.ndarray, "pairs action_dim"]
) -> Iterator[Finding]:
    """Yield the findings about states and actions of some clips."""
    yield _about("states", states, "Check which fields the state is made of")
    yield _about("actions", actions, "There is nothing to learn from")


def has_moved(
    states: Float32[Tensor, "batch time state_dim"], ranges: Float32[Tensor, " state_dim"]
) -> Bool[Tensor, "batch time-1"]:
    """Return where a number of the state has moved by more than a share of its range."""
    return ((states[:, 1:] - states[:, :-1]).abs() > _FAR * ranges.clamp(min=1e-12)).any(dim=-1)


def numbered(places: Sequence[int], *, most: int = 8) -> str:
    """Return the indices of numbers of a vector as text, counted from 0."""
    return ", ".join(map(str, places[:most])) + (", ..." if len(places) > most else "")


def _about(name: str, values: Float[np.ndarray, "rows width"], way_out: str) -> Finding:
    low, high = values.min(axis=0), values.max(axis=0)
    text = f"{values.shape[1]} numbers, {low.min():.3g} to {high.max():.3g}"
    fixed = np.flatnonzero(low == high).tolist()
    large = np.flatnonzero(abs(values).max(axis=0) > _LARGE).tolist()
    if len(fixed) == values.shape[1]:
        return Finding("error", name, f"{text}: none of them ever changes. {way_out}")
    if large:
        return Finding(
            "warning", name, f"{text}: large are {numbered(large)} (from 0). Numbers go into the network as they are:"
            " bring them to the order of 1, such as radians, metres, or 0 to 1",
        )  # fmt: skip
    if fixed:
        return Finding("warning", name, f"{text}: {numbered(fixed)} (from 0) never change")
    return Finding("ok", name, text)
