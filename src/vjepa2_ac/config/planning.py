"""Config keys of planning: horizon, planner, limits and energy of a decision."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from vjepa2_ac.config.section import (
    OFF,
    Component,
    ComponentOf,
    Local,
    NonNegative,
    Positive,
    PositiveInt,
    Section,
    ZeroToOne,
)
from vjepa2_ac.errors import InputError
from vjepa2_ac.registry import ENERGIES, PLANNERS

Place = Annotated[float, Field(ge=-5.0, le=5.0)]  # along an axis of the base frame, in metres; no arm reaches farther
Corner = tuple[Place, Place, Place]
ELITES = 10  # of the planners cem and icem, unless their option says another number
Metre = ZeroToOne  # no arm moves farther in a model step: more would be millimetres


class LimitsConfig(Section):
    """Limits of every action, independent of the model. All per model step; `action_repeat` repeats it."""

    xyz: Literal["data"] | tuple[Metre, Metre, Metre] = (0.05, 0.05, 0.05)
    """Largest dx, dy, dz in metres, 1 at most; 0 holds an axis. Upstream's notebooks use 0.05 to 0.075. data: what the
    run was taught, the 99th percentile along each axis."""
    l1: Positive | None = None
    """Largest sum of the absolute dx, dy and dz in metres; longer motions are scaled down. The paper's planner has
    0.075 and no other limit of the position. null: none."""
    workspace: tuple[Corner, Corner] | None = None
    """Corners (lowest and highest x, y, z, in metres) of the box in which every target of the flange lies: an action is
    cut; a robot that is outside by more than one step does not move. Of poses in the base frame."""
    rotation: Annotated[float, Field(ge=0.0, le=math.pi)] = 0.0
    """Largest turn about each axis, in radians; 0: the rotation is held, as upstream does."""
    axes: Literal["data"] | Annotated[tuple[NonNegative, ...], Field(min_length=1)] = "data"
    """Of vectors only: the largest change of each number, in its own unit; one number stands for all. data: what the
    run was taught, the 99th percentile of each number's change."""
    gripper: ZeroToOne = 0.75
    """Largest change of the gripper's closedness."""
    gripper_mode: Literal["rounded", "free", "held", "open", "close"] = "rounded"
    """rounded: changes below 0.25 of a finished plan become zero, as upstream. free: left as they are. held: no change.
    open, close: a change of -1 or 1 in every model step, whatever `gripper` says; rounded before."""

    @property
    def xyz_m(self) -> tuple[float, float, float]:
        """The largest dx, dy, dz in metres.

        Raises:
            InputError: They are those of the data, and no run has said which.
        """
        if isinstance(self.xyz, tuple):
            return self.xyz
        found = "data, of a model or an older run, which does not say what it was taught"
        needed = "the largest dx, dy, dz in metres, such as planning.limits.xyz=[0.05,0.05,0.05]"
        fix = "`vjepa2-ac data inspect CONFIG` shows how far 99 % of the steps in your data go (line `axes`)"
        raise InputError(where="planning.limits.xyz", found=found, needed=needed, fix=fix)

    @model_validator(mode="after")
    def _workspace_has_room(self) -> LimitsConfig:
        low, high = self.workspace or ((0, 0, 0), (1, 1, 1))
        is_broken = any(one >= other for one, other in zip(low, high, strict=True))
        return self.refused((is_broken, f"workspace: the corner {low} is not below {high} on every axis"))

    @model_validator(mode="after")
    def _something_is_free(self) -> LimitsConfig:
        held = self.gripper_mode in {"held", "open", "close"} or not self.gripper
        is_broken = not any(self.xyz) and not self.rotation and held
        return self.refused((is_broken, "nothing is left to plan: xyz, rotation and gripper are all held"))


class EnergyConfig(Section):
    """Distance of a prediction from the goal."""

    distance: Annotated[Component, ComponentOf(ENERGIES, "l1")] = Component("l1")
    """Of predicted and goal latents. l1: mean absolute difference (upstream). l2: mean square. cosine: 1 - cosine of a
    token. Or an energy of your own (docs/extending.md)."""
    steps: Literal["last", "sum"] = "last"
    """last: of the plan's last step (upstream). sum: over all its steps."""
    samples_at_once: PositiveInt = 64
    """Action sequences that go through the predictor at once: bounds its memory."""


class PlanningConfig(Section):
    """One decision: from the current frame to an action."""

    planner: Annotated[Component, ComponentOf(PLANNERS, "cem")] = Component("cem")
    """How actions are searched: cem, icem, mppi, gradient, or a planner of your own (docs/extending.md). prior: not at
    all, the mean of `prior` is taken."""
    horizon: PositiveInt = 1
    """Model steps that a plan spans."""
    action_repeat: PositiveInt = 1
    """Model steps for which a plan repeats an action; the horizon is a multiple of it. Each step is decided anew."""
    samples: Annotated[int, Field(ge=2)] = 800
    """Action sequences an iteration; the planner gradient has its option `starts` instead."""
    iterations: PositiveInt = 10
    """Iterations of sampling and fitting."""
    budget_s: Positive | None = None
    """Seconds of search after which the best plan so far is taken: no iteration begins that would not end by then. The
    first always runs. Encoding the frame is not counted. null: all iterations run."""
    prior: Local | None = None
    """Folder of an action prior (`vjepa2-ac prior`), of which every search starts: from its mean, as wide as it is
    unsure."""
    monitor: Local | None = None
    """A monitor.json (`vjepa2-ac monitor`): each frame is compared with what the last decision predicted."""
    warm_start: bool = False
    """Whether a decision starts from the last one's plan, shifted by the steps executed. Not at horizon 1, where the
    plan is the last action only: the arm overshoots (docs/decisions.md)."""
    views: Annotated[int, Field(ge=1, le=4)] = 1
    """Cameras whose pictures stand side by side in every image, all of one width: the model sees each by itself, and
    the energy is the mean over them. One view leaves a direction in which near and far look alike. The model has to
    know all of them: `data.camera` of several."""
    compile: Annotated[Literal["off", "blocks"], OFF] = "off"
    """blocks: torch.compile for the predictor's blocks; needs a C compiler, and a minute within the first decision. The
    same energies to rounding."""
    axes: Local | None = None
    """Calibrated axes of the model (`data calibrate --axes`, its axes.json): it is given what the robot does turned by
    their angle, as its training camera would have seen it. Of poses in the base frame."""
    limits: LimitsConfig = LimitsConfig()
    """Limits of every action."""
    energy: EnergyConfig = EnergyConfig()
    """Distance of a prediction from the goal."""

    @model_validator(mode="after")
    def _numbers_fit(self) -> PlanningConfig:
        views, repeat, elites = self.views > 1, self.action_repeat, self.planner.options.get("elites", ELITES)
        few_samples = self.planner.name in {"cem", "icem"} and elites > self.samples
        fix = "or set views: 1"
        return self.refused(
            (self.horizon % repeat, f"horizon {self.horizon} is not a multiple of action_repeat {repeat}"),
            (few_samples, f"planner {self.planner.name}: {elites} elites are more than {self.samples} samples"),
            (views and self.axes, f"views excludes axes, which are calibrated with one camera. Leave axes out, {fix}"),
            (views and self.prior, f"views excludes prior, which is trained with one camera. Leave prior out, {fix}"),
            (
                views and self.monitor,
                f"views excludes monitor, which is made with one camera. Leave monitor out, {fix}",
            ),
            (self.prior and self.warm_start, "prior excludes warm_start: each is the start of a search. Leave one out"),
            (
                self.planner.name == "prior" and not self.prior,
                "planner=prior needs prior; `vjepa2-ac prior` trains one",
            ),
        )
