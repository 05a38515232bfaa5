"""Coverage of actions: does the motion in a data set teach enough of them to plan with?

A planner searches all directions up to its limits, and takes the action with the lowest energy: where the data have no
such actions, the model guesses, and the search finds the guesses that flatter. So the data are narrow if they move in
few directions, or hardly at all; it does not matter which way the axes point.

Sources of the advice: GPC (arXiv 2502.00622: a world model needs random exploration beside demonstrations), DreamZero
(a new robot from 30 minutes of play), lassesofus/thesis @ 4a2f29f (V-JEPA 2-AC fine-tuned on one-direction reaches
plans worse than its base).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac.spaces import POSE, StateSpace

PERCENTILE = 99  # of each number's change: what was taught
PLAY = (
    "Record half an hour of random motion, in all directions, as far in a step as you will plan: it helps a planner"
    " more than further demonstrations"
)

ENOUGH_NEAR = 0.5  # a direction is taught if so many steps go near it, over all directions being equally frequent
_SHORT_CM = 0.5  # a shorter step has no direction, and along an axis no sign (as evaluation.action_score.metrics)
_NEAR_DEG = 30.0
# Measured: random reaching of the simulated arm 0.99 or more, of 100 random steps 0.90; half of all directions 0.61,
# a plane 0.50 (0.58 if a fifth as thick as wide), an axis 0.14 (0.43), one way 0.07; starts of BridgeData 0.41.
_ENOUGH = 0.7
_SMALL_CM = 1.0  # an image hardly shows a shorter step
_FEWEST = 100  # steps that do not overlap
_ROWS, _COLUMNS, _MOST = 24, 48, 5000
_ONE_WAY, _ONE_AXIS, _ONE_PLANE, _LEANING = 0.8, 0.8, 0.1, 0.3
_GRIPPER = 0.1  # of its way: a change of the gripper
_HARDLY = 0.01  # numbers of vectors are of the order of 1: a smaller change is hardly one for the model
_STEP, _OFTEN, _HALF = 0.1, 0.05, 0.5  # shares: of the farthest change, of the steps, of the numbers


@dataclass(frozen=True, eq=False)
class Coverage(ABC):
    """Coverage of actions by the changes of the state, from each control step to the one `stride` later.

    There is at least one; neighbouring ones overlap.
    """

    changes: Float[np.ndarray, "pairs dim"]
    stride: int

    @cached_property
    def usual(self) -> Float[np.ndarray, " dim"]:
        """The 99th percentile of the size of each number's change."""
        return np.asarray(np.percentile(np.abs(self.changes), PERCENTILE, axis=0))

    @property
    @abstractmethod
    def is_known(self) -> bool:
        """Whether there are enough steps to tell whether they are narrow."""

    @property
    @abstractmethod
    def narrow(self) -> str:
        """Why the data are not fit to plan with; empty: they are, or there are too few steps to tell."""

    @property
    @abstractmethod
    def lines(self) -> dict[str, str]:
        """What was found, by its name."""

    @abstractmethod
    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values."""

    @property
    def verdict(self) -> str:
        """Whether the data are fit to plan with, and if not, why, and what to record."""
        if self.narrow:
            return f"narrow: {self.narrow}. {PLAY}"
        if not self.is_known:
            return f"not known of fewer than {_FEWEST} model steps, one after the other, that move"
        return "fit to plan with"

    def noted(self) -> dict[str, Any]:
        """Return what a run notes of its data, as plain values."""
        return {"percentile": PERCENTILE, "changes": self.usual.tolist(), "narrow": self.narrow}

    def is_enough(self, steps: int) -> bool:
        """Return whether overlapping steps are enough to tell."""
        return steps >= _FEWEST * self.stride


def coverage_of(changes: Float[np.ndarray, "pairs dim"], space: StateSpace, stride: int) -> Coverage:
    """Return the coverage of actions by one or more changes of states in a space."""
    return PoseCoverage(changes, stride) if space.is_pose else VectorCoverage(changes, stride)


class PoseCoverage(Coverage):
    """Coverage of poses' changes: [pairs, 7]."""

    @cached_property
    def directions(self) -> Float[np.ndarray, "steps 3"]:
        """The directions of the steps that have one, as unit vectors."""
        ways = self.changes[:, POSE.position]
        lengths = np.linalg.norm(ways, axis=1, keepdims=True)
        return np.asarray((ways / np.maximum(lengths, 1e-12))[100 * lengths[:, 0] >= _SHORT_CM])

    @cached_property
    def density(self) -> Float[np.ndarray, "rows columns"]:
        """How many steps go within 30 degrees of a direction, over how many would if all were equally frequent.

        The cells have equal areas: rows are equally spaced in z (-1 to 1), columns in azimuth (-180 to 180 degrees).
        """
        some = self.directions[:: -(-len(self.directions) // _MOST) or 1].astype(np.float32)
        if not len(some):
            return np.zeros((_ROWS, _COLUMNS))
        height = (np.arange(_ROWS, dtype=np.float32)[:, None] + 0.5) / _ROWS * 2 - 1
        azimuth = ((np.arange(_COLUMNS, dtype=np.float32) + 0.5) / _COLUMNS * 2 - 1) * np.pi
        across = np.sqrt(1 - height**2)
        cells = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height + 0 * azimuth], axis=-1)
        near = np.cos(np.deg2rad(_NEAR_DEG))
        return np.asarray((cells @ some.T > near).mean(axis=-1) / ((1 - near) / 2), np.float64)

    @property
    def covered(self) -> float:
        """The share of all directions around which go at least half as many steps as if all were equally frequent."""
        return float((self.density >= ENOUGH_NEAR).mean())

    @property
    def one_way(self) -> float:
        """The length of the mean direction: 0 if the directions balance, 1 if they are one."""
        return float(np.linalg.norm(self.directions.mean(axis=0))) if len(self.directions) else 0.0

    @cached_property
    def spread(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Shares of the directions along their principal axes, the least first (1/3 each if balanced), and the axes."""
        values, vectors = np.linalg.eigh(self.directions.T @ self.directions / max(1, len(self.directions)))
        return values, vectors.T

    @property
    def lengths_cm(self) -> list[float]:
        """The percentiles 10, 50, 90 and 99 of the length of a model step."""
        return [float(one) for one in np.percentile(POSE.shown_size(self.changes), [10, 50, 90, 99])]

    @property
    def is_known(self) -> bool:
        """Whether there are enough steps that have a direction to tell whether they are narrow."""
        return self.is_enough(len(self.directions))

    @property
    def gripper_share(self) -> float:
        """The share of model steps in which the gripper moves by a tenth of its way or more."""
        return float((np.abs(self.changes[:, POSE.gripper]) >= _GRIPPER).mean())

    @property
    def narrow(self) -> str:
        """Why the data are not fit to plan with; empty: they are, or there are too few steps to tell."""
        if not self.is_enough(len(self.changes)):
            return ""
        if (most := self.lengths_cm[2]) < _SMALL_CM:
            return f"90% of the steps are shorter than {most:.1f} cm, which images hardly show: widen data.stride"
        if not self.is_known or self.covered >= _ENOUGH:
            return ""
        return f"steps go to {self.covered:.0%} of all directions; {self._where()}"

    def _where(self) -> str:
        (least, _, most), axes = self.spread
        mean = self.directions.mean(axis=0)
        if self.one_way >= _ONE_WAY:
            return f"nearly all go one way, {_shown(mean / self.one_way)}"
        if most >= _ONE_AXIS:
            return f"nearly all go back and forth along {_shown(axes[2])}"
        if least <= _ONE_PLANE:
            return f"nearly all lie in one plane, across {_shown(axes[0])}"
        if self.one_way >= _LEANING:
            return f"few go towards {_shown(-mean / self.one_way)}"
        return f"few go along {_shown(axes[0])}"

    @property
    def lines(self) -> dict[str, str]:
        """What was found, by its name."""
        ways = 100 * self.changes[:, POSE.position]
        axes = (
            f"{name} {100 * far:.1f} cm ({(way <= -_SHORT_CM).mean():.0%} back, {(way >= _SHORT_CM).mean():.0%} forth)"
            for name, far, way in zip(POSE.change_names, self.usual[POSE.position], ways.T, strict=False)
        )
        return {
            "directions": f"{self.covered:.0%} are taught (at least half of an equal share of the steps goes within"
            f" {_NEAR_DEG:g} degrees); mean direction {self.one_way:.2f} (0 balanced, 1 one way)",
            "axes": f"{PERCENTILE} % of the steps within {', '.join(axes)}; the gripper changes in"
            f" {self.gripper_share:.0%}",
        }

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values."""
        ways = 100 * self.changes[:, POSE.position]
        return {
            "stride": self.stride,
            "steps": len(self.changes),
            "directions": self.covered,
            "mean_direction": self.one_way,
            "principal_shares": self.spread[0].tolist(),
            "length_cm_10_50_90_99": self.lengths_cm,
            "percentile_99": self.usual.tolist(),
            "back_share_xyz": (ways <= -_SHORT_CM).mean(axis=0).tolist(),
            "forth_share_xyz": (ways >= _SHORT_CM).mean(axis=0).tolist(),
            "gripper_share": self.gripper_share,
            "narrow": self.narrow,
        }


class VectorCoverage(Coverage):
    """Coverage of vectors' changes: of each number by itself, since how they move together is not known."""

    @property
    def is_known(self) -> bool:
        """Whether there are enough steps to tell whether they are narrow."""
        return self.is_enough(len(self.changes))

    @property
    def both_ways(self) -> list[int]:
        """The numbers that move, and both up and down in 5 % of the steps, by a tenth of their farthest or more."""
        back, forth = (sign * self.changes > _STEP * self.usual for sign in (-1, 1))
        both = np.minimum(back.mean(axis=0), forth.mean(axis=0)) >= _OFTEN
        return np.flatnonzero(both & (self.usual >= _HARDLY)).tolist()

    @property
    def still(self) -> list[int]:
        """The numbers that hardly move: 99 % of their changes are below 0.01."""
        return np.flatnonzero(self.usual < _HARDLY).tolist()

    @property
    def narrow(self) -> str:
        """Why the data are not fit to plan with; empty: they are, or there are too few steps to tell."""
        width = self.changes.shape[1]
        if not self.is_known or len(self.both_ways) > _HALF * width:
            return ""
        one_way = width - len(self.both_ways) - len(self.still)
        return f"{len(self.still)} of {width} numbers hardly move, {one_way} only one way"

    @property
    def lines(self) -> dict[str, str]:
        """What was found, by its name."""
        farthest = [f"{one:.2g}" for one in self.usual]
        return {
            "numbers": f"{len(self.both_ways)} of {len(farthest)} go up and down, {len(self.still)} hardly move",
            "changes": f"{PERCENTILE} % of the steps within {', '.join(farthest)}",
        }

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values."""
        return {
            "stride": self.stride,
            "steps": len(self.changes),
            "both_ways": self.both_ways,
            "still": self.still,
            "percentile_99": self.usual.tolist(),
            "narrow": self.narrow,
        }


def _shown(direction: Float[np.ndarray, " 3"]) -> str:
    numbers = np.round(direction, 1) + 0.0  # without -0.0
    return f"({', '.join(f'{name} {one:+.1f}' for name, one in zip('xyz', numbers, strict=True))})"
