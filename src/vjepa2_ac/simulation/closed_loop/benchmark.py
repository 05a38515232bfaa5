"""The closed-loop benchmark, and its film: a model beside doing nothing, chance and an oracle, on the same problems."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.media.video import video_library, write_video
from vjepa2_ac.planning.goal_folder import read_goal_folder
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.reports.figures.film import side_by_side
from vjepa2_ac.simulation.closed_loop.policies import DoNothing, GoalsOf, Policy, RandomActions, oracle_for
from vjepa2_ac.simulation.closed_loop.rollout import ClosedLoopResult, EpisodeResult, RolloutSpec, run_task
from vjepa2_ac.simulation.closed_loop.steering import Steering
from vjepa2_ac.simulation.closed_loop.sub_goals import DemonstratedGoals, DemonstrationSpec, every_step
from vjepa2_ac.simulation.closed_loop.tasks import ALSO, STEPS, SUCCESS_M, TaskName, TaskProblem, arm_for, make_problem
from vjepa2_ac.simulation.world.arm import SimulatedArm
from vjepa2_ac.simulation.world.domains import named_domain
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import utc_now

FILE, FILM = "closed_loop.json", "closed_loop.mp4"
SubGoalsFrom = Literal["none", "demonstration", "every-step"]
FORMAT = 1  # incremented when a reader of the file would have to change


@dataclass(frozen=True)
class BenchmarkOptions:
    """The options of a benchmark."""

    task: TaskName = "reach"
    domain: str = "A"
    episodes: int = 50
    steps: int | None = None  # model steps of an episode; None: the task's default
    seed: int = 0  # of the problems
    films: int = 6  # episodes in the video; 0: no video
    sub_goals: SubGoalsFrom = "none"  # demonstration: key frames of the oracle's solution; every-step: all of it
    goals: str | None = None  # a folder of goals, the same in every problem

    @property
    def problems(self) -> Iterator[TaskProblem]:
        """The problems that every policy solves."""
        domain = named_domain(self.domain)
        return (make_problem(self.task, domain, self.seed, index) for index in range(self.episodes))


@dataclass(frozen=True)
class ClosedLoopBenchmark:
    """The results of a model (first), doing nothing, chance and the oracle, on the same problems."""

    subject: str
    checkpoint: str  # which one, as text; "" of a model
    options: BenchmarkOptions
    planning: dict[str, Any]  # settings, as plain values
    planning_seed: int
    results: tuple[ClosedLoopResult, ...]
    warnings: tuple[str, ...] = ()  # of the session
    decoder: str | None = None  # by which the video shows what was imagined

    @property
    def seconds_per_step(self) -> float:
        """Length of a model step in seconds."""
        return self.results[0].stride / CONTROL_RATE_HZ


def run_benchmark(
    steering: Steering, options: BenchmarkOptions, folder: Path, reporter: Reporter = SILENT
) -> tuple[ClosedLoopBenchmark, tuple[Path, ...]]:
    """Let all four solve the same problems; write closed_loop.json and the video. Cheap failures first.

    Args:
        steering: The model and its planning settings: `steering.of_session`, or `of_server`.
        options: The options.
        folder: The output folder; created if it is missing.
        reporter: Shows the progress of each policy.

    Raises:
        InputError: MuJoCo or PyAV is missing, no such domain, a folder that is not writable, goals that cannot be used,
            or a problem that the oracle does not solve where its demonstration is wanted.
    """
    if options.films:
        video_library()
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
    arm = arm_for(options.task, named_domain(options.domain))
    model = steering.policy(arm, _goals_of(steering, options))
    results = []
    for policy in (model, *_references(steering.limits, options, arm)):
        films = options.films if policy is model else 0
        spec = RolloutSpec(
            options.task, arm.domain, options.episodes, options.seed, options.steps, steering.stride, films
        )
        results.append(run_task(spec, policy, arm, reporter.task(f"{options.task}: {policy.name}")))
    benchmark = ClosedLoopBenchmark(
        steering.subject,
        steering.checkpoint,
        options,
        steering.planning.model_dump(mode="json"),
        steering.seed,
        tuple(results),
        steering.warnings,
        steering.decoder,
    )
    path = folder / FILE
    write_atomically(path, json.dumps(benchmark_as_dict(benchmark), indent=1, allow_nan=False) + "\n")
    return benchmark, (path, write_film(folder / FILM, results[0])) if options.films else (path,)


def benchmark_as_dict(benchmark: ClosedLoopBenchmark) -> dict[str, Any]:
    """Return all metrics as plain values; see the docs for their meaning."""
    return {
        "format": FORMAT,
        "about": {
            "subject": benchmark.subject,
            "checkpoint": benchmark.checkpoint,
            **{key: value for key, value in dataclasses.asdict(benchmark.options).items() if key != "films"},
            "steps": benchmark.results[0].steps,
            "stride": benchmark.results[0].stride,
            "seconds_per_step": benchmark.seconds_per_step,
            "success_below_cm": 100 * SUCCESS_M[benchmark.options.task],
            "success_also": ALSO[benchmark.options.task],
            "planning": benchmark.planning,
            "warnings": list(benchmark.warnings),
            "planning_seed": benchmark.planning_seed,
            "decoder": benchmark.decoder,
            "version": __version__,
            "time": utc_now(),
        },
        "policies": {result.policy: _metrics(result) for result in benchmark.results},
    }


def _goals_of(steering: Steering, options: BenchmarkOptions) -> GoalsOf | None:
    """Return what makes the goals on the way; each problem has been demonstrated once when this returns."""
    if options.goals is not None:
        goals = steering.goals_of(read_goal_folder(Path(options.goals)))
        return lambda _: goals
    if options.sub_goals == "none":
        return None
    steps = max(options.steps or 0, STEPS[options.task])
    spec = DemonstrationSpec(steering.limits, steps, steering.stride)
    if options.sub_goals == "every-step":
        spec = every_step(spec)
    goals_of = DemonstratedGoals(options.task, named_domain(options.domain), spec)
    goals_of.require(options.problems)
    return goals_of


def _references(limits: LimitsConfig, options: BenchmarkOptions, arm: SimulatedArm) -> Sequence[Policy]:
    return DoNothing(), RandomActions(limits, seed=options.seed), oracle_for(options.task, limits, arm)


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
    if not np.isfinite(numbers).all():
        raise ValueError("a number among the metrics of episodes is not finite")
    return [[round(one, 4) for one in row] for row in numbers.tolist()]


_HOLD = 4  # number of repetitions of the first and the last image of an episode


def write_film(path: str | Path, result: ClosedLoopResult) -> Path:
    """Write the stored frames of a policy as a video, in real time.

    Args:
        path: Of an MP4.
        result: One camera image beside the goal image.

    Raises:
        InputError: PyAV is not installed.
        ValueError: No frames were stored.
    """
    return write_video(path, film_frames(result), rate_hz=CONTROL_RATE_HZ / result.stride)


def film_frames(result: ClosedLoopResult) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield the frames of the video, one per model step, the first and last of an episode repeated."""
    for number, episode in enumerate(result.episodes, start=1):
        if episode.frames is None:
            return
        about = f"{result.task}, domain {result.domain}    episode {number} of {len(result.episodes)}"
        for step, (frame, distance_m) in enumerate(zip(episode.frames, episode.distances_m, strict=True)):
            outcome = ("   missed", "   reached")[episode.success] if step == result.steps else ""
            caption = f"{result.policy}:   {100 * distance_m:.1f} cm from the goal{outcome}"
            title = f"{about}    step {step} of {result.steps}"
            images, captions = [frame, episode.goal_image], [caption, "goal"]
            if any(one is not None for one in episode.imagined):
                images.append(_imagined(episode, step))
                captions.append(_about_imagined(episode, step))
            image = side_by_side(images, captions, title)
            yield from itertools.repeat(image, _HOLD if step in {0, result.steps} else 1)


def _imagined(episode: EpisodeResult, step: int) -> UInt8[np.ndarray, "height width 3"]:
    """Return what was imagined of this frame; white where nothing was."""
    found = episode.imagined[step - 1] if step else None
    return np.full_like(episode.goal_image, 255) if found is None else found


def _about_imagined(episode: EpisodeResult, step: int) -> str:
    if step and episode.imagined[step - 1] is None:
        return f"nothing imagined: {episode.whys[step - 1]}"
    return "imagined one step ago" if step else "imagined one step ago: nothing yet"
