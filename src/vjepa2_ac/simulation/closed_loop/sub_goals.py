"""Sub-goals of a problem from one demonstration of it: the oracle shows it once, in an arm of its own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.demonstrations.key_frames import (
    OF_MODEL_STEPS,
    Timing,
    gripper_key_frames,
    sub_goals_of,
    with_frames_between,
)
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.closed_loop.policies import oracle_for
from vjepa2_ac.simulation.closed_loop.rollout import run_episode
from vjepa2_ac.simulation.closed_loop.tasks import STEPS, TaskName, TaskProblem, arm_for
from vjepa2_ac.simulation.world.arm import SimulatedArm
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


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What was seen and measured: before the first model step, then after each."""

    frames: UInt8[np.ndarray, "time height width 3"]
    states: Float[np.ndarray, "time 7"]


def every_step(spec: DemonstrationSpec) -> DemonstrationSpec:
    """Return a spec with a goal for each model step of the demonstration, each for one step more than it took there."""
    return replace(spec, every=1, slack=1)


class DemonstratedGoals:
    """Makes the sub-goals of each problem of a task from one demonstration of it, in an arm of its own.

    Args:
        task: The task.
        domain: Its world, the same as of the arm that is steered.
        spec: How it is demonstrated.

    Raises:
        InputError: MuJoCo is not installed, or OpenGL does not work here.
    """

    def __init__(self, task: TaskName, domain: Domain, spec: DemonstrationSpec | None = None) -> None:
        self.spec = spec or DemonstrationSpec()
        self._arm = arm_for(task, domain)
        self._unseen = arm_for(task, domain, size=_SMALL)

    def __call__(self, problem: TaskProblem) -> tuple[SubGoal, ...]:
        """Return the goals of a problem.

        Raises:
            InputError: As `demonstrate`.
        """
        return goals_of_demonstration(problem, self._arm, self.spec)

    def require(self, problems: Iterable[TaskProblem]) -> None:
        """Refuse problems of which one cannot be demonstrated, before any of them is worked on.

        Raises:
            InputError: As `demonstrate`.
        """
        for problem in problems:
            demonstrate(problem, self._unseen, self.spec)


def demonstrate(problem: TaskProblem, arm: SimulatedArm, spec: DemonstrationSpec) -> Demonstration:
    """Let the oracle solve a problem.

    Args:
        problem: The problem.
        arm: Of its task and in its domain, from `arm_for`; its pose does not matter, and is another one afterwards.
        spec: How.

    Raises:
        InputError: It does not succeed within these limits and steps.
    """
    free = {"gripper_mode": "free", "gripper": LimitsConfig().gripper}
    oracle = oracle_for(problem.task, spec.limits.model_copy(update=free), arm)
    steps = spec.steps or STEPS[problem.task]
    shown = run_episode(arm, oracle, problem, steps=steps, stride=spec.stride, keep_frames=True)
    if not shown.success or shown.frames is None:
        raise InputError(
            where=f"demonstration of problem {problem.index} ({problem.task})",
            found=f"the oracle ends {100 * shown.distances_m[-1]:.1f} cm from the goal after {steps} model steps",
            needed="a demonstration that succeeds",
            fix="Allow it longer steps along each axis (planning.limits.xyz, planning.limits.ball), or more of them",
        )
    return Demonstration(shown.frames, shown.states)


def goals_of_demonstration(
    problem: TaskProblem, arm: SimulatedArm, spec: DemonstrationSpec | None = None
) -> tuple[SubGoal, ...]:
    """Return the key frames of one demonstration of a problem: where the gripper changes, the arm stops, and the end.

    With `every` in the spec, also frames on the way to them.

    Args:
        problem: The problem.
        arm: As of `demonstrate`: never the one that is about to be steered.
        spec: How it is demonstrated.

    Raises:
        InputError: As `demonstrate`.
    """
    spec = spec or DemonstrationSpec()
    shown = demonstrate(problem, arm, spec)
    keys = gripper_key_frames(shown.states, OF_MODEL_STEPS)
    if spec.every is not None:
        keys = with_frames_between(keys, spec.every)
    images: Sequence[np.ndarray] = [shown.frames[key.frame] for key in keys]
    return sub_goals_of(images, keys, Timing(1, spec.slack, spec.share), shown.states)
