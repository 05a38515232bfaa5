"""Change of vector states per model step, as shares of each number's range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class ChangePerStep:
    """Change of vectors per model step, at one stride."""

    stride: int
    seconds: float
    percent: Float[np.ndarray, " pairs"]  # of its range, for the number that changes most

    def percentiles(self, which: Sequence[int]) -> list[float]:
        """Return percentiles of the change; empty if no pair of steps fits."""
        return [float(value) for value in np.percentile(self.percent, list(which))] if len(self.percent) else []


def change_per_step(
    pieces: Sequence[Float[np.ndarray, "steps state_dim"]],
    ranges: Float[np.ndarray, "state_dim 2"],
    stride: int,
    control_rate_hz: float,
) -> ChangePerStep:
    """Return the change from each step to the one `stride` later.

    Args:
        pieces: States in the ranges that clips come from.
        ranges: The least and greatest value of each number.
        stride: Control steps per model step.
        control_rate_hz: Control steps per second.
    """
    changes = [largest_change(piece[stride:] - piece[:-stride], ranges) for piece in pieces if len(piece) > stride]
    return ChangePerStep(stride, stride / control_rate_hz, np.concatenate([np.zeros(0), *changes]))


def largest_change(
    changes: Float[np.ndarray, "steps state_dim"], ranges: Float[np.ndarray, "state_dim 2"]
) -> Float[np.ndarray, " steps"]:
    """Return, at each step, the change of the number that changes most, in percent of its range."""
    spans = ranges[:, 1] - ranges[:, 0]
    return np.asarray((abs(changes) / np.where(spans > 0, spans, np.inf)).max(axis=1) * 100)
