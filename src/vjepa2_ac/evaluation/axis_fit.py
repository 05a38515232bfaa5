"""Axis fits: how the axes in which a model infers moves lie to those in which a robot executes them.

Source: arXiv 2506.09985, appendix B.4: moves that the model infers are fitted to executed ones by linear least squares,
and the angle is that of the rotation nearest to the fitted matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac.evaluation.intervals import Estimate, bootstrapped, mean_of

MOST_CONDITION = 10.0  # beyond it, one direction is hardly inferred, or hardly executed
MOST_YAW_DEGREES = 15.0  # half the width of the interval of an angle that is known
EPISODES_NEEDED = 2  # for an interval


@dataclass(frozen=True)
class AxisFit:
    """The least-squares fit inferred = matrix @ executed over pairs of frames, in the robot's base frame."""

    matrix: Float[np.ndarray, "3 3"]
    yaw_degrees: Estimate  # about z, counterclockwise from above: of the rotation nearest to the horizontal 2 x 2 block
    gain: Estimate  # square root of that block's determinant: inferred length over executed length
    condition: Estimate  # largest over smallest singular value of the matrix
    residual_cm: Estimate  # mean |inferred - matrix @ executed|
    executed: Float[np.ndarray, "pairs 3"]  # metres
    inferred: Float[np.ndarray, "pairs 3"]
    episodes: int

    @property
    def pairs(self) -> int:
        """How many pairs it was fitted to."""
        return len(self.executed)

    @property
    def problem(self) -> str | None:
        """Why nothing can be planned by it, as text; None: it can."""
        yaw, half = self.yaw_degrees, (self.yaw_degrees.high - self.yaw_degrees.low) / 2
        if self.episodes < EPISODES_NEEDED:
            return f"pairs of {self.episodes} episode, and an interval needs {EPISODES_NEEDED}"
        if not np.linalg.det(self.matrix) > 0:
            return "mirrored axes: an image that is flipped, or a model that does not use the actions"
        if not self.condition.high <= MOST_CONDITION:
            return f"ill-conditioned: condition {self.condition}, and above {MOST_CONDITION:g} a direction is unknown"
        if not half <= MOST_YAW_DEGREES:
            return f"uncertain: yaw {yaw.value:.0f} degrees, 95 % interval {yaw.low:.0f} to {yaw.high:.0f}"
        return None

    def words(self) -> str:
        """Return as text where the axes lie, and whether they can be planned by."""
        yaw = self.yaw_degrees
        between = f" (95 % interval {yaw.low:.0f} to {yaw.high:.0f})" if yaw.has_interval else ""
        text = (
            f"What the robot does, the model takes for moves turned by {yaw.value:+.1f} degrees about the vertical"
            f"{between}, gain {self.gain}, condition {self.condition}: {self.pairs} pairs of {self.episodes} episodes,"
            f" off by {self.residual_cm.value:.1f} cm on average."
        )
        return text if self.problem is None else f"{text} Not to plan by: {self.problem}."

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers but the pairs as plain values, for JSON."""
        estimates = ("yaw_degrees", "gain", "condition", "residual_cm")
        return {
            **{name: getattr(self, name).as_dict() for name in estimates},
            "matrix": self.matrix.tolist(),
            "pairs": self.pairs,
            "episodes": self.episodes,
            "problem": self.problem,
        }


def fit_axes(
    inferred: Float[np.ndarray, "pairs 3"], executed: Float[np.ndarray, "pairs 3"], episode_ids: Sequence[str]
) -> AxisFit:
    """Fit inferred = matrix @ executed, with intervals from resampling whole episodes.

    Args:
        inferred: Moves (dx, dy, dz) in metres that a model infers from pairs of frames.
        executed: Those that the robot made.
        episode_ids: Of each pair.

    Raises:
        ValueError: No pairs.
    """
    if not len(inferred):
        raise ValueError("no pairs to fit axes to")
    products = np.concatenate(
        [np.einsum("ni,nj->nij", one, executed).reshape(-1, 9) for one in (inferred, executed)], axis=1
    )
    matrix = _matrix(products.sum(axis=0))
    nearby = _yaw(matrix)

    def of_sums(sums: Float[np.ndarray, "1 *batch 18"]) -> Float[np.ndarray, "*batch 3"]:
        fitted = _matrix(sums[0])
        turned = np.remainder(_yaw(fitted) - nearby + 180.0, 360.0) - 180.0  # an interval may go across 180 degrees
        flat = np.sqrt(np.abs(np.linalg.det(fitted[..., :2, :2])))
        return np.stack([nearby + turned, flat, _condition(fitted)], axis=-1)

    yaw, gain, condition = bootstrapped(of_sums, products[None], episode_ids)
    residuals = np.linalg.norm(inferred - executed @ matrix.T, axis=1)
    return AxisFit(
        matrix=matrix,
        yaw_degrees=yaw,
        gain=gain,
        condition=condition,
        residual_cm=mean_of(100 * residuals, episode_ids),
        executed=executed,
        inferred=inferred,
        episodes=len(set(episode_ids)),
    )


def _matrix(sums: Float[np.ndarray, "*batch 18"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the least-squares matrix from the sums of the products of inferred and executed, executed and executed."""
    across, within = (part.reshape(*sums.shape[:-1], 3, 3) for part in np.split(sums, 2, axis=-1))
    return np.asarray(across @ np.linalg.pinv(within, hermitian=True))


def _yaw(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle in degrees of the rotation nearest to the horizontal block (its polar decomposition)."""
    sine, cosine = matrix[..., 1, 0] - matrix[..., 0, 1], matrix[..., 0, 0] + matrix[..., 1, 1]
    return np.asarray(np.degrees(np.arctan2(sine, cosine)))


def _condition(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return np.asarray(sizes[..., 0] / sizes[..., -1])
