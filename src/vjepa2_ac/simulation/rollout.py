"""Trials of policies in environments: one loop, the record of an episode, and the metrics over all episodes."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.intervals import Estimate, mean_of, share_of
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.arm import Block, Mark, SimulatedArm, State
from vjepa2_ac.simulation.motion import HIGH, LOW, OutOfReachError, rest_joints
from vjepa2_ac.simulation.tasks import TaskProblem
from vjepa2_ac.spaces import apply_action

Image = UInt8[np.ndarray, "height width 3"]
Action = Float[np.ndarray, " dim"]
_PARTS = 8  # of a displacement that cannot be completed


@dataclass(frozen=True, eq=False)
class Trial:
    """One attempt at a task: where it starts, its goal, and how long it may take."""

    seed: int  # of the environment's reset; the number of the problem
    steps: int  # model steps
    stride: int  # control steps of a model step
    problem: TaskProblem | None = None  # start and goal of the simulated arm; None: the seed determines them
    goal_image: Image | None = None  # None: the environment returns it at its reset
    goals: tuple[SubGoal, ...] = ()  # sub-goals, the last one included; empty: the goal image alone


class Observation(NamedTuple):
    """What a policy receives."""

    image: Image
    state: State  # measured
    block: Block | None = None  # None: the task has none, or it is not measured
    joints: Float[np.ndarray, " 8"] | None = None  # angles and closedness; None: they are not measured


class Environment(Protocol):
    """Where policies act, with the interface of Gymnasium's environments."""

    def reset(self, *, seed: int, options: Mapping[str, Any]) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Of the episode: the same seed starts the same episode.
            options: `problem` and `stride` of the trial.

        Returns:
            The observation; and `distance_m` of what the task moves to its goal, `success`, and `goal_image`, or None.
        """

    def step(self, action: Action | None) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action for a model step.

        Args:
            action: The change of the flange's pose (conventions: episode.py), or of joint angles and closedness; None:
                the environment's expert acts.

        Returns:
            Observation, reward, terminated, truncated, and as of `reset`, with `target` (the pose that was held), or
            with `is_reachable` (whether the action was).
        """


class Policy(Protocol):
    """Chooses the action of the next model step."""

    name: str
    why: str  # reason for the last action, short enough to be counted

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Start an episode. Only an oracle uses more of the trial than images."""

    def act(self, observation: Observation) -> Action | None:
        """Return the action of the next model step, in the base frame; None: the environment's expert acts."""


class Step(NamedTuple):
    """A model step of an episode: what was observed after it."""

    observation: Observation
    info: dict[str, Any]
    action: Action | None = None  # that led here; None at the start, or of the environment's expert
    seconds: float = 0.0  # taken by the policy
    why: str = ""


def steps_of(environment: Environment, policy: Policy, trial: Trial) -> Iterator[Step]:
    """Yield the start of a trial, and each model step of the policy.

    Raises:
        ValueError: An action of other than 7 or 8 finite numbers.
    """
    options = {"problem": trial.problem, "stride": trial.stride}
    observation, info = environment.reset(seed=trial.seed, options=options)
    goal_image = info.get("goal_image") if trial.goal_image is None else trial.goal_image
    policy.reset(trial, observation.image if goal_image is None else goal_image)
    yield Step(observation, info)
    for _ in range(trial.steps):
        began = time.perf_counter()
        action = policy.act(observation)
        seconds = time.perf_counter() - began
        if action is not None:
            action = np.asarray(action, dtype=np.float64)
            if action.shape not in {(7,), (8,)} or not np.isfinite(action).all():
                raise ValueError(f"{policy.name}: {action.tolist()} is no action of 7 or 8 finite numbers")
        observation, _, _, _, info = environment.step(action)
        yield Step(observation, info, action, seconds, policy.why)


@dataclass(frozen=True)
class EpisodeResult:
    """The record of an episode. Index 0 along `time` is before the first action."""

    trial: Trial
    states: Float[np.ndarray, "time 7"]  # measured, in the robot base frame
    actions: Float[np.ndarray, "steps dim"]  # of the policy; NaN: the environment's expert acted
    blocks: Float[np.ndarray, "time 4"] | None  # pose of the block, as in `TaskProblem`; None: there is none
    distances_m: Float[np.ndarray, " time"]  # of what the task moves, to its goal
    reached: Bool[np.ndarray, " time"]  # whether the task is done, see `TaskProblem.succeeded`
    seconds: Float[np.ndarray, " steps"]  # taken by the policy
    whys: tuple[str, ...]  # of each action
    unreachable: int  # commands that the arm could not follow completely
    goal_image: Image
    frames: UInt8[np.ndarray, "time height width 3"] | None  # if they are stored

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


def run(
    environment: Environment,
    policy: Policy,
    trial: Trial,
    *,
    keep_frames: bool = False,
    progress: Callable[[int], None] = lambda _: None,
) -> EpisodeResult:
    """Let a policy act in an environment, and return the record.

    Args:
        environment: Where it acts.
        policy: The policy.
        trial: Start, goal and limits.
        keep_frames: Whether the result holds the camera images.
        progress: Called with the number of finished model steps.

    Raises:
        ValueError: As `steps_of`.
    """
    steps = list[Step]()
    for step in steps_of(environment, policy, trial):
        if steps:
            progress(len(steps))
        steps.append(step)
    observations, infos = [step.observation for step in steps], [step.info for step in steps]
    goal_image = infos[0].get("goal_image") if trial.goal_image is None else trial.goal_image
    blocks = [one.block for one in observations if one.block is not None]
    no_action = np.full(7, np.nan)
    return EpisodeResult(
        trial=trial,
        states=np.stack([one.state for one in observations]),
        actions=np.stack([no_action if step.action is None else step.action for step in steps[1:]]),
        blocks=np.stack(blocks) if blocks else None,
        distances_m=np.array([info["distance_m"] for info in infos]),
        reached=np.array([info["success"] for info in infos]),
        seconds=np.array([step.seconds for step in steps[1:]]),
        whys=tuple(step.why for step in steps[1:]),
        unreachable=sum(not info.get("is_reachable", True) for info in infos),
        goal_image=observations[-1].image if goal_image is None else goal_image,
        frames=np.stack([one.image for one in observations]) if keep_frames else None,
    )


# ---- the simulated arm ----


class ArmEnvironment:
    """The simulated arm as an environment.

    Args:
        arm: In the domain of the problems, from `arm_for` of their task; its pose does not matter.
    """

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm = arm

    def reset(self, *, seed: int = 0, options: Mapping[str, Any]) -> tuple[Observation, dict[str, Any]]:  # noqa: ARG002
        """Put arm and block where the problem in `options` starts.

        Raises:
            OutOfReachError: The problem's own start or goal cannot be reached.
            ValueError: A block is to be moved and the arm has none.
        """
        self._problem, self._stride, arm = options["problem"], options["stride"], self.arm
        goal_image = put(arm, self._problem.goal, self._problem.block_goal, self._problem.mark).image()
        put(arm, self._problem.start, self._problem.block_start, self._problem.mark)
        observation, info = self._observe()
        return observation, info | {"goal_image": goal_image}

    def step(self, action: Action | None) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action: of 7 numbers the change of the pose, of 8 that of the joints, within their limits.

        Raises:
            ValueError: There is no action.
        """
        if action is None:
            raise ValueError("the simulated arm has no expert: use the policy Oracle")
        if len(action) == 7:
            is_reachable = send_action(self.arm, action, self._stride)
        else:
            target = self.arm.joints + action[:-1]
            joints = np.clip(target, LOW, HIGH)
            closedness = float(np.clip(self.arm.closedness + action[-1], 0.0, 1.0))
            self.arm.command_joints(joints, closedness, self._stride)
            is_reachable = bool(np.array_equal(target, joints))
        observation, info = self._observe()
        return observation, -info["distance_m"], info["success"], False, info | {"is_reachable": is_reachable}

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        arm, problem = self.arm, self._problem
        state, block = arm.state, arm.block
        info = {"distance_m": problem.distance_m(state, block), "success": problem.succeeded(state, block)}
        joints = np.append(arm.joints, arm.closedness)
        return Observation(arm.image(), state, None if problem.block_goal is None else block, joints), info


def put(arm: SimulatedArm, state: State, block: Block | None, mark: Mark | None = None) -> SimulatedArm:
    """Put arm, block and mark at the start of an episode, and moving objects where they start.

    The arm gets there via its rest pose: its redundant joint must not depend on the past.
    """
    arm.reset_clock()
    arm.set_joints(rest_joints(arm.domain), 0.0)
    arm.set_state(state)
    arm.place(block, mark)
    return arm


def send_action(arm: SimulatedArm, action: State, stride: int) -> bool:
    """Command the state after an action for `stride` control steps; return whether it can be reached.

    The target is that action from the *measured* state. If no joint angles reach it, the arm moves along the straight
    line as far as possible.
    """
    target = target_of(arm.state, action)
    with suppress(OutOfReachError):
        arm.command(target, stride)
        return True
    reachable = list(itertools.takewhile(arm.can_reach, states_along(arm.state, action)))
    if reachable:
        arm.command(np.append(reachable[-1][:6], target[6]), stride)
    else:
        arm.command_joints(arm.joints, target[6], stride)
    return False


def target_of(state: State, action: State) -> State:
    """Return the state after an action, its closedness within 0 .. 1."""
    target = np.asarray(apply_action(state, action))
    target[6] = np.clip(target[6], 0.0, 1.0)
    return target


def states_along(state: State, action: State) -> list[State]:
    """Return equally spaced states on the straight line of an action, the nearest first."""
    shares = np.arange(1, _PARTS + 1)[:, None] / _PARTS
    return list(apply_action(np.tile(state, (_PARTS, 1)), shares * action))


# ---- all trials ----


@dataclass(frozen=True)
class Trials:
    """The trials of a benchmark: the same for every policy, so that metrics can be paired."""

    task: str
    place: str  # where it is done
    criterion: str  # when it is done, in a few words
    seconds_per_step: float  # length of a model step
    trials: tuple[Trial, ...]
    about: Mapping[str, Any]  # plain values, for JSON

    @property
    def steps(self) -> int:
        """Model steps of an episode."""
        return self.trials[0].steps


@dataclass(frozen=True)
class ClosedLoopResult:
    """A policy's episodes of a task; arrays hold one row per episode, estimates have 95 % intervals over episodes."""

    trials: Trials
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
    def why_counts(self) -> dict[str, int]:
        """How often each reason was given for an action, the most common first."""
        return dict(Counter(why for episode in self.episodes for why in episode.whys).most_common())

    @property
    def estimates(self) -> dict[str, Estimate | None]:
        """The metrics over all episodes.

        success_ever counts the goal after any step, which is optimistic; steps_needed is of episodes with success, and
        None without any.
        """
        needed = [episode.steps_needed for episode in self.episodes if episode.steps_needed is not None]
        return {
            "success": self.success_rate,
            "success_ever": share_of(sum(episode.success_ever for episode in self.episodes), len(self.episodes)),
            "final_distance_cm": _mean(self.distance_cm[:, -1]),
            "steps_needed": _mean(np.array(needed, dtype=np.float64)) if needed else None,
            "seconds_per_decision": _mean(self.seconds.mean(axis=1)),
        }


def _mean(values: Float[np.ndarray, " episodes"]) -> Estimate:
    return mean_of(values, [f"{number:06d}" for number in range(len(values))])


def run_trials(
    environment: Environment, policy: Policy, trials: Trials, films: int = 0, progress: Progress = no_progress
) -> ClosedLoopResult:
    """Let a policy act in all trials.

    Args:
        environment: Where it acts.
        policy: The policy.
        trials: The trials.
        films: Number of episodes, the first ones, whose frames are stored.
        progress: Called with the number of finished decisions, from 0 on.

    Raises:
        ValueError: As `run`.
    """
    total, done = len(trials.trials) * trials.steps, list[EpisodeResult]()
    progress(0, total)
    for trial in trials.trials:
        first = len(done) * trials.steps
        report = lambda step, first=first: progress(first + step, total)  # noqa: E731
        done.append(run(environment, policy, trial, keep_frames=len(done) < films, progress=report))
    return ClosedLoopResult(trials, policy.name, tuple(done))
