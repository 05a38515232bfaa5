"""Axis fits: how the axes in which a model infers moves lie to those in which a robot executes them.

Two measurements of one angle: that at which the model predicts best, and that of a fit. Planning takes the first.

Source: of the fit, arXiv 2506.09985, appendix B.4: moves that the model infers are fitted to executed ones by linear
least squares, and the angle is that of the rotation nearest to the fitted matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio

MOST_CONDITION = 10.0  # beyond it, one direction is hardly inferred, or hardly executed
MOST_YAW_DEGREES = 15.0  # half the width of the interval of an angle that is known
EPISODES_NEEDED = 2  # for an interval
TRIED_DEGREES = tuple(range(-180, 180, 15))


@dataclass(frozen=True)
class AxisFit:
    """The least-squares fit inferred = matrix @ executed over pairs of frames, in the robot's base frame."""

    matrix: Float[np.ndarray, "3 3"]
    yaw_degrees: Estimate  # about z, counterclockwise from above: at which the model predicts best
    fitted_yaw_degrees: Estimate  # of the rotation nearest to the matrix's horizontal 2 x 2 block
    error: Estimate  # squared error of the next frame at the yaw, over that of what is not turned
    gain: Estimate  # square root of that block's determinant: inferred length over executed length
    condition: Estimate  # largest over smallest singular value of the matrix
    residual_cm: Estimate  # mean |inferred - matrix @ executed|
    executed: Float[np.ndarray, "pairs 3"]  # metres
    inferred: Float[np.ndarray, "pairs 3"]
    episodes: int
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y about which states are turned by the yaw

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
        if not self.condition.high <= MOST_CONDITION:
            return f"ill-conditioned: condition {self.condition}, and above {MOST_CONDITION:g} a direction is unknown"
        if not np.linalg.det(self.matrix) > 0:
            return "mirrored axes: an image that is flipped, or a model that does not use the actions"
        if not (self.error.value == 1.0 or self.error.high < 1.0):  # 1: the nearest angle tried is 0
            return f"no better than none: squared error {self.error} of that without a turn"
        if not half <= MOST_YAW_DEGREES:
            return f"uncertain: yaw {yaw.value:.0f} degrees, 95 % interval {yaw.low:.0f} to {yaw.high:.0f}"
        return None

    def words(self) -> str:
        """Return as text where the axes lie, and whether they can be planned by."""
        yaw = self.yaw_degrees
        between = f" (95 % interval {yaw.low:.0f} to {yaw.high:.0f})" if yaw.has_interval else ""
        text = (
            f"Turned by {yaw.value:+.1f} degrees about {self._place}{between}, what the robot does is predicted best:"
            f" squared error {self.error} of that without a turn. The fit of inferred moves has yaw"
            f" {self.fitted_yaw_degrees.value:+.1f}, gain {self.gain}, condition {self.condition}"
            f" ({self.pairs} pairs of {self.episodes} episodes, off by {self.residual_cm.value:.1f} cm on average)."
        )
        return text if self.problem is None else f"{text} Not to plan by: {self.problem}."

    @property
    def _place(self) -> str:
        x, y = self.centre_m
        return f"the middle of its motion, x {x:.2f} y {y:.2f} m" if any(self.centre_m) else "its base"

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers but the pairs as plain values, for JSON."""
        estimates = ("yaw_degrees", "error", "fitted_yaw_degrees", "gain", "condition", "residual_cm")
        return {
            **{name: getattr(self, name).as_dict() for name in estimates},
            "centre_m": list(self.centre_m),
            "matrix": self.matrix.tolist(),
            "pairs": self.pairs,
            "episodes": self.episodes,
            "problem": self.problem,
        }


def yaw_of_least_error(errors: Float[np.ndarray, "pairs angles"], episode_ids: Sequence[str]) -> Estimate:
    """Return the angle of least error in degrees: of a parabola through the least of the tried ones and those beside.

    Args:
        errors: Squared errors at each of `TRIED_DEGREES`.
        episode_ids: Of each pair.
    """
    nearby = _least(errors.sum(axis=0))

    def of_sums(sums: Float[np.ndarray, "1 *batch angles"]) -> Float[np.ndarray, "*batch 1"]:
        return np.asarray((nearby + _wrapped(_least(sums[0]) - nearby))[..., None])

    return bootstrapped(of_sums, errors[None], episode_ids)[0]


def fit_axes(
    inferred: Float[np.ndarray, "pairs 3"],
    executed: Float[np.ndarray, "pairs 3"],
    errors: Float[np.ndarray, "pairs angles"],
    episode_ids: Sequence[str],
    centre_m: tuple[float, float] = (0.0, 0.0),
) -> AxisFit:
    """Fit inferred = matrix @ executed, with intervals from resampling whole episodes.

    Args:
        inferred: Moves (dx, dy, dz) in metres that a model infers from pairs of frames.
        executed: Those that the robot made.
        errors: Squared errors at each of `TRIED_DEGREES`.
        episode_ids: Of each pair.
        centre_m: x, y about which states were turned.

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
        flat = np.sqrt(np.abs(np.linalg.det(fitted[..., :2, :2])))
        return np.stack([nearby + _wrapped(_yaw(fitted) - nearby), flat, _condition(fitted)], axis=-1)

    fitted_yaw, gain, condition = bootstrapped(of_sums, products[None], episode_ids)
    yaw = yaw_of_least_error(errors, episode_ids)
    place = int(np.abs(_wrapped(np.array(TRIED_DEGREES) - yaw.value)).argmin())  # the nearest that was tried
    residuals = np.linalg.norm(inferred - executed @ matrix.T, axis=1)
    return AxisFit(
        matrix=matrix,
        yaw_degrees=yaw,
        fitted_yaw_degrees=fitted_yaw,
        error=ratio(errors[:, place], errors[:, TRIED_DEGREES.index(0)], episode_ids),
        gain=gain,
        condition=condition,
        residual_cm=mean_of(100 * residuals, episode_ids),
        executed=executed,
        inferred=inferred,
        episodes=len(set(episode_ids)),
        centre_m=centre_m,
    )


def _least(errors: Float[np.ndarray, "*batch angles"]) -> Float[np.ndarray, "*batch"]:
    place = errors.argmin(axis=-1)[..., None]
    before, least, after = (
        np.take_along_axis(errors, (place + step) % errors.shape[-1], axis=-1)[..., 0] for step in (-1, 0, 1)
    )
    bend = before - 2 * least + after
    shift = np.divide(before - after, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    step = TRIED_DEGREES[1] - TRIED_DEGREES[0]
    return np.asarray(_wrapped(TRIED_DEGREES[0] + step * (place[..., 0] + shift)))


def _wrapped(degrees: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Return angles within -180 .. 180: an interval may go across it."""
    return np.asarray(np.remainder(degrees + 180.0, 360.0) - 180.0)


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
