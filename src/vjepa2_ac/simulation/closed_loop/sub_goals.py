"""Sub-goals of a problem from one demonstration of it: the oracle shows it once, in an arm of its own."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.demonstrations.key_frames import (
    OF_MODEL_STEPS,
    Timing,
    gripper_key_frames,
    sub_goals_of,
    with_frames_between,
)
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.closed_loop.policies import Oracle
from vjepa2_ac.simulation.closed_loop.rollout import run_episode
from vjepa2_ac.simulation.closed_loop.tasks import STEPS, TaskName, TaskProblem, arm_for
from vjepa2_ac.simulation.world.arm import SimulatedArm
from vjepa2_ac.simulation.world.camera import FRAME_SIZE
from vjepa2_ac.simulation.world.domains import Domain

_SMALL = (18, 32)  # height and width of images that nobody looks at


@dataclass(frozen=True)
class DemonstrationSpec:
    """How a demonstration is given, and for how long its key frames apply."""

    limits: LimitsConfig = field(default_factory=LimitsConfig)  # of the one who demonstrates, but for the gripper
    steps: int | None = None  # model steps; None: the task's default
    stride: int = 4  # control steps of a model step
    slack: int = 3  # model steps that a goal may take fewer or more than it took here
    share: float | None = None  # of each goal but the last; None: by count only
    every: int | None = None  # model steps between goals on the way to a key frame; None: only key frames are goals


def every_step(spec: DemonstrationSpec) -> DemonstrationSpec:
    """Return a spec with a goal for each model step of the demonstration, each for one step more than it took there."""
    return replace(spec, every=1, slack=1)


class DemonstratedGoals:
    """Makes the sub-goals of each problem of a task from one demonstration of it, in an arm of its own.

    They are the key frames of the demonstration: where the gripper changes, the arm stops, and the end. With `every` in
    the spec, also frames on the way to them.

    Args:
        task: The task.
        domain: Its world, the same as of the arm that the model moves.
        spec: How it is demonstrated.
        size: Height and width of the images.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """

    def __init__(
        self,
        task: TaskName,
        domain: Domain,
        spec: DemonstrationSpec | None = None,
        size: tuple[int, int] = FRAME_SIZE,
    ) -> None:
        self.spec = spec or DemonstrationSpec()
        self._arm, self._unseen = (arm_for(task, domain, size=one) for one in (size, _SMALL))

    def __call__(self, problem: TaskProblem) -> tuple[SubGoal, ...]:
        """Return the goals of a problem.

        Raises:
            InputError: As `demonstrate`.
        """
        frames, states = demonstrate(problem, self._arm, self.spec)
        keys = gripper_key_frames(states, OF_MODEL_STEPS)
        if self.spec.every is not None:
            keys = with_frames_between(keys, self.spec.every)
        images = [frames[key.frame] for key in keys]
        return sub_goals_of(images, keys, Timing(1, self.spec.slack, self.spec.share), states)

    def require(self, problems: Iterable[TaskProblem]) -> None:
        """Refuse problems of which one cannot be demonstrated, before any of them is worked on.

        Raises:
            InputError: As `demonstrate`.
        """
        for problem in problems:
            demonstrate(problem, self._unseen, self.spec)


def demonstrate(
    problem: TaskProblem, arm: SimulatedArm, spec: DemonstrationSpec
) -> tuple[UInt8[np.ndarray, "time height width 3"], Float[np.ndarray, "time 7"]]:
    """Let the oracle solve a problem; return what was seen and measured before the first model step and after each.

    Args:
        problem: The problem.
        arm: Of its task and in its domain, from `arm_for`; its pose does not matter, and is another one afterwards.
        spec: How.

    Raises:
        InputError: It does not succeed within these limits and steps.
    """
    limits = spec.limits.model_copy(update={"gripper_mode": "free", "gripper": LimitsConfig().gripper})
    steps = spec.steps or STEPS[problem.task]
    shown = run_episode(arm, Oracle(limits, arm), problem, steps, spec.stride, keep_frames=True)
    if not shown.success or shown.frames is None:
        where = f"demonstration of problem {problem.index} ({problem.task})"
        found = f"the oracle ends {100 * shown.distances_m[-1]:.1f} cm from the goal after {steps} model steps"
        fix = "Allow it longer steps along each axis (planning.limits.xyz, planning.limits.ball), or more of them"
        raise InputError(where=where, found=found, needed="a demonstration that succeeds", fix=fix)
    return shown.frames, shown.states
