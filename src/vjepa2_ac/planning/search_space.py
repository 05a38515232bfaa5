"""The action space: limits per axis, a norm ball, fixed axes, and rounding of a finished plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import StateSpace

GRIPPER = 6  # of a pose
_ROUNDING = 4 * torch.finfo(torch.float32).eps  # a norm is rounded more than once


@dataclass(frozen=True)
class Ball:
    """A ball around no motion, over the first numbers of an action."""

    norm: Literal["l1", "l2"]
    radius: float
    axes: int = 3


@dataclass(frozen=True)
class SearchSpace:
    """Limits of each component of each decision; where both limits are equal, it is fixed.

    Raises:
        ValueError: Limits cross or are not finite, or there is a ball and zero motion is not allowed.
    """

    lower: Float[Tensor, "decisions dim"]
    upper: Float[Tensor, "decisions dim"]
    std: Float[Tensor, "decisions dim"]  # of first samples
    repeat: int = 1  # model steps of a decision
    ball: Ball | None = None
    gripper: int | None = None  # which number, where one is
    gripper_rounding: float = 0.0  # changes below this are set to zero in a finished plan

    def __post_init__(self) -> None:
        if not (torch.isfinite(self.lower) & torch.isfinite(self.upper) & (self.lower <= self.upper)).all():
            raise ValueError("limits must be finite, the lower ones not above the upper ones")
        if self.ball is not None:
            inside = (self.lower <= 0) & (self.upper >= 0)
            if not inside[:, : self.ball.axes].all():
                raise ValueError("a ball is around no motion, which the limits do not allow")

    @property
    def decisions(self) -> int:
        """Number of chosen actions."""
        return int(self.lower.shape[0])

    @property
    def dim(self) -> int:
        """Components of an action."""
        return int(self.lower.shape[1])

    @property
    def steps(self) -> int:
        """Model steps of a plan."""
        return self.decisions * self.repeat

    @property
    def free(self) -> Tensor:
        """Components that are not fixed, in at least one decision: indices along dim."""
        return (self.lower < self.upper).any(dim=0).nonzero()[:, 0]

    @property
    def first_std(self) -> Float[Tensor, "decisions dim"]:
        """The standard deviation of the first samples, zero where a component is fixed."""
        return torch.where(self.lower < self.upper, self.std, 0.0)

    def allowed(self, decisions: Float[Tensor, "*batch decisions dim"]) -> Float[Tensor, "*batch decisions dim"]:
        """Return each decision, or its projection onto the allowed set; the result is always allowed, even for NaN.

        First to the limits of each axis, then scaled towards zero motion until it is within the ball.
        """
        cut = torch.nan_to_num(decisions, nan=0.0).clamp(self.lower, self.upper)
        if self.ball is None:
            return cut
        inner, outer = cut[..., : self.ball.axes], cut[..., self.ball.axes :]
        length = torch.linalg.vector_norm(inner, ord=1 if self.ball.norm == "l1" else 2, dim=-1, keepdim=True)
        share = self.ball.radius * (1 - _ROUNDING) / length
        return torch.cat([torch.where(share < 1, inner * share, inner), outer], dim=-1)

    def finished(self, decisions: Float[Tensor, "decisions dim"]) -> Float[Tensor, "decisions dim"]:
        """Return decisions as a robot receives them: allowed, with small changes of the gripper rounded to zero.

        Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, round_small_elements.
        """
        done = self.allowed(decisions)
        if self.gripper is not None:
            one = done[:, self.gripper]
            done[:, self.gripper] = torch.where(one.abs() < self.gripper_rounding, 0.0, one)
        return done

    def over_steps(self, decisions: Float[Tensor, "*batch decisions dim"]) -> Float[Tensor, "*batch steps dim"]:
        """Return the action of each model step."""
        return decisions.repeat_interleave(self.repeat, dim=-2)


def pose_space(config: PlanningConfig) -> SearchSpace:
    """Return the allowed actions of an arm: dx, dy, dz, three rotations, gripper (legend: `vjepa2_ac.episode`)."""
    limits, decisions = config.limits, config.horizon // config.action_repeat
    gripper = 0.0 if limits.gripper_mode == "held" else limits.gripper
    reach = _towards_zero([*limits.xyz_m, *[limits.rotation] * 3, gripper])
    upper = reach.repeat(decisions, 1)
    lower = -upper
    if limits.gripper_mode in {"open", "close"}:
        first = limits.gripper_from // config.action_repeat
        lower[first:, GRIPPER] = upper[first:, GRIPPER] = 1.0 if limits.gripper_mode == "close" else -1.0
    std = config.start_std * reach
    std[GRIPPER] = config.gripper_start_std
    return SearchSpace(
        lower=lower,
        upper=upper,
        std=std.repeat(decisions, 1),
        repeat=config.action_repeat,
        ball=None if limits.ball == "none" else Ball(limits.ball, limits.radius),
        gripper=GRIPPER,
        gripper_rounding=_rounding(limits),
    )


def search_space(config: PlanningConfig, space: StateSpace) -> SearchSpace:
    """Return the allowed changes of a state: of a pose within the limits of an arm, of a vector within `limits.axes`.

    Raises:
        InputError: There are no limits for vectors, or not one for each number.
    """
    return pose_space(config) if space.is_pose else vector_space(config, len(space))


def vector_space(config: PlanningConfig, width: int) -> SearchSpace:
    """Return the allowed changes of a vector: each number by `limits.axes` at most, up and down."""
    limits, decisions = config.limits.axes, config.horizon // config.action_repeat
    if not isinstance(limits, tuple) or len(limits) not in {1, width}:
        raise InputError(
            where="planning.limits.axes",
            found="data, of a model that does not say what it was taught" if limits == "data" else f"{limits}",
            needed=f"the largest change of each of the {width} numbers in a model step; or one number for all",
            fix="Such as planning.limits.axes=[0.05]; a run keeps what it was taught, and then data means that",
        )
    upper = _towards_zero(list(limits) * (width // len(limits))).repeat(decisions, 1)
    return SearchSpace(lower=-upper, upper=upper, std=config.start_std * upper, repeat=config.action_repeat)


def _rounding(limits: LimitsConfig) -> float:
    return 0.0 if limits.gripper_mode == "free" else limits.gripper_rounding


def _towards_zero(values: list[float]) -> Float[Tensor, " dim"]:
    """Return values in float32, rounded towards smaller ones: float32's 0.05 is above 0.05."""
    exact = torch.tensor(values, dtype=torch.float64)
    nearest = exact.float()
    return torch.where(nearest.double() > exact, torch.nextafter(nearest, torch.zeros_like(nearest)), nearest)
