"""Config keys of planning: horizon, planner, limits and energy of a decision."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from vjepa2_ac.config.section import (
    OFF,
    Component,
    ComponentOf,
    LocalPath,
    NonNegative,
    Positive,
    PositiveInt,
    Section,
    ZeroToOne,
)
from vjepa2_ac.errors import InputError
from vjepa2_ac.registry import ENERGIES, PLANNERS

Coordinate = Annotated[float, Field(ge=-5.0, le=5.0)]  # coordinate in the base frame in metres; no arm reaches farther
Corner = tuple[Coordinate, Coordinate, Coordinate]
ELITES = 10  # default of the option `elites` of the planners cem and icem
PRESETS = {"fast": {"samples": 64, "iterations": 4}, "paper": {"samples": 800, "iterations": 10}}
"""Sizes of a search by name, for the override `planning.preset=NAME`. docs/planning.md compares them."""
Metre = ZeroToOne  # no arm moves farther than 1 m in a model step; larger values are probably millimetres


class LimitsConfig(Section):
    """Limits of every action, independent of the model. All limits apply to one model step."""

    xyz: Literal["data"] | tuple[Metre, Metre, Metre] = (0.05, 0.05, 0.05)
    """Largest dx, dy, dz in metres, 1 at most; 0 fixes an axis. Upstream's notebooks use 0.05 to 0.075. data: the 99th
    percentile of the motions in the training data, along each axis."""
    l1: Positive | None = None
    """Largest sum of the absolute dx, dy and dz in metres; longer motions are scaled down. The planner in the paper
    uses 0.075. null: no such limit."""
    workspace: tuple[Corner, Corner] | None = None
    """Corners (lowest and highest x, y, z, in metres) of a box for the flange; null: none. Actions are shortened so
    that every target is inside. A robot that is outside by more than one step does not move. Only for poses in the base
    frame."""
    rotation: Annotated[float, Field(ge=0.0, le=math.pi)] = 0.0
    """Largest rotation about each axis, in radians; 0: the rotation is fixed, as upstream."""
    axes: Literal["data"] | Annotated[tuple[NonNegative, ...], Field(min_length=1)] = "data"
    """Only for vectors: the largest change of each number, in the unit of the number; a single value holds for all
    numbers. data: the 99th percentile of each number's change in the training data."""
    gripper: ZeroToOne = 0.75
    """Largest change of the gripper position."""
    gripper_mode: Literal["rounded", "free", "held", "open", "close"] = "rounded"
    """rounded: changes below 0.25 in the final plan are set to zero, as upstream. free: changes are not modified. held:
    no change. open, close: a change of -1 or 1 in every model step, independent of `gripper`."""

    @property
    def xyz_m(self) -> tuple[float, float, float]:
        """The largest dx, dy, dz in metres.

        Raises:
            InputError: `xyz` is data, and no run has recorded the motions of its training data.
        """
        if isinstance(self.xyz, tuple):
            return self.xyz
        problem = "data, for a model or an older run without a record of the motions in its training data"
        needed = "the largest dx, dy, dz in metres, such as planning.limits.xyz=[0.05,0.05,0.05]"
        fix = "`vjepa2-ac data inspect CONFIG` shows the 99th percentile of the motions in your data (line `axes`)"
        raise InputError(where="planning.limits.xyz", found=problem, needed=needed, fix=fix)

    @model_validator(mode="after")
    def _workspace_has_room(self) -> LimitsConfig:
        low, high = self.workspace or ((0, 0, 0), (1, 1, 1))
        is_broken = any(lowest >= highest for lowest, highest in zip(low, high, strict=True))
        return self.check_rules((is_broken, f"workspace: the corner {low} is not below {high} on every axis"))

    @model_validator(mode="after")
    def _something_is_free(self) -> LimitsConfig:
        is_gripper_fixed = self.gripper_mode in {"held", "open", "close"} or not self.gripper
        is_broken = not any(self.xyz) and not self.rotation and is_gripper_fixed
        return self.check_rules((is_broken, "nothing can be planned: xyz, rotation and gripper are all fixed"))


class EnergyConfig(Section):
    """Energy of a plan: the distance between prediction and goal."""

    distance: Annotated[Component, ComponentOf(ENERGIES, "l1")] = Component("l1")
    """Distance between predicted and goal latents. l1: mean absolute difference (upstream). l2: mean squared
    difference. cosine: 1 - cosine similarity of each token. Or the name of your energy (docs/extending.md)."""
    steps: Literal["last", "sum"] = "last"
    """last: the distance after the last step of the plan (upstream). sum: the sum over all steps."""
    samples_at_once: PositiveInt = 64
    """Number of action sequences per forward pass of the predictor; limits the memory."""


class PlanningConfig(Section):
    """How an action is planned from the current frame."""

    planner: Annotated[Component, ComponentOf(PLANNERS, "cem")] = Component("cem")
    """The optimiser of the actions: cem, icem, mppi, gradient, or the name of your planner (docs/extending.md). prior:
    no search, the plan is the mean of `prior`."""
    horizon: PositiveInt = 1
    """Number of model steps in a plan."""
    action_repeat: PositiveInt = 1
    """Number of model steps for which a plan repeats each action; the horizon must be a multiple of it. A new plan is
    made at every model step."""
    samples: Annotated[int, Field(ge=2)] = PRESETS["fast"]["samples"]
    """Number of action sequences per iteration; the planner gradient has the option `starts` instead. The paper uses
    800; the override planning.preset=paper sets samples and iterations."""
    iterations: PositiveInt = PRESETS["fast"]["iterations"]
    """Number of iterations of sampling and fitting. The paper uses 10."""
    budget_s: Positive | None = None
    """Time limit of a search in seconds: an iteration that would end later is not started, and the best plan so far is
    used. The first iteration always runs. Encoding the frame does not count. null: all iterations run."""
    prior: LocalPath | None = None
    """Folder of an action prior (`vjepa2-ac prior`): every search starts from the mean and standard deviation that it
    predicts."""
    monitor: LocalPath | None = None
    """A monitor.json (`vjepa2-ac monitor`): each frame is compared with the prediction of the last decision."""
    warm_start: bool = False
    """Whether a search starts from the previous plan, shifted by the executed steps. Not recommended with horizon 1,
    where the previous plan is only the previous action: the arm overshoots (docs/decisions.md)."""
    views: Annotated[int, Field(ge=1, le=4)] = 1
    """Number of cameras whose images are side by side in every frame, all of one width. The model predicts each view
    separately, and the energy is the mean over the views. A single view contains little information about depth. The
    model must be trained on all views (`data.camera` with several names)."""
    compile: Annotated[Literal["off", "blocks"], OFF] = "off"
    """blocks: torch.compile for the predictor's blocks. Needs a C compiler; the first decision takes a minute longer.
    Energies are equal up to rounding."""
    axes: LocalPath | None = None
    """Calibrated axes of the model: the axes.json of `data calibrate --axes`. Actions and poses are rotated by the
    calibrated angle before the model receives them. Only for poses in the base frame."""
    limits: LimitsConfig = LimitsConfig()
    """Limits of every action."""
    energy: EnergyConfig = EnergyConfig()
    """Energy of a plan: the distance between prediction and goal."""

    @model_validator(mode="after")
    def _numbers_fit(self) -> PlanningConfig:
        views, repeat, elites = self.views > 1, self.action_repeat, self.planner.options.get("elites", ELITES)
        few_samples = self.planner.name in {"cem", "icem"} and elites > self.samples
        fix = "or set views: 1"
        return self.check_rules(
            (self.horizon % repeat, f"horizon {self.horizon} is not a multiple of action_repeat {repeat}"),
            (few_samples, f"planner {self.planner.name}: {elites} elites are more than {self.samples} samples"),
            (
                views and self.axes,
                f"axes are calibrated with one camera, and views is {self.views}. Remove axes, {fix}",
            ),
            (views and self.prior, f"prior is trained with one camera, and views is {self.views}. Remove prior, {fix}"),
            (
                views and self.monitor,
                f"monitor is made with one camera, and views is {self.views}. Remove monitor, {fix}",
            ),
            (self.prior and self.warm_start, "prior and warm_start both set the start of a search. Remove one of them"),
            (
                self.planner.name == "prior" and not self.prior,
                "planner=prior needs prior; `vjepa2-ac prior` trains one",
            ),
        )
