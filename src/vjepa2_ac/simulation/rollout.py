"""Closed-loop rollouts: episodes of a policy, their records, and the metrics over all of them."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.intervals import Estimate, mean_of, share_of
from vjepa2_ac.simulation.arm import Block, Mark, SimulatedArm, State
from vjepa2_ac.simulation.domains import Domain, named_domain
from vjepa2_ac.simulation.motion import CONTROL_RATE_HZ, HIGH, LOW, OutOfReachError, rest_joints
from vjepa2_ac.simulation.policies import Image, Moves, Planning, Policy
from vjepa2_ac.simulation.tasks import (
    ALSO,
    STEPS,
    SUCCESS_M,
    Problem,
    TaskName,
    TaskProblem,
    arm_for,
    make_problem,
)
from vjepa2_ac.spaces import apply_action


@dataclass(frozen=True)
class EpisodeResult:
    """The record of an episode. Index 0 along `time` is before the first action."""

    problem: Problem
    states: Float[np.ndarray, "time 7"]  # measured, in the robot base frame
    actions: Float[np.ndarray, "steps dim"]  # as returned by the policy
    blocks: Float[np.ndarray, "time 4"] | None  # pose of the block, as in `TaskProblem`; None: there is none
    distances_m: Float[np.ndarray, " time"]  # of what the task moves, to its goal
    reached: Bool[np.ndarray, " time"]  # whether the task is done, see `TaskProblem.succeeded`
    seconds: Float[np.ndarray, " steps"]  # taken by the policy
    whys: tuple[str, ...]  # of each action
    unreachable: int  # commands that the arm could not follow completely
    goal_image: UInt8[np.ndarray, "height width 3"]
    frames: UInt8[np.ndarray, "time height width 3"] | None  # if they are stored
    imagined: tuple[UInt8[np.ndarray, "height width 3"] | None, ...] = ()  # after each action, likewise; None: nothing

    @property
    def success(self) -> bool:
        """Whether the goal is reached at the end."""
        return bool(self.reached[-1])

    @property
    def steps_needed(self) -> int | None:
        """Model steps after which it stays reached; None: it is not reached at the end."""
        if not self.success:
            return None
        not_done = np.flatnonzero(~self.reached)
        return int(not_done[-1]) + 1 if len(not_done) else 0

    @property
    def success_ever(self) -> bool:
        """Whether the goal was reached after any of the steps, perhaps in passing."""
        return bool(self.reached[1:].any())


class Trials(Protocol):
    """The problems that policies are tried on, and how long they may take for each."""

    @property
    def episodes(self) -> int:
        """Number of problems."""

    @property
    def seed(self) -> int:
        """Of the problems."""

    @property
    def stride(self) -> int:
        """Control steps of a model step."""

    @property
    def model_steps(self) -> int:
        """Model steps of an episode."""

    @property
    def seconds_per_step(self) -> float:
        """Length of a model step."""

    @property
    def problems(self) -> Iterable[Problem]:
        """The problems: the same for every policy, so that metrics can be paired."""

    @property
    def task_name(self) -> str:
        """What is to be done."""

    @property
    def place(self) -> str:
        """Where it is done."""

    @property
    def criterion(self) -> str:
        """When it is done, in a few words."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""


@dataclass(frozen=True)
class RolloutSpec:
    """Problems of a task of the simulated arm, and how long a policy may take for each."""

    task: TaskName = "reach"
    domain: str | Domain = "A"  # A, B, or a domain
    episodes: int = 50  # number of problems, from number 0 on
    seed: int = 0  # of the problems; settings that were chosen on one seed have to be reported on another
    steps: int | None = None  # model steps of an episode; None: the task's default
    stride: int = 4  # control steps of a model step (15 per second)
    films: int = 0  # number of episodes, the first ones, whose frames are stored for a video

    @property
    def world(self) -> Domain:
        """The domain.

        Raises:
            InputError: There is none of this name.
        """
        return named_domain(self.domain) if isinstance(self.domain, str) else self.domain

    @property
    def model_steps(self) -> int:
        """Model steps of an episode."""
        return self.steps or STEPS[self.task]

    @property
    def seconds_per_step(self) -> float:
        """Length of a model step."""
        return self.stride / CONTROL_RATE_HZ

    @property
    def problems(self) -> Iterator[TaskProblem]:
        """The problems: the same for every policy, so that metrics can be paired."""
        return (make_problem(self.task, self.world, self.seed, index) for index in range(self.episodes))

    @property
    def task_name(self) -> str:
        """What is to be done."""
        return self.task

    @property
    def place(self) -> str:
        """Where it is done."""
        return f"domain {self.world.name}"

    @property
    def criterion(self) -> str:
        """When it is done, in a few words."""
        also = f", {ALSO[self.task]}," if ALSO[self.task] else ""
        return f"within {100 * SUCCESS_M[self.task]:g} cm{also}"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            **{key: value for key, value in asdict(self).items() if key != "films"},
            "domain": self.world.name,
            "steps": self.model_steps,
            "seconds_per_step": self.seconds_per_step,
            "success_below_cm": 100 * SUCCESS_M[self.task],
            "success_also": ALSO[self.task],
        }


@dataclass(frozen=True)
class ClosedLoopResult:
    """A policy's episodes of a task; arrays hold one row per episode, estimates have 95 % intervals over episodes."""

    spec: Trials
    policy: str
    episodes: tuple[EpisodeResult, ...]

    @property
    def distance_cm(self) -> Float[np.ndarray, "episodes time"]:
        """Distance to the goal before the first step and after each."""
        return np.stack([episode.distances_m for episode in self.episodes]) * 100

    @property
    def successes(self) -> Bool[np.ndarray, " episodes"]:
        """Whether the goal is reached at the end."""
        return np.array([episode.success for episode in self.episodes])

    @property
    def seconds(self) -> Float[np.ndarray, "episodes steps"]:
        """Seconds of each decision."""
        return np.stack([episode.seconds for episode in self.episodes])

    @property
    def unreachable(self) -> Int[np.ndarray, " episodes"]:
        """Commands that the arm could not follow completely."""
        return np.array([episode.unreachable for episode in self.episodes])

    @property
    def success_rate(self) -> Estimate:
        """Share of episodes with the goal reached at the end."""
        return share_of(int(self.successes.sum()), len(self.episodes))

    @property
    def success_ever_rate(self) -> Estimate:
        """Share of episodes with the goal reached after any step: optimistic, only for comparison with others'."""
        return share_of(sum(episode.success_ever for episode in self.episodes), len(self.episodes))

    @property
    def final_distance_cm(self) -> Estimate:
        """Mean distance to the goal at the end."""
        return self._mean(self.distance_cm[:, -1])

    @property
    def steps_needed(self) -> Estimate | None:
        """Mean model steps until it stays reached, of episodes with success at the end; None: there are none."""
        needed = [episode.steps_needed for episode in self.episodes if episode.steps_needed is not None]
        return self._mean(np.array(needed, dtype=np.float64)) if needed else None

    @property
    def seconds_per_decision(self) -> Estimate:
        """Mean time of a decision."""
        return self._mean(self.seconds.mean(axis=1))

    @property
    def why_counts(self) -> dict[str, int]:
        """How often each reason was given for an action, the most common first."""
        return dict(Counter(why for episode in self.episodes for why in episode.whys).most_common())

    def _mean(self, values: Float[np.ndarray, " episodes"]) -> Estimate:
        return mean_of(values, [f"{number:06d}" for number in range(len(values))])


_PARTS = 8  # of a displacement that cannot be completed


def run_task(
    spec: RolloutSpec, policy: Policy, arm: SimulatedArm | None = None, progress: Progress = no_progress
) -> ClosedLoopResult:
    """Let a policy do a task repeatedly.

    Args:
        spec: The problems.
        policy: The policy.
        arm: In their domain, from `arm_for` of this task, to be reused; None: a new one.
        progress: Called with the number of finished decisions, from 0 on.

    Raises:
        InputError: No such domain.
        UnreachableError: MuJoCo is not installed.
        ValueError: An action that is no action.
    """
    world = SimulatedWorld(arm or arm_for(spec.task, spec.world))
    return run_trials(world, policy, spec, spec.films, progress)


def run_trials(
    world: World, policy: Policy, trials: Trials, films: int = 0, progress: Progress = no_progress
) -> ClosedLoopResult:
    """Let a policy solve the problems of a world.

    Args:
        world: Where it acts.
        policy: The policy.
        trials: The problems.
        films: Number of episodes, the first ones, whose frames are stored.
        progress: Called with the number of finished decisions, from 0 on.

    Raises:
        ValueError: As `run_in`.
    """
    done, span = list[EpisodeResult](), Span(trials.model_steps, trials.stride)
    numbers, total = itertools.count(), trials.episodes * span.steps
    progress(next(numbers), total)
    for problem in trials.problems:
        decided = lambda: progress(next(numbers), total)  # noqa: E731
        done.append(run_in(world, policy, problem, span, keep_frames=len(done) < films, decided=decided))
    return ClosedLoopResult(trials, policy.name, tuple(done))


def run_episode(
    arm: SimulatedArm,
    policy: Policy,
    problem: TaskProblem,
    steps: int = 8,
    stride: int = 4,
    *,
    keep_frames: bool = False,
) -> EpisodeResult:
    """Let a policy solve a problem, and return the record.

    If no joint angles reach a command, the arm moves along the straight line as far as possible; this is counted.

    Args:
        arm: In the problem's domain; its pose does not matter.
        policy: The policy.
        problem: The problem.
        steps: Model steps.
        stride: Control steps of each.
        keep_frames: Whether the result holds the camera images.

    Raises:
        OutOfReachError: The problem's own start or goal cannot be reached.
        ValueError: An action that is not 7 finite numbers, or a block to be moved but an arm without one.
    """
    return run_in(SimulatedWorld(arm), policy, problem, Span(steps, stride), keep_frames=keep_frames)


@dataclass(frozen=True)
class Observation:
    """What is seen and measured at a moment, and how far the task has come."""

    image: Image
    state: State
    distance_m: float  # of what the task moves, to its goal
    is_done: bool
    block: Block | None = None  # None: there is none
    joints: Float[np.ndarray, " 8"] | None = None  # with the closedness; None: they are not told


@dataclass(frozen=True)
class Span:
    """How long an episode is."""

    steps: int  # model steps
    stride: int  # control steps of each


class World(Protocol):
    """Where a policy acts: the simulated arm, or a world that others made."""

    def begin(self, problem: Problem) -> tuple[Image, Observation]:
        """Put everything where the problem starts; return its goal image, and what is seen."""

    def act(self, action: Float[np.ndarray, " dim"], moves: Moves, stride: int) -> tuple[bool, Observation]:
        """Carry an action out for so many control steps; return whether it was within reach, and what is seen then."""


class SimulatedWorld:
    """The simulated arm as a world.

    Args:
        arm: In the domain of the problems, from `arm_for` of their task; its pose does not matter.
    """

    def __init__(self, arm: SimulatedArm) -> None:
        self._arm = arm

    def begin(self, problem: Problem) -> tuple[Image, Observation]:
        """Put arm and block where the problem starts; return its goal image, and what is seen.

        Raises:
            OutOfReachError: The problem's own start or goal cannot be reached.
            ValueError: A block is to be moved and the arm has none, or it is a problem of another world.
        """
        self._problem, arm = TaskProblem.of(problem), self._arm
        goal_image = put(arm, self._problem.goal, self._problem.block_goal, self._problem.mark).image()
        put(arm, self._problem.start, self._problem.block_start, self._problem.mark)
        return goal_image, self._seen()

    def act(self, action: Float[np.ndarray, " dim"], moves: Moves, stride: int) -> tuple[bool, Observation]:
        """Carry an action out for so many control steps; return whether it was within reach, and what is seen then."""
        is_within = (send_action if moves == Moves.FLANGE else _send_joints)(self._arm, action, stride)
        return is_within, self._seen()

    def _seen(self) -> Observation:
        arm, problem = self._arm, self._problem
        state, block = arm.state, arm.block
        distance_m, is_done = problem.distance_m(state, block), problem.succeeded(state, block)
        joints = np.append(arm.joints, arm.closedness)
        return Observation(
            arm.image(), state, distance_m, is_done, None if problem.block_goal is None else block, joints
        )


def run_in(
    world: World,
    policy: Policy,
    problem: Problem,
    span: Span,
    *,
    keep_frames: bool = False,
    decided: Callable[[], None] = lambda: None,
) -> EpisodeResult:
    """Let a policy solve a problem in a world, and return the record.

    Args:
        world: Where the policy acts.
        policy: The policy.
        problem: The problem.
        span: How long it may take.
        keep_frames: Whether the result holds the camera images.
        decided: Called after each decision has been carried out.

    Raises:
        ValueError: An action of other than the finite numbers that the policy moves, or joints where none are told.
    """
    goal_image, now = world.begin(problem)
    policy.reset(problem, goal_image)
    seen, actions, seconds, whys, imagined, unreachable = [now], [], [], [], [], 0
    for _ in range(span.steps):
        began = time.perf_counter()
        measured = now.state if policy.moves == Moves.FLANGE else now.joints
        if measured is None:
            raise ValueError(f"{policy.name} moves joints, which this world does not tell")
        action = np.asarray(policy.act(now.image, measured), dtype=np.float64)
        seconds.append(time.perf_counter() - began)
        if action.shape != (policy.moves.value,) or not np.isfinite(action).all():
            raise ValueError(f"{policy.name}: {action.tolist()} is no action of {policy.moves.value} finite numbers")
        actions.append(action)
        whys.append(policy.why)
        if keep_frames and isinstance(policy, Planning):
            imagined.append(policy.imagined())
        is_within, now = world.act(action, policy.moves, span.stride)
        unreachable += not is_within
        seen.append(now)
        decided()
    blocks = [one.block for one in seen if one.block is not None]
    return EpisodeResult(
        problem=problem,
        states=np.stack([one.state for one in seen]),
        actions=np.stack(actions),
        blocks=np.stack(blocks) if blocks else None,
        distances_m=np.array([one.distance_m for one in seen]),
        reached=np.array([one.is_done for one in seen]),
        seconds=np.array(seconds),
        whys=tuple(whys),
        unreachable=unreachable,
        goal_image=goal_image,
        frames=np.stack([one.image for one in seen]) if keep_frames else None,
        imagined=tuple(imagined),
    )


def put(arm: SimulatedArm, state: State, block: Block | None, mark: Mark | None = None) -> SimulatedArm:
    """Begin an episode: put arm, block and mark somewhere, and moving objects where they start.

    The arm gets there via its rest pose: its redundant joint must not depend on the past.

    Raises:
        ValueError: There is a mark, and no place for it is given; or a block or a mark is to be put, and there is none.
    """
    if arm.mark is not None and mark is None:
        raise ValueError("no place for the mark on the table: give problem.mark")
    arm.reset_clock()
    arm.set_joints(rest_joints(arm.domain), 0.0)
    arm.set_state(state)
    arm.place(block, mark)
    return arm


def send_action(arm: SimulatedArm, action: State, stride: int) -> bool:
    """Command the state after an action for `stride` control steps, its closedness within 0 .. 1.

    The target is that action from the *measured* state. If no joint angles reach it, the arm moves along the straight
    line as far as possible.

    Returns:
        Whether it can be reached.
    """
    target = commanded(arm.state, action)
    with suppress(OutOfReachError):
        arm.command(target, stride)
        return True
    reachable = list(itertools.takewhile(arm.can_reach, ways_along(arm.state, action)))
    if reachable:
        arm.command(np.append(reachable[-1][:6], target[6]), stride)
    else:
        arm.command_joints(arm.joints, target[6], stride)
    return False


def commanded(state: State, action: State) -> State:
    """Return the state after an action, its closedness within 0 .. 1."""
    target = np.asarray(apply_action(state, action))
    target[6] = np.clip(target[6], 0.0, 1.0)
    return target


def ways_along(state: State, action: State) -> Sequence[State]:
    """Return equally spaced states on the straight line of an action, the nearest first."""
    shares = np.arange(1, _PARTS + 1)[:, None] / _PARTS
    return list(apply_action(np.tile(state, (_PARTS, 1)), shares * action))


def _send_joints(arm: SimulatedArm, action: Float[np.ndarray, " 8"], stride: int) -> bool:
    """Command the joints after an action, within their limits; return whether it was within them."""
    wanted = arm.joints + action[:-1]
    reachable = np.clip(wanted, LOW, HIGH)
    arm.command_joints(reachable, float(np.clip(arm.closedness + action[-1], 0.0, 1.0)), stride)
    return bool(np.array_equal(wanted, reachable))
