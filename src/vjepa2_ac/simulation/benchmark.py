"""The closed-loop benchmark, its film, and goals on the way from a demonstration by the oracle."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.evaluation.summary import CLOSED_LOOP_FILE, Verdict, closed_loop
from vjepa2_ac.goals.key_frames import (
    OF_MODEL_STEPS,
    Timing,
    gripper_key_frames,
    sub_goals_of,
    with_frames_between,
)
from vjepa2_ac.media.film import below_each_other, side_by_side
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.media.video import video_library, write_video
from vjepa2_ac.planning.goals import SubGoal, read_goal_folder
from vjepa2_ac.planning.planner import samples_of_iterations
from vjepa2_ac.reporter import SILENT, Reporter, duration
from vjepa2_ac.simulation.agent import Agent
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.camera import FRAME_SIZE
from vjepa2_ac.simulation.domains import Domain
from vjepa2_ac.simulation.policies import GoalsOf, Oracle, Policy, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import (
    ClosedLoopResult,
    EpisodeResult,
    RolloutSpec,
    SimulatedWorld,
    Trials,
    World,
    run_episode,
    run_trials,
)
from vjepa2_ac.simulation.tasks import STEPS, Problem, TaskName, TaskProblem, arm_for
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import utc_now

_LONG_S = 5.0  # a decision that takes longer says how long the others take
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
        views: Of the cameras, side by side.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """

    def __init__(
        self,
        task: TaskName,
        domain: Domain,
        spec: DemonstrationSpec | None = None,
        size: tuple[int, int] = FRAME_SIZE,
        views: int = 1,
    ) -> None:
        self.spec = spec or DemonstrationSpec()
        self._arm, self._unseen = (arm_for(task, domain, size=one, views=views) for one in (size, _SMALL))

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
        found = (
            f"the oracle ends {100 * shown.distances_m[-1]:.1f} cm from its goal after {counted(steps, 'model step')}"
        )
        fix = "Allow it longer steps along each axis (planning.limits.xyz, planning.limits.ball), or more of them"
        raise InputError(where=where, found=found, needed="a demonstration that succeeds", fix=fix)
    return shown.frames, shown.states


FILM, STILLS = "closed_loop.mp4", "closed_loop.png"
FORMAT = 2  # incremented when a reader of the file would have to change


@dataclass(frozen=True)
class BenchmarkOptions(RolloutSpec):
    """The problems of a benchmark, and the goals on the way. The stride is the model's, the films are of the model."""

    films: int = 6  # episodes in the video; 0: no video
    # demonstration: key frames of the oracle's solution; every-step: all of it; alike: of the demonstration most alike
    sub_goals: Literal["none", "demonstration", "every-step", "alike"] = "none"
    goals: str | None = None  # a folder of goals, the same in every problem


@dataclass(frozen=True)
class ClosedLoopBenchmark:
    """The results of a model (first), zero actions, chance and the oracle, on the same problems."""

    agent: Agent
    trials: Trials
    results: tuple[ClosedLoopResult, ...]

    @property
    def verdict(self) -> Verdict:
        """Whether the model plans better than what looks at no image."""
        shares = {result.policy: result.success_rate for result in self.results}
        model, *_, oracle = shares
        about = self.trials.as_dict()
        helped = {
            "demonstration": ", with key frames of the oracle's solution as sub-goals",
            "every-step": ", with each step of the oracle's solution as sub-goal",
            "alike": ", with key frames of the nearest demonstration as sub-goals",
        }.get(about["sub_goals"], f", with the goals in {about['goals']}" if about["goals"] else "")
        conditions = f"in {self.trials.place}{helped}"
        return closed_loop(shares, model, oracle, self.trials.episodes, self.trials.task_name, conditions)


def run_benchmark(
    agent: Agent, options: BenchmarkOptions, folder: Path, reporter: Reporter = SILENT
) -> tuple[ClosedLoopBenchmark, tuple[Path, ...]]:
    """Let all four solve the same problems; write closed_loop.json and the video. Cheap failures first.

    Args:
        agent: The model and its planning settings.
        options: The options.
        folder: The output folder; created if it is missing.
        reporter: Shows the progress of each policy.

    Raises:
        InputError: No such domain, a folder that is not writable, goals that cannot be used, or a problem that the
            oracle does not solve where its demonstration is wanted.
        UnreachableError: MuJoCo or PyAV is missing.
    """
    if options.films:
        video_library()
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
    options, limits = replace(options, stride=agent.stride), agent.planning.limits
    arm = arm_for(options.task, options.world, views=agent.planning.views)
    model = agent.policy(arm, _goals_of(agent, options, arm, reporter))
    policies = (model, ZeroActions(), RandomActions(limits, options.seed), Oracle(limits, arm))
    results = try_policies(SimulatedWorld(arm), policies, agent, options, options.films, reporter)
    benchmark = ClosedLoopBenchmark(agent, options, results)
    return benchmark, write_benchmark(benchmark, folder)


def try_policies(
    world: World, policies: Sequence[Policy], agent: Agent, trials: Trials, films: int, reporter: Reporter
) -> tuple[ClosedLoopResult, ...]:
    """Let policies solve the same problems; the first one is the model, with some episodes filmed.

    A note says how long all decisions of the model take, as soon as some were measured. The first one includes
    preparations, so the second one counts, unless the first one is long.
    """
    work = f"{counted(trials.episodes, 'episode')} x {counted(trials.model_steps, 'decision')}"
    work += f", {counted(sum(samples_of_iterations(agent.planning)), 'action sequence')} each"
    reporter.note(f"{work}; the first decision shows how long they take")
    results = list[ClosedLoopResult]()

    def shown(done: int, total: int) -> None:
        ends.append(time.monotonic())
        progress(done, total)
        if not results and done == (1 if ends[min(done, 1)] - ends[0] > _LONG_S else 2):
            seconds = ends[done] - ends[done - 1]
            reporter.note(f"{work}: {duration(total * seconds / 3600)} on this machine")

    for policy in policies:
        ends, progress = list[float](), reporter.task(f"{trials.task_name}: {policy.name}", "decisions")
        results.append(run_trials(world, policy, trials, 0 if results else films, shown))
    return tuple(results)


def write_benchmark(benchmark: ClosedLoopBenchmark, folder: Path) -> tuple[Path, ...]:
    """Write closed_loop.json, and a video of what was filmed; return the files.

    Raises:
        UnreachableError: PyAV is missing.
    """
    files, of_model = [folder / CLOSED_LOOP_FILE], benchmark.results[0]
    write_atomically(files[0], json.dumps(benchmark_as_dict(benchmark), indent=1, allow_nan=False) + "\n")
    if any(episode.frames is not None for episode in of_model.episodes):
        rate_hz = 1.0 / benchmark.trials.seconds_per_step
        write_atomically(folder / STILLS, encode_png(stills(of_model)))
        files += [write_video(folder / FILM, film_frames(of_model), rate_hz=rate_hz), folder / STILLS]
    return tuple(files)


def benchmark_as_dict(benchmark: ClosedLoopBenchmark) -> dict[str, Any]:
    """Return all metrics as plain values; see the docs for their meaning."""
    agent = benchmark.agent
    return {
        "format": FORMAT,
        "about": {
            **{name: getattr(agent, name) for name in ("subject", "checkpoint", "decoder")},
            **benchmark.trials.as_dict(),
            "planning": agent.planning.model_dump(mode="json"),
            "warnings": list(agent.warnings),
            "planning_seed": agent.seed,
            "version": __version__,
            "time": utc_now(),
        },
        "verdict": asdict(benchmark.verdict),
        "policies": {result.policy: _metrics(result) for result in benchmark.results},
    }


def _goals_of(agent: Agent, options: BenchmarkOptions, arm: SimulatedArm, reporter: Reporter) -> GoalsOf | None:
    """Return what makes the goals on the way; a problem without them has been refused when this returns."""
    if options.goals is not None:
        goals = agent.goals_of(read_goal_folder(Path(options.goals)))
        return lambda _: goals
    if options.sub_goals == "none":
        return None
    if options.sub_goals == "alike":
        return of_demonstrations_alike(agent, SimulatedWorld(arm), options.problems, reporter)
    steps = max(options.model_steps, STEPS[options.task])
    spec = DemonstrationSpec(agent.planning.limits, steps, agent.stride)
    if options.sub_goals == "every-step":
        spec = every_step(spec)
    goals_of = DemonstratedGoals(options.task, options.world, spec, views=agent.planning.views)
    reporter.task("demonstrations of all problems")
    goals_of.require(options.problems)
    return goals_of


def of_demonstrations_alike(
    agent: Agent, world: World, problems: Iterable[Problem], reporter: Reporter = SILENT
) -> GoalsOf:
    """Return what makes goals of the image at the start and that of the goal alone, by the agent's demonstrations.

    Raises:
        InputError: The agent has none, since it is behind a server; or as `goals_alike`.
    """
    if agent.goals_alike is None:
        needed = "the model itself: its server knows no demonstrations"
        raise InputError(where="--sub-goals alike", found=agent.subject, needed=needed)
    begun = {problem.index: world.begin(problem) for problem in problems}
    made = agent.goals_alike([(now.image, goal) for goal, now in begun.values()], reporter)
    goals = dict(zip(begun, made, strict=True))
    return lambda problem: goals[problem.index]


def _metrics(result: ClosedLoopResult) -> dict[str, Any]:
    return {
        "success": result.success_rate.as_dict(),
        "success_ever": result.success_ever_rate.as_dict(),
        "final_distance_cm": result.final_distance_cm.as_dict(),
        "steps_needed": None if result.steps_needed is None else result.steps_needed.as_dict(),
        "seconds_per_decision": result.seconds_per_decision.as_dict(),
        "why_counts": result.why_counts,
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
    return [[round(one, 4) for one in row] for row in numbers.tolist()]


_OUTCOMES = ("missed", "reached")
_HOLD = 4  # number of repetitions of the first and the last image of an episode


def film_frames(result: ClosedLoopResult) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield the frames of the video, one per model step, the first and last of an episode repeated."""
    spec, steps = result.spec, result.spec.model_steps
    for number, episode in enumerate(result.episodes, start=1):
        if episode.frames is None:
            return
        about = f"{spec.task_name}, {spec.place}    episode {number} of {len(result.episodes)}"
        for step, (frame, distance_m) in enumerate(zip(episode.frames, episode.distances_m, strict=True)):
            outcome = f"   {_OUTCOMES[episode.success]}" if step == steps else ""
            caption = f"{result.policy}:   {100 * distance_m:.1f} cm from the goal{outcome}"
            images, captions = [frame, episode.goal_image], [caption, "goal"]
            if any(one is not None for one in episode.imagined):
                image, about_it = _imagined(episode, step)
                images.append(image)
                captions.append(about_it)
            scale = _scale(frame)
            large = side_by_side(images[:1], captions[:1], f"{about}    step {step} of {steps}", enlarged=2 * scale)
            image = below_each_other([large, side_by_side(images[1:], captions[1:], enlarged=scale)])
            yield from itertools.repeat(image, _HOLD if step in {0, steps} else 1)


def _scale(image: UInt8[np.ndarray, "height width 3"]) -> int:
    """Return how much an image is to be enlarged, so that a caption has room over it."""
    return max(1, FRAME_SIZE[1] // int(image.shape[1]))


def stills(result: ClosedLoopResult) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return start, end and goal of the first three episodes, or of fewer if fewer were filmed."""
    rows = []
    for number, episode in enumerate(result.episodes[:3], start=1):
        if episode.frames is not None:
            start, end = (f"{100 * episode.distances_m[step]:.1f} cm from the goal" for step in (0, -1))
            captions = [f"start {number}: {start}", f"end: {end}, {_OUTCOMES[episode.success]}", "goal"]
            images = [episode.frames[0], episode.frames[-1], episode.goal_image]
            rows.append(side_by_side(images, captions, enlarged=_scale(episode.goal_image)))
    return below_each_other(rows)


def _imagined(episode: EpisodeResult, step: int) -> tuple[UInt8[np.ndarray, "height width 3"], str]:
    """Return what was imagined of this frame, and a caption; white where nothing was."""
    found, nothing = episode.imagined[step - 1] if step else None, np.full_like(episode.goal_image, 255)
    if not step:
        return nothing, "imagined one step ago: nothing yet"
    if found is None:
        return nothing, f"nothing imagined: {episode.whys[step - 1]}"
    return found, "imagined one step ago"
