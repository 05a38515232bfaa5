"""The workspace: a box in the base frame that no target leaves (`planning.limits.workspace`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.spaces import StateSpace

_ROUNDING = 1e-8  # metres: actions are float32, and no robot measures it
_HALVINGS = 30


@dataclass(frozen=True)
class Workspace:
    """A box for the flange's position."""

    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]

    @classmethod
    def of(cls, limits: LimitsConfig, space: StateSpace) -> Workspace | None:
        """Return the box of these limits; None: there is none.

        Raises:
            InputError: States are no poses in the base frame.
        """
        if limits.workspace is None:
            return None
        if not space.is_base_pose:
            found = "a model whose states are not poses in the robot base frame"
            fix = "Bound a vector by planning.limits.axes, and by the limits of the robot's own controller"
            raise InputError(where="planning.limits.workspace", found=found, needed="no box", fix=fix)
        return cls(*(np.array(corner, dtype=np.float64) for corner in limits.workspace))

    def contains(self, position: Float[np.ndarray, " 3"]) -> bool:
        """Return whether a position is inside, to rounding."""
        return bool((position >= self.low - _ROUNDING).all() and (position <= self.high + _ROUNDING).all())

    def narrowed(self, space: SearchSpace, state: Float[np.ndarray, " 7"]) -> SearchSpace:
        """Return the search space whose first decision stays inside, for each of the model steps it is repeated.

        From outside, along an axis, no motion farther outwards is searched; `kept` then asks for the way back.
        """
        lower, upper = space.lower.clone(), space.upper.clone()
        room_down = torch.from_numpy(np.minimum(self.low - state[:3], 0.0)).float() / space.repeat
        room_up = torch.from_numpy(np.maximum(self.high - state[:3], 0.0)).float() / space.repeat
        lower[0, :3] = torch.maximum(lower[0, :3], room_down)
        upper[0, :3] = torch.minimum(upper[0, :3], room_up)
        return replace(space, lower=lower, upper=upper)

    def is_near(self, state: Float[np.ndarray, " 7"], limits: LimitsConfig) -> bool:
        """Return whether one action leads back inside; true of a robot that is inside."""
        return _is_allowed(self._way_back(state[:3]), limits)

    def kept(
        self, state: Float[np.ndarray, " 7"], actions: Float[np.ndarray, "steps 7"], limits: LimitsConfig
    ) -> Float[np.ndarray, "steps 7"]:
        """Return actions whose targets are all inside.

        A target is moved to the nearest place inside; where that is more than an action may be, towards the way back.

        Args:
            state: Where the robot is.
            actions: Changes of each model step, within the limits.
            limits: Of an action.

        Raises:
            ValueError: The robot is not near the box: nothing should be done at all.
        """
        if not self.is_near(state, limits):
            raise ValueError(f"{state[:3]} is farther from the workspace than an action leads")
        kept, position = np.array(actions, dtype=np.float64), np.array(state[:3], dtype=np.float64)
        for action in kept:
            way = np.clip(position + action[:3], self.low, self.high) - position
            if abs(way - action[:3]).max() > _ROUNDING:
                action[:3] = _within(limits, self._way_back(position), way)
            position = position + action[:3]
        return kept

    def _way_back(self, position: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """Return the shortest way inside; zeros from there."""
        return np.asarray(np.clip(position, self.low, self.high) - position)


def _within(
    limits: LimitsConfig, sure: Float[np.ndarray, " 3"], wanted: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 3"]:
    """Return the last way from an allowed one to a wanted one that is allowed, too: limits are convex."""
    if _is_allowed(wanted, limits):
        return wanted
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if _is_allowed(sure + middle * (wanted - sure), limits) else (low, middle)
    return np.asarray(sure + low * (wanted - sure))


def _is_allowed(way: Float[np.ndarray, " 3"], limits: LimitsConfig) -> bool:
    if (abs(way) > np.array(limits.xyz_m) + _ROUNDING).any():
        return False
    order = 1 if limits.ball == "l1" else 2
    return limits.ball == "none" or bool(np.linalg.norm(way, ord=order) <= limits.radius + _ROUNDING)
