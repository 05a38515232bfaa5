"""The closed-loop benchmark: a planning model and reference policies in the same trials, with a video of the model."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.goals.key_frames import (
    MODEL_STEP_RULE,
    KeyFrame,
    Timing,
    add_frames_between,
    find_gripper_key_frames,
    make_sub_goals,
)
from vjepa2_ac.media.figure import stack_horizontally, stack_vertically
from vjepa2_ac.media.video import import_pyav, write_video
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.camera import FRAME_SIZE
from vjepa2_ac.simulation.domains import Domain, named_domain
from vjepa2_ac.simulation.motion import CONTROL_RATE_HZ
from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import (
    Action,
    ArmEnvironment,
    ClosedLoopResult,
    Environment,
    EpisodeResult,
    Image,
    Observation,
    Policy,
    Trial,
    Trials,
    run_trial,
    run_trials,
)
from vjepa2_ac.simulation.tasks import STEPS, SUCCESS_M, TaskName, TaskProblem, arm_for, make_problem
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.paths import CLOSED_LOOP_FILE
from vjepa2_ac.storage.structured import utc_now

JOINT_FIELDS = ("steps/observation/joint_position", "steps/observation/gripper_position")


class Planning:
    """A policy that plans with a world model from images and the measured state.

    Args:
        controller: Plans the actions; its attribute `decision` is the last decision.
        name: Name of the model in tables.
    """

    def __init__(self, controller: Controller, name: str = "model") -> None:
        self.controller, self.name, self.why = controller, name, ""

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Set the goal image or the sub-goals. For a model of joints the gripper modes of sub-goals are ignored."""
        if not trial.goals:
            self.controller.reset(goal_image)
            return
        has_gripper = self.controller.spaces.state.is_pose
        self.controller.follow(trial.goals if has_gripper else [replace(goal, gripper=None) for goal in trial.goals])

    def act(self, observation: Observation) -> Action:
        """Return the first action of a plan, as a change of the pose or of the joints.

        Raises:
            ValueError: The model needs joint angles, which this environment does not measure.
        """
        spaces = self.controller.spaces
        state = observation.joints if spaces.state.position is None else observation.state
        if state is None:
            raise ValueError(f"{self.name} needs joint angles, which this environment does not measure")
        action = self.controller.act(observation.image, state)
        self.why = self.controller.decision.why if self.controller.decision else ""
        return action - state if spaces.action.effect == "target" else action


def require_measured_inputs(subject: Subject, *, world: bool) -> None:
    """Check that a model needs only measured inputs, and that the length of its model step is known.

    Args:
        subject: The model, loaded for planning.
        world: Whether it acts in a third-party environment, in which the pose of the camera is unknown.

    Raises:
        InputError: The model cannot act in this environment.
    """
    data = subject.config.data
    require_stride(data, to="act", fix="Set the stride, for example data.stride=4")
    if data.pose_frame != "base":
        needed = "base, because the simulated arm moves in its base frame"
        raise InputError(where="data.pose_frame", found=data.pose_frame, needed=needed)
    if data.states == "vector" and not (isinstance(data, RldsData) and data.fields.state == JOINT_FIELDS):
        problem = "states that the simulated arm does not measure"
        needed = f"poses, or seven joint angles and the gripper (data.fields.state: [{', '.join(JOINT_FIELDS)}])"
        raise InputError(where="data.states: vector", found=problem, needed=needed)
    uses_camera = subject.world_model.sizes.predictor.use_extrinsics
    if world and (uses_camera or data.states == "vector"):
        problem = "a model with the camera pose as input" if uses_camera else "a model of joint angles"
        raise InputError(
            where="--world",
            found=problem,
            needed="a model of end-effector poses, which is all that environments measure",
        )


def make_policy(subject: Subject, arm: SimulatedArm | None) -> Planning:
    """Return the policy of a model for the simulated arm, or for a third-party environment if `arm` is None.

    Raises:
        InputError: As for `require_measured_inputs`.
    """
    require_measured_inputs(subject, world=arm is None)
    name = Path(subject.name).name or subject.name
    if name in {ZeroActions.name, RandomActions.name, Oracle.name}:  # names of the reference policies in tables
        name = f"model {name}"
    uses_camera = subject.world_model.sizes.predictor.use_extrinsics
    controller = Controller.of_subject(subject, extrinsics=arm.extrinsics() if arm and uses_camera else None)
    return Planning(controller, name)


# ---- the problems ----

VIDEO_FILE = "closed_loop.mp4"
FORMAT = 2  # incremented at changes that require changes of readers

SubGoals = Literal["none", "demonstration", "every-step"]
_SUB_GOALS_TEXT = {
    "demonstration": ", with key frames of the oracle's solution as sub-goals",
    "every-step": ", with each step of the oracle's solution as sub-goal",
}


@dataclass(frozen=True)
class BenchmarkOptions:
    """The options of a benchmark: problems, steps per problem, and sub-goals of the model."""

    task: TaskName = "reach"
    domain: str | Domain = "A"  # A, B, or a domain
    episodes: int = 50  # number of problems
    seed: int = 0  # seed of the problems; report options that were selected on one seed with another seed
    steps: int | None = None  # model steps per episode; None: the task's default
    stride: int = 4  # control steps (15 per second) per model step; a benchmark uses the model's stride
    films: int = 6  # number of first episodes whose frames are stored for a video; 0: no video
    sub_goals: SubGoals = "none"  # sub-goals of the model, from key frames or all steps of the oracle's solution
    problems: tuple[TaskProblem, ...] | None = None  # the problems of a manifest; None: drawn from the seed
    seeds: tuple[int, ...] | None = None  # the problems of a manifest of a third-party environment

    @property
    def world(self) -> Domain:
        """The domain.

        Raises:
            InputError: There is no domain with this name.
        """
        return named_domain(self.domain) if isinstance(self.domain, str) else self.domain

    def trials(self) -> Trials:
        """Return the trials of the simulated arm.

        Raises:
            InputError: There is no domain with this name.
        """
        task, domain, steps = self.task, self.world, self.steps or STEPS[self.task]
        drawn = (make_problem(task, domain, self.seed, index) for index in range(self.episodes))
        problems = drawn if self.problems is None else self.problems
        about = {
            **{key: value for key, value in vars(self).items() if key not in {"films", "problems", "seeds"}},
            "domain": domain.name,
            "steps": steps,
            "seconds_per_step": self.stride / CONTROL_RATE_HZ,
        }
        return Trials(
            task=task,
            place=f"domain {domain.name}",
            criterion=f"within {100 * SUCCESS_M[task]:g} cm" + ", released on the table," * (task == "place"),
            seconds_per_step=self.stride / CONTROL_RATE_HZ,
            trials=tuple(Trial(problem.index, steps, self.stride, problem) for problem in problems),
            about=about,
        )


def run_task(
    options: BenchmarkOptions, policy: Policy, arm: SimulatedArm | None = None, progress: Progress = no_progress
) -> ClosedLoopResult:
    """Run a policy in all trials of a task with the simulated arm.

    Args:
        options: The problems.
        policy: The policy.
        arm: An arm to reuse, from `arm_for` with this task and domain; None: a new one.
        progress: Called with the number of finished decisions, from 0 on.

    Raises:
        InputError: There is no such domain.
        UnreachableError: MuJoCo is not installed.
        ValueError: The policy returned an invalid action.
    """
    environment = ArmEnvironment(arm or arm_for(options.task, options.world))
    return run_trials(environment, policy, options.trials(), options.films, progress)


@dataclass(frozen=True)
class ClosedLoopBenchmark:
    """The results of a model (first), reference policies, and the oracle or expert (last) in the same trials."""

    subject: Subject
    trials: Trials
    results: tuple[ClosedLoopResult, ...]

    @property
    def conditions(self) -> str:
        """The domain or environment, and the sub-goals of the model, as text."""
        return f"in {self.trials.place}{_SUB_GOALS_TEXT.get(self.trials.about['sub_goals'], '')}"


def run_benchmark(subject: Subject, options: BenchmarkOptions, reporter: Reporter = SILENT) -> ClosedLoopBenchmark:
    """Run a model, zero actions, random actions and an oracle on the same problems with the simulated arm.

    Args:
        subject: The model and its planning config.
        options: The problems, and the sub-goals of the model.
        reporter: Shows the progress of each policy.

    Raises:
        InputError: There is no such domain, the model needs inputs that the arm does not measure, or the oracle does
            not solve a problem whose demonstration is needed for sub-goals.
        UnreachableError: MuJoCo or PyAV is missing.
    """
    if options.films:
        import_pyav()
    planning = subject.config.planning
    arm = arm_for(options.task, options.world, views=planning.views)
    model = make_policy(subject, arm)
    trials = replace(options, stride=subject.config.data.model_stride).trials()
    if options.sub_goals != "none":
        reporter.task("demonstrations of all problems")
        goals = [demonstrated_goals(trial, arm, planning.limits, options.sub_goals) for trial in trials.trials]
        trials = with_goals(trials, goals)
    policies = (model, ZeroActions(), RandomActions(planning.limits, options.seed), Oracle(planning.limits))
    results = run_policies(ArmEnvironment(arm), policies, trials, options.films, reporter)
    return ClosedLoopBenchmark(subject, trials, results)


def demonstrated_goals(
    trial: Trial, arm: SimulatedArm, limits: LimitsConfig, sub_goals: SubGoals = "demonstration"
) -> tuple[SubGoal, ...]:
    """Return the sub-goals of a problem from the oracle's solution.

    Args:
        trial: The problem, and the stride.
        arm: An arm from `arm_for` with this task and domain. Its pose is changed.
        limits: Limits of the oracle's actions; its gripper is not limited.
        sub_goals: "demonstration" for key frames (the gripper changes, the arm stops, the end), or "every-step".

    Raises:
        InputError: The oracle does not succeed within these limits and the steps of the task.
    """
    episode = demonstrate(trial, arm, limits)
    keys = find_gripper_key_frames(episode.states, MODEL_STEP_RULE)
    return goals_of_episode(episode, add_frames_between(keys, 1) if sub_goals == "every-step" else keys, sub_goals)


def demonstrate(trial: Trial, arm: SimulatedArm, limits: LimitsConfig) -> EpisodeResult:
    """Let the oracle solve a problem, and return the episode with its frames.

    Arguments and errors are those of `demonstrated_goals`.
    """
    task: TaskName = "reach" if trial.problem is None else trial.problem.task
    steps = max(trial.steps, STEPS[task])
    free = limits.model_copy(update={"gripper_mode": "free", "gripper": LimitsConfig().gripper})
    episode = run_trial(ArmEnvironment(arm), Oracle(free), replace(trial, steps=steps), keep_frames=True)
    if not episode.success:
        where = f"demonstration of problem {trial.seed} ({task})"
        distance = f"{100 * episode.distances_m[-1]:.1f} cm from the goal after {counted(steps, 'model step')}"
        fix = "Raise the step limits (planning.limits.xyz) or the number of steps"
        raise InputError(
            where=where, found=f"the oracle stops {distance}", needed="a demonstration that succeeds", fix=fix
        )
    return episode


def goals_of_episode(episode: EpisodeResult, keys: Sequence[KeyFrame], sub_goals: SubGoals) -> tuple[SubGoal, ...]:
    """Return frames of an episode as sub-goals.

    The allowed duration of each sub-goal is that in the episode, plus or minus 3 model steps (1 for `every-step`).
    """
    images = [] if episode.frames is None else [episode.frames[key.frame] for key in keys]
    return make_sub_goals(images, keys, Timing(1, slack=1 if sub_goals == "every-step" else 3), episode.states)


def with_goals(trials: Trials, goals: Sequence[Sequence[SubGoal]]) -> Trials:
    """Return trials with the given sub-goals."""
    pairs = zip(trials.trials, goals, strict=True)
    return replace(trials, trials=tuple(replace(trial, goals=tuple(sub_goals)) for trial, sub_goals in pairs))


def run_policies(
    environment: Environment, policies: Sequence[Policy], trials: Trials, num_videos: int, reporter: Reporter
) -> tuple[ClosedLoopResult, ...]:
    """Run several policies in the same trials; store frames for a video for the first policy only."""
    results = list[ClosedLoopResult]()
    for policy in policies:
        progress = reporter.task(f"{trials.task}: {policy.name}", "decisions")
        results.append(run_trials(environment, policy, trials, 0 if results else num_videos, progress))
    return tuple(results)


def write_benchmark(benchmark: ClosedLoopBenchmark, folder: Path, verdict: Mapping[str, Any]) -> tuple[Path, ...]:
    """Write closed_loop.json with the results and the verdict, and a video if frames were stored; return the files.

    Raises:
        UnreachableError: PyAV is missing.
    """
    subject, model, file = benchmark.subject, benchmark.results[0], folder / CLOSED_LOOP_FILE
    about = {
        "subject": subject.name,
        "checkpoint": subject.checkpoint_label,
        **benchmark.trials.about,
        "planning": subject.config.planning.model_dump(mode="json"),
        "warnings": list(subject.warnings),
        "planning_seed": subject.config.seed,
        "version": __version__,
        "time": utc_now(),
    }
    policies = {result.policy: _metrics(result) for result in benchmark.results}
    values = {"format": FORMAT, "about": about, "verdict": dict(verdict), "policies": policies}
    write_atomically(file, json.dumps(values, indent=1, allow_nan=False) + "\n")
    if all(episode.frames is None for episode in model.episodes):
        return (file,)
    rate_hz = 1.0 / benchmark.trials.seconds_per_step
    return file, write_video(folder / VIDEO_FILE, video_frames(model), rate_hz=rate_hz)


def _metrics(result: ClosedLoopResult) -> dict[str, Any]:
    return {
        **{name: None if estimate is None else estimate.as_dict() for name, estimate in result.estimates.items()},
        "why_counts": result.reason_counts,
        "unreachable_commands": int(result.unreachable.sum()),
        "by_episode": {
            "success": result.successes.tolist(),
            "steps_needed": [episode.steps_needed for episode in result.episodes],
            "distance_cm": _rounded(result.distance_cm),
            "seconds": _rounded(result.seconds),
            "unreachable_commands": result.unreachable.tolist(),
        },
    }


def _rounded(numbers: Float[np.ndarray, "episodes _"]) -> list[list[float]]:
    return [[round(number, 4) for number in row] for row in numbers.tolist()]


_HOLD = 4  # repetitions of the first and the last image of an episode


def video_frames(result: ClosedLoopResult) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield the frames of the video, one per model step; the first and the last frame of an episode are repeated."""
    trials, steps = result.trials, result.trials.steps
    for number, episode in enumerate(result.episodes, start=1):
        if episode.frames is None:
            return
        about = f"{trials.task}, {trials.place}    episode {number} of {len(result.episodes)}"
        for step, (frame, distance_m) in enumerate(zip(episode.frames, episode.distances_m, strict=True)):
            outcome = f"   {'reached' if episode.success else 'missed'}" if step == steps else ""
            caption = f"{result.policy}:   {100 * distance_m:.1f} cm from the goal{outcome}"
            scale = max(1, FRAME_SIZE[1] // int(frame.shape[1]))  # enlarges small frames, so that captions fit
            large = stack_horizontally([frame], [caption], f"{about}    step {step} of {steps}", enlarged=2 * scale)
            image = stack_vertically([large, stack_horizontally([episode.goal_image], ["goal"], enlarged=scale)])
            yield from itertools.repeat(image, _HOLD if step in {0, steps} else 1)
