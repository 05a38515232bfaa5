"""Tasks of third-party environments in the methods study: their changes, recordings, goals and closed loops."""

from __future__ import annotations

import pickle
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.config import DataConfig
from vjepa2_ac.goals.key_frames import Timing, make_sub_goals, select_every_nth_frame
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.benchmark import BenchmarkOptions
from vjepa2_ac.simulation.rollout import ClosedLoopResult, Environment, Image, Policy, Trial, Trials, run_trials
from vjepa2_ac.simulation.worlds import ExternalEnvironment, find_trials, record_world

ROOT = Path(__file__).resolve().parents[1]
STRIDE, EVERY = 4, 2  # control steps per model step, and per recorded frame
SIZE = 96  # pixels: those of the tiny encoder
EPISODES_BEFORE, EPISODES_AFTER = 120, 60  # recorded before and after the change
EPISODES_LIFT = 150  # after the change; Lift is also trained on 5 and 80 demonstrations
CHANGED = ("--camera", "40", "--mount", "20", "--look", "dusk")  # robosuite: another camera, mounting and light
FIRST = {"before": 0, "after": 10_000}  # seed of the recordings
SAME, OTHER, ONE_IMAGE = "l1", "another demonstration", "one image"
GOALS = (SAME, OTHER, ONE_IMAGE)
"""The goals of a closed loop. l1 (the name in stored results): the frames of the expert's solution of the same problem,
one for each model step. another demonstration: the frames of the recorded demonstration whose first frame is nearest to
the first frame of the problem. one image: the last frame of the expert's solution. With frames of a demonstration the
gripper follows the demonstration; with one image the planner chooses its motion."""
EXPERT = 0  # kind of a recording without disturbance, by the remainder of its seed divided by three (`worlds`)


@dataclass(frozen=True)
class Task:
    """A task of a third-party environment, before and after a change."""

    program: str  # name of the program in examples/worlds, and of its virtual environment
    before: tuple[str, ...]
    after: tuple[str, ...]
    seeds: int

    @property
    def is_installed(self) -> bool:
        """Whether the environment is installed (`make worlds/NAME`)."""
        return self._python.exists()

    @property
    def _python(self) -> Path:
        return ROOT / "worlds" / self.program / "bin" / "python"

    def command(self, when: str) -> str:
        """Return the command that starts the environment."""
        words = self.before if when == "before" else self.after
        program = ROOT / "examples" / "worlds" / f"{self.program}.py"
        return shlex.join([str(self._python), str(program), *words, "--size", str(SIZE)])


TASKS = {
    "Lift": Task("robosuite", ("Lift",), ("Lift", *CHANGED), seeds=5),
    "LIBERO-object": Task("libero", ("libero_spatial", "--near"), ("libero_spatial_object", "--near"), seeds=3),
}


def data_of(folder: Path, task: str, when: str) -> DataConfig:
    """Return the data config of a task; after the change, two thirds of the episodes are for training."""
    held_out = {"validation_share": 0.1, "test_share": 0.1 if when == "before" else 0.25}
    latents = {"cache": "auto", "cache_dir": str(folder / "latents"), "workers": 0}
    path = str(folder / f"data-{task}-{when}")
    return DataConfig.model_validate(
        {"source": "npz", "path": path, "frames": 4, "stride": STRIDE // EVERY, **held_out, **latents}
    )


def record(folder: Path, task: str, when: str) -> None:
    """Record the missing demonstrations of a task."""
    num_after = EPISODES_LIFT if task == "Lift" else EPISODES_AFTER
    first, count = FIRST[when], EPISODES_BEFORE if when == "before" else num_after
    path = Path(data_of(folder, task, when).path)
    if len(list(path.glob("*.npz"))) < count:
        print(f"recording {path}", flush=True)
        with ExternalEnvironment(TASKS[task].command(when)) as world:
            record_world(world, path, range(first, first + count), every=EVERY)


def problems(folder: Path, task: str, seed: int, goals: int, when: str = "after") -> tuple[Trials, ClosedLoopResult]:
    """Return the problems, with a goal for each model step; they are stored, because the expert is slow."""
    suffix = "-before" if when == "before" else ""
    path = folder / "problems" / f"{task}{suffix}-{seed}-{goals}.pickle"
    if not path.exists():
        options = BenchmarkOptions(episodes=goals, seed=seed, sub_goals="every-step")
        with ExternalEnvironment(TASKS[task].command(when)) as world:
            trials_and_expert = find_trials(world, options, STRIDE)
        path.parent.mkdir(exist_ok=True)
        path.with_suffix(".part").write_bytes(pickle.dumps(trials_and_expert))
        path.with_suffix(".part").rename(path)
    return pickle.loads(path.read_bytes())  # type: ignore[no-any-return]  # noqa: S301 - written by this program


def closed_loops(
    folder: Path,
    task: str,
    policy: Policy,
    *,
    seed: int,
    goals: int,
    when: str = "after",
    conditions: Sequence[str] = GOALS,
) -> dict[str, dict[str, Any]]:
    """Return the results of a policy on the expert's problems, by kind of goals (`GOALS`).

    `when` is before or after the change. Each result has the versions that the environment reports.
    """
    trials, expert = problems(folder, task, seed, goals, when)
    demonstrations = Path(data_of(folder, task, when).path)
    with ExternalEnvironment(TASKS[task].command(when)) as world:
        loops = {
            condition: run_trials(world, policy, set_goals(trials, condition, world, demonstrations))
            for condition in conditions
        }
        versions = dict(world.about.versions)
    return {condition: summarize(loop, expert) | {"versions": versions} for condition, loop in loops.items()}


def set_goals(trials: Trials, condition: str, world: Environment, folder: Path) -> Trials:
    """Return trials with the goals of a condition (`GOALS`).

    Args:
        trials: Trials with the goals `SAME` and a goal image.
        condition: The kind of goals.
        world: The environment, which renders the first frames of the problems.
        folder: The recordings.
    """
    if condition == SAME:
        return trials
    demonstrations = read_demonstrations(folder) if condition == OTHER else []

    def goals_of(trial: Trial) -> tuple[SubGoal, ...]:
        if condition == ONE_IMAGE:
            assert trial.goal_image is not None, "the last frame of the expert's solution"
            return (SubGoal(trial.goal_image, gripper="rounded"),)
        observation, _ = world.reset(seed=trial.seed, options={"stride": trial.stride})
        return select_nearest(demonstrations, observation.image)

    return replace(trials, trials=tuple(replace(trial, goals=goals_of(trial)) for trial in trials.trials))


@dataclass(frozen=True, eq=False)
class Demonstration:
    """A recorded solution: its first frame, and a goal for each model step."""

    first_frame: Image
    goals: tuple[SubGoal, ...]


def read_demonstrations(folder: Path) -> list[Demonstration]:
    """Return the undisturbed recordings of the expert that end with success."""
    demonstrations = []
    for path in sorted(folder.glob("*.npz")):
        if int(path.stem.rsplit("_", 1)[1]) % 3 != EXPERT:
            continue
        with np.load(path) as recorded:
            if recorded["success"]:
                rows = slice(None, None, STRIDE // EVERY)
                frames, states = recorded["frames"][rows], recorded["states"][rows]
                keys = select_every_nth_frame(len(frames), 1)
                goals = make_sub_goals([frames[key.frame] for key in keys], keys, Timing(1, slack=1), states)
                demonstrations.append(Demonstration(frames[0], goals))
    return demonstrations


def select_nearest(demonstrations: Sequence[Demonstration], frame: Image) -> tuple[SubGoal, ...]:
    """Return the goals of the demonstration whose first frame is nearest to a frame, in mean absolute difference."""
    distances = [float(np.abs(each.first_frame.astype(float) - frame).mean()) for each in demonstrations]
    return demonstrations[int(np.argmin(distances))].goals


def summarize(result: ClosedLoopResult, expert: ClosedLoopResult) -> dict[str, Any]:
    """Return the objects' distances to goals and the hand's final distance to the expert's (cm), and the successes."""
    ends = [np.stack([episode.states[-1, :3] for episode in each.episodes]) for each in (result, expert)]
    return {
        "distance_cm": np.round(result.distance_cm, 3).tolist(),
        "hand_cm": np.round(100 * np.linalg.norm(ends[0] - ends[1], axis=1), 3).tolist(),
        "solved": result.successes.tolist(),
    }
