"""The search space of actions: limits of each component and of the L1 norm, rounding of the gripper, a workspace."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import StateSpace

GRIPPER = 6  # of a pose
GRIPPER_ROUNDING = 0.25  # smaller changes of gripper position become zero
_ROUNDING = 4 * torch.finfo(torch.float32).eps  # margin for the rounding errors of a norm


@dataclass(frozen=True)
class SearchSpace:
    """Lower and upper limits of each component of each decision; a component whose limits are equal is fixed.

    The limits are finite, and no lower limit is above its upper limit. If `l1` is set, they include zero motion.
    """

    lower: Float[Tensor, "decisions dim"]
    upper: Float[Tensor, "decisions dim"]
    std: Float[Tensor, "decisions dim"]  # standard deviation of the first samples; planners scale it by `start_std`
    repeat: int = 1  # number of model steps for which a decision is repeated
    l1: float | None = None  # the largest sum of the absolute dx, dy and dz
    gripper: int | None = None  # index of the gripper in an action; None: unknown
    gripper_rounding: float = 0.0  # in a finished plan smaller changes are set to zero

    @property
    def decisions(self) -> int:
        """Number of actions that the search chooses."""
        return int(self.lower.shape[0])

    @property
    def dim(self) -> int:
        """Number of components of an action."""
        return int(self.lower.shape[1])

    @property
    def steps(self) -> int:
        """Number of model steps of a plan."""
        return self.decisions * self.repeat

    @property
    def free(self) -> Tensor:
        """Indices of the components that at least one decision can change."""
        return (self.lower < self.upper).any(dim=0).nonzero()[:, 0]

    @property
    def first_std(self) -> Float[Tensor, "decisions dim"]:
        """The standard deviation of the first samples, zero where a component is fixed."""
        return torch.where(self.lower < self.upper, self.std, 0.0)

    def clip(self, decisions: Float[Tensor, "*batch decisions dim"]) -> Float[Tensor, "*batch decisions dim"]:
        """Return decisions clipped to the limits; NaN becomes the allowed value that is closest to zero.

        If dx, dy and dz exceed the limit of the L1 norm, they are scaled down together.
        """
        clipped = torch.nan_to_num(decisions, nan=0.0).clamp(self.lower, self.upper)
        if self.l1 is None:
            return clipped
        length = clipped[..., :3].abs().sum(dim=-1, keepdim=True)
        length = length.clamp(min=torch.finfo(length.dtype).tiny)  # avoids a division by zero
        scale = (self.l1 * (1 - _ROUNDING) / length).clamp(max=1.0)
        return torch.cat([clipped[..., :3] * scale, clipped[..., 3:]], dim=-1)

    def finalize(self, decisions: Float[Tensor, "decisions dim"]) -> Float[Tensor, "decisions dim"]:
        """Return decisions as a robot receives them: within the limits, with small gripper changes set to zero.

        Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, round_small_elements.
        """
        rounded = self.clip(decisions)
        if self.gripper is not None:
            gripper = rounded[:, self.gripper]
            rounded[:, self.gripper] = torch.where(gripper.abs() < self.gripper_rounding, 0.0, gripper)
        return rounded

    def repeat_over_steps(self, decisions: Float[Tensor, "*batch decisions dim"]) -> Float[Tensor, "*batch steps dim"]:
        """Return the action of each model step."""
        return decisions.repeat_interleave(self.repeat, dim=-2)


def make_search_space(config: PlanningConfig, space: StateSpace) -> SearchSpace:
    """Return the allowed changes of a state: poses within the limits of an arm, vectors within `limits.axes`.

    Raises:
        InputError: There are no limits for a vector, or their number is wrong.
    """
    if space.is_pose:
        return make_pose_search_space(config)
    limits, width = config.limits.axes, len(space)
    if not isinstance(limits, tuple) or len(limits) not in {1, width}:
        without_record = "data, but the model has no record of the motions in its training data"
        problem = without_record if limits == "data" else f"{limits}"
        needed = (
            f"the largest change in a model step for each of the {width} numbers, or one value for all, such as [0.05]"
        )
        raise InputError(where="planning.limits.axes", found=problem, needed=needed)
    upper = _round_towards_zero(list(limits) * (width // len(limits))).repeat(config.horizon // config.action_repeat, 1)
    return SearchSpace(-upper, upper, upper, config.action_repeat)


def make_pose_search_space(config: PlanningConfig) -> SearchSpace:
    """Return the allowed actions of an arm: dx, dy, dz, three rotations, gripper (see `vjepa2_ac.episode`)."""
    limits, decisions = config.limits, config.horizon // config.action_repeat
    gripper = 0.0 if limits.gripper_mode == "held" else limits.gripper
    largest = _round_towards_zero([*limits.xyz_m, *[limits.rotation] * 3, gripper])
    upper = largest.repeat(decisions, 1)
    lower = -upper
    if limits.gripper_mode in {"open", "close"}:
        lower[:, GRIPPER] = upper[:, GRIPPER] = 1.0 if limits.gripper_mode == "close" else -1.0
    std = largest.clone()
    std[GRIPPER] = 1.0  # as upstream: many samples exceed the gripper's limit and are clipped to it
    return SearchSpace(
        lower=lower,
        upper=upper,
        std=std.repeat(decisions, 1),
        repeat=config.action_repeat,
        l1=limits.l1,
        gripper=GRIPPER,
        gripper_rounding=0.0 if limits.gripper_mode == "free" else GRIPPER_ROUNDING,
    )


def _round_towards_zero(values: list[float]) -> Float[Tensor, " dim"]:
    """Return values in float32, rounded towards zero: the float32 number nearest to 0.05 exceeds a limit of 0.05."""
    exact = torch.tensor(values, dtype=torch.float64)
    nearest = exact.float()
    return torch.where(nearest.double() > exact, torch.nextafter(nearest, torch.zeros_like(nearest)), nearest)


_NEAR_M = 1e-8  # metres; the rounding error of float32 actions, far below the resolution of a robot


@dataclass(frozen=True)
class Workspace:
    """The box in which the flange must stay."""

    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]

    @classmethod
    def from_limits(cls, limits: LimitsConfig, space: StateSpace) -> Workspace | None:
        """Return the box of `planning.limits.workspace`; None: no box is set.

        Raises:
            InputError: The states are not poses in the base frame.
        """
        if limits.workspace is None:
            return None
        if not space.is_base_pose:
            problem = "a model whose states are not poses in the robot base frame"
            fix = "Limit vector states with planning.limits.axes and in the robot's own controller"
            raise InputError(where="planning.limits.workspace", found=problem, needed="no workspace", fix=fix)
        return cls(*(np.array(corner, dtype=np.float64) for corner in limits.workspace))

    def narrow(self, space: SearchSpace, state: Float[np.ndarray, " 7"]) -> SearchSpace:
        """Return a search space in which the first decision, including its repetitions, stays inside the box.

        If the position is outside the box along an axis, motions further out are excluded. `clip_actions` adds the
        motion back into the box.
        """
        lower, upper = space.lower.clone(), space.upper.clone()
        lowest = torch.from_numpy(np.minimum(self.low - state[:3], 0.0)).float() / space.repeat
        highest = torch.from_numpy(np.maximum(self.high - state[:3], 0.0)).float() / space.repeat
        lower[0, :3] = torch.maximum(lower[0, :3], lowest)
        upper[0, :3] = torch.minimum(upper[0, :3], highest)
        return replace(space, lower=lower, upper=upper)

    def clip_actions(
        self, state: Float[np.ndarray, " 7"], actions: Float[np.ndarray, "steps 7"], limits: LimitsConfig
    ) -> Float[np.ndarray, "steps 7"]:
        """Return actions whose target positions are all inside the box.

        The robot must be inside, or near enough for one action to bring it inside. A target outside the box is replaced
        by the nearest position inside. If the action then exceeds its limits, it is shortened so that it still ends
        inside.

        Args:
            state: The state of the robot.
            actions: Changes of the state in each model step, within the limits.
            limits: The limits of an action.
        """
        clipped, position = np.array(actions, dtype=np.float64), np.array(state[:3], dtype=np.float64)
        largest = np.array(limits.xyz_m)
        for action in clipped:
            motion = np.clip(position + action[:3], self.low, self.high) - position
            if abs(motion - action[:3]).max() > _NEAR_M:
                action[:3] = _shorten_to_l1(
                    np.clip(motion, -largest, largest), self.get_return_motion(position), limits.l1
                )
            position = position + action[:3]
        return clipped

    def get_return_motion(self, position: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return the shortest motion from a position into the box; zeros for a position inside."""
        return np.asarray(np.clip(position, self.low, self.high) - position)


def _shorten_to_l1(
    motion: Float[np.ndarray, " 3"], shortest: Float[np.ndarray, " 3"], l1: float | None
) -> Float[np.ndarray, " 3"]:
    """Return a motion into the workspace, shortened to the limit of its L1 norm so that it still ends inside.

    Only the difference from `shortest` is scaled. It has the same sign as `shortest` along each axis, so their L1 norms
    add up to that of the motion.

    Args:
        motion: From a position to a position inside.
        shortest: The shortest motion from the same position to a position inside; within the limit.
        l1: The limit of the L1 norm in metres; None: no limit.
    """
    if l1 is None:
        return motion
    remaining = motion - shortest
    allowed, length = l1 - abs(shortest).sum(), abs(remaining).sum()
    return np.asarray(shortest + remaining * min(1.0, max(allowed, 0.0) / max(length, _NEAR_M)))


def is_within_limits(motion: Float[np.ndarray, "*batch 3"], limits: LimitsConfig, slack_m: float = _NEAR_M) -> bool:
    """Return whether motions of the flange are within the limits along each axis and of the L1 norm."""
    max_l1 = np.inf if limits.l1 is None else limits.l1
    return bool(
        (abs(motion) <= np.array(limits.xyz_m) + slack_m).all() and (abs(motion).sum(-1) <= max_l1 + slack_m).all()
    )
