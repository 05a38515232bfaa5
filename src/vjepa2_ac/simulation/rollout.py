"""Run policies in environments: the loop of an episode, its record, and the metrics over all episodes."""

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
from vjepa2_ac.intervals import Estimate, estimate_mean, estimate_share
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.arm import Block, Mark, SimulatedArm, State
from vjepa2_ac.simulation.motion import HIGH, LOW, OutOfReachError, rest_joints
from vjepa2_ac.simulation.tasks import TaskProblem
from vjepa2_ac.spaces import apply_action

Image = UInt8[np.ndarray, "height width 3"]
Action = Float[np.ndarray, " dim"]
_NUM_PARTS = 8  # number of parts into which an unreachable displacement is divided


@dataclass(frozen=True, eq=False)
class Trial:
    """One attempt at a task: its start, its goal, and the number of steps."""

    seed: int  # seed for the reset of the environment; it equals the number of the problem
    steps: int  # number of model steps
    stride: int  # control steps per model step
    problem: TaskProblem | None = None  # start and goal of the simulated arm; None: the seed determines them
    goal_image: Image | None = None  # None: the environment returns it at its reset
    goals: tuple[SubGoal, ...] = ()  # sub-goals, including the final goal; empty: only the goal image


class Observation(NamedTuple):
    """The input of a policy."""

    image: Image
    state: State  # measured
    block: Block | None = None  # None: the task has none, or it is not measured
    joints: Float[np.ndarray, " 8"] | None = None  # joint angles and gripper position; None: not measured


class Environment(Protocol):
    """An environment, with the interface of Gymnasium."""

    def reset(self, *, seed: int, options: Mapping[str, Any]) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the episode; the same seed starts the same episode.
            options: `problem` and `stride` of the trial.

        Returns:
            The observation, and a dictionary with `distance_m` (distance to the goal), `success`, and `goal_image`
            (or None).
        """

    def step(self, action: Action | None) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action for a model step.

        Args:
            action: The change of the flange's pose (conventions: episode.py), or of joint angles and gripper position;
                None: the environment's expert acts.

        Returns:
            Observation, reward, terminated, truncated, and a dictionary as for `reset` that also contains `target`
            (the commanded pose) or `is_reachable` (whether the arm could carry out the action), or both.
        """


class Policy(Protocol):
    """Selects the action of the next model step."""

    name: str
    why: str  # reason for the last action, from a small set, so that reasons can be counted

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Start an episode. Policies other than the oracle use only the goal image and the sub-goals of the trial."""

    def act(self, observation: Observation) -> Action | None:
        """Return the action of the next model step, in the base frame; None: the environment's expert acts."""


class Step(NamedTuple):
    """A model step of an episode, with the observation after it."""

    observation: Observation
    info: dict[str, Any]
    action: Action | None = None  # the action before this observation; None at the start, or if the expert acted
    seconds: float = 0.0  # duration of the policy's decision
    why: str = ""


def iterate_steps(environment: Environment, policy: Policy, trial: Trial) -> Iterator[Step]:
    """Run a policy in a trial, and yield the start and each model step.

    Raises:
        ValueError: The policy returned an action that is not 7 or 8 finite numbers.
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
                raise ValueError(f"{policy.name}: {action.tolist()} is not an action of 7 or 8 finite numbers")
        observation, _, _, _, info = environment.step(action)
        yield Step(observation, info, action, seconds, policy.why)


@dataclass(frozen=True)
class EpisodeResult:
    """The record of an episode. Index 0 along `time` is before the first action."""

    trial: Trial
    states: Float[np.ndarray, "time 7"]  # measured, in the robot base frame
    actions: Float[np.ndarray, "steps dim"]  # actions of the policy; NaN: the environment's expert acted
    blocks: Float[np.ndarray, "time 4"] | None  # pose of the block, as in `TaskProblem`; None: no block
    distances_m: Float[np.ndarray, " time"]  # distance to the goal, of the flange or of the block
    reached: Bool[np.ndarray, " time"]  # whether the task is done, see `TaskProblem.succeeded`
    seconds: Float[np.ndarray, " steps"]  # duration of each decision
    reasons: tuple[str, ...]  # reason for each action
    unreachable: int  # number of commands that the arm could not follow completely
    goal_image: Image
    frames: UInt8[np.ndarray, "time height width 3"] | None  # if they are stored

    @property
    def success(self) -> bool:
        """Whether the task is done at the end of the episode."""
        return bool(self.reached[-1])

    @property
    def steps_needed(self) -> int | None:
        """Number of model steps after which the task stays done; None if it is not done at the end."""
        if not self.success:
            return None
        not_done = np.flatnonzero(~self.reached)
        return int(not_done[-1]) + 1 if len(not_done) else 0

    @property
    def success_ever(self) -> bool:
        """Whether the task was done after any of the steps."""
        return bool(self.reached[1:].any())


def run_trial(
    environment: Environment,
    policy: Policy,
    trial: Trial,
    *,
    keep_frames: bool = False,
    progress: Callable[[int], None] = lambda _: None,
) -> EpisodeResult:
    """Run a policy in a trial and return the record of the episode.

    Args:
        environment: The environment.
        policy: The policy.
        trial: Start, goal and number of steps.
        keep_frames: Whether to store the camera images.
        progress: Called with the number of finished model steps.

    Raises:
        ValueError: As for `iterate_steps`.
    """
    steps = list[Step]()
    for step in iterate_steps(environment, policy, trial):
        if steps:
            progress(len(steps))
        steps.append(step)
    observations, infos = [step.observation for step in steps], [step.info for step in steps]
    goal_image = infos[0].get("goal_image") if trial.goal_image is None else trial.goal_image
    blocks = [observation.block for observation in observations if observation.block is not None]
    no_action = np.full(7, np.nan)
    return EpisodeResult(
        trial=trial,
        states=np.stack([observation.state for observation in observations]),
        actions=np.stack([no_action if step.action is None else step.action for step in steps[1:]]),
        blocks=np.stack(blocks) if blocks else None,
        distances_m=np.array([info["distance_m"] for info in infos]),
        reached=np.array([info["success"] for info in infos]),
        seconds=np.array([step.seconds for step in steps[1:]]),
        reasons=tuple(step.why for step in steps[1:]),
        unreachable=sum(not info.get("is_reachable", True) for info in infos),
        goal_image=observations[-1].image if goal_image is None else goal_image,
        frames=np.stack([observation.image for observation in observations]) if keep_frames else None,
    )


# ---- the simulated arm ----


class ArmEnvironment:
    """The simulated arm as an environment.

    Args:
        arm: An arm from `arm_for` with the task and domain of the problems. The environment changes its pose.
    """

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm = arm

    def reset(self, *, seed: int = 0, options: Mapping[str, Any]) -> tuple[Observation, dict[str, Any]]:  # noqa: ARG002
        """Set arm and block to the start of the problem in `options`.

        Raises:
            OutOfReachError: The arm cannot reach the start or the goal of the problem.
            ValueError: The task has a block, but the arm has none.
        """
        self._problem, self._stride, arm = options["problem"], options["stride"], self.arm
        goal_image = set_scene(arm, self._problem.goal, self._problem.block_goal, self._problem.mark).image()
        set_scene(arm, self._problem.start, self._problem.block_start, self._problem.mark)
        observation, info = self._observe()
        return observation, info | {"goal_image": goal_image}

    def step(self, action: Action | None) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action: 7 numbers change the pose, 8 numbers change joints and gripper within their limits.

        Raises:
            ValueError: The action is None.
        """
        if action is None:
            raise ValueError("the simulated arm has no expert. Use the policy Oracle")
        if len(action) == 7:
            is_reachable = send_action(self.arm, action, self._stride)
        else:
            target = self.arm.joints + action[:-1]
            joints = np.clip(target, LOW, HIGH)
            gripper_position = float(np.clip(self.arm.gripper_position + action[-1], 0.0, 1.0))
            self.arm.command_joints(joints, gripper_position, self._stride)
            is_reachable = bool(np.array_equal(target, joints))
        observation, info = self._observe()
        return observation, -info["distance_m"], info["success"], False, info | {"is_reachable": is_reachable}

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        arm, problem = self.arm, self._problem
        state, block = arm.state, arm.block
        info = {"distance_m": problem.distance_m(state, block), "success": problem.succeeded(state, block)}
        joints = np.append(arm.joints, arm.gripper_position)
        return Observation(arm.image(), state, None if problem.block_goal is None else block, joints), info


def set_scene(arm: SimulatedArm, state: State, block: Block | None, mark: Mark | None = None) -> SimulatedArm:
    """Set arm, block, mark and moving objects to the start of an episode; return the arm.

    The arm is set to its rest pose first, so that its redundant joint does not depend on earlier episodes.
    """
    arm.reset_clock()
    arm.set_joints(rest_joints(arm.domain), 0.0)
    arm.set_state(state)
    arm.place(block, mark)
    return arm


def send_action(arm: SimulatedArm, action: State, stride: int) -> bool:
    """Command the state to which an action leads, for `stride` control steps; return whether the arm can reach it.

    The target is relative to the *measured* state. If the arm cannot reach it, the arm moves as far as possible along
    the straight line to it.
    """
    target = target_state(arm.state, action)
    with suppress(OutOfReachError):
        arm.command(target, stride)
        return True
    reachable = list(itertools.takewhile(arm.can_reach, states_along(arm.state, action)))
    if reachable:
        arm.command(np.append(reachable[-1][:6], target[6]), stride)
    else:
        arm.command_joints(arm.joints, target[6], stride)
    return False


def target_state(state: State, action: State) -> State:
    """Return the state after an action, with its gripper position clipped to 0 .. 1."""
    target = np.asarray(apply_action(state, action))
    target[6] = np.clip(target[6], 0.0, 1.0)
    return target


def states_along(state: State, action: State) -> list[State]:
    """Return equally spaced states on the straight line from a state to the state after an action."""
    shares = np.arange(1, _NUM_PARTS + 1)[:, None] / _NUM_PARTS
    return list(apply_action(np.tile(state, (_NUM_PARTS, 1)), shares * action))


# ---- all trials ----


@dataclass(frozen=True)
class Trials:
    """The trials of a benchmark. They are the same for all policies, so that metrics can be paired."""

    task: str
    place: str  # name of the domain or environment
    criterion: str  # short description of success
    seconds_per_step: float  # duration of a model step
    trials: tuple[Trial, ...]
    about: Mapping[str, Any]  # description as plain values, for JSON

    @property
    def steps(self) -> int:
        """Model steps per episode."""
        return self.trials[0].steps


@dataclass(frozen=True)
class ClosedLoopResult:
    """The episodes of one policy. Arrays have one row per episode; estimates have 95 % intervals over episodes."""

    trials: Trials
    policy: str
    episodes: tuple[EpisodeResult, ...]

    @property
    def distance_cm(self) -> Float[np.ndarray, "episodes time"]:
        """Distance to the goal in cm, before the first step and after each step."""
        return np.stack([episode.distances_m for episode in self.episodes]) * 100

    @property
    def successes(self) -> Bool[np.ndarray, " episodes"]:
        """Whether the task is done at the end of each episode."""
        return np.array([episode.success for episode in self.episodes])

    @property
    def seconds(self) -> Float[np.ndarray, "episodes steps"]:
        """Duration of each decision in seconds."""
        return np.stack([episode.seconds for episode in self.episodes])

    @property
    def unreachable(self) -> Int[np.ndarray, " episodes"]:
        """Number of commands per episode that the arm could not follow completely."""
        return np.array([episode.unreachable for episode in self.episodes])

    @property
    def success_rate(self) -> Estimate:
        """Fraction of episodes in which the task is done at the end."""
        return estimate_share(int(self.successes.sum()), len(self.episodes))

    @property
    def reason_counts(self) -> dict[str, int]:
        """Number of actions by reason, the most common reason first."""
        return dict(Counter(why for episode in self.episodes for why in episode.reasons).most_common())

    @property
    def estimates(self) -> dict[str, Estimate | None]:
        """The metrics over all episodes.

        success_ever counts episodes in which the task was done after any step, which is optimistic. steps_needed is the
        mean over successful episodes, and None if there are none.
        """
        needed = [episode.steps_needed for episode in self.episodes if episode.steps_needed is not None]
        return {
            "success": self.success_rate,
            "success_ever": estimate_share(sum(episode.success_ever for episode in self.episodes), len(self.episodes)),
            "final_distance_cm": _mean(self.distance_cm[:, -1]),
            "steps_needed": _mean(np.array(needed, dtype=np.float64)) if needed else None,
            "seconds_per_decision": _mean(self.seconds.mean(axis=1)),
        }


def _mean(values: Float[np.ndarray, " episodes"]) -> Estimate:
    return estimate_mean(values, [f"{number:06d}" for number in range(len(values))])


def run_trials(
    environment: Environment, policy: Policy, trials: Trials, num_videos: int = 0, progress: Progress = no_progress
) -> ClosedLoopResult:
    """Run a policy in all trials.

    Args:
        environment: The environment.
        policy: The policy.
        trials: The trials.
        num_videos: Number of first episodes whose frames are stored.
        progress: Called with the number of finished decisions, from 0 on.

    Raises:
        ValueError: As for `run_trial`.
    """
    total, episodes = len(trials.trials) * trials.steps, list[EpisodeResult]()
    progress(0, total)
    for trial in trials.trials:
        first = len(episodes) * trials.steps
        report = lambda step, first=first: progress(first + step, total)  # noqa: E731
        episodes.append(run_trial(environment, policy, trial, keep_frames=len(episodes) < num_videos, progress=report))
    return ClosedLoopResult(trials, policy.name, tuple(episodes))
