"""Tasks of third-party environments in the methods study: their changes, recordings and closed loops."""

from __future__ import annotations

import pickle
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.config import DataConfig
from vjepa2_ac.simulation.benchmark import BenchmarkOptions
from vjepa2_ac.simulation.rollout import ClosedLoopResult, Policy, Trials, run_trials
from vjepa2_ac.simulation.worlds import ExternalEnvironment, find_trials, record_world

ROOT = Path(__file__).resolve().parents[1]
STRIDE, EVERY = 4, 2  # control steps per model step, and per recorded frame
SIZE = 96  # pixels: those of the tiny encoder
EPISODES_BEFORE, EPISODES_AFTER = 120, 60  # recorded before and after the change
EPISODES_LIFT = 150  # after the change; Lift is also trained on 5 and 80 demonstrations
CHANGED = ("--camera", "40", "--mount", "20", "--look", "dusk")  # robosuite: another camera, mounting and light
FIRST = {"before": 0, "after": 10_000}  # seed of the recordings


@dataclass(frozen=True)
class Task:
    """A task of a third-party environment, before and after a change."""

    program: str  # name of the program in examples/worlds, and of its virtual environment
    before: tuple[str, ...]
    after: tuple[str, ...]
    origin: str | None = None  # the task with the same recordings before the change and the same base model
    seeds: int = 1  # one seed suffices for a task that no method solves

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
    **{name: Task("robosuite", (name,), (name, *CHANGED)) for name in ("Door", "Stack")},
    "Lift by a UR5e": Task("robosuite", ("Lift",), ("Lift", "--robot", "UR5e"), origin="Lift"),
    "LIBERO-swap": Task("libero", ("libero_object", "--near"), ("libero_object_swap", "--near")),
    "LIBERO-object": Task("libero", ("libero_spatial", "--near"), ("libero_spatial_object", "--near"), seeds=3),
}


def origin_of(task: str) -> str:
    """Return the task whose recordings before the change and base model this task uses."""
    return TASKS[task].origin or task


def data_of(folder: Path, task: str, when: str) -> DataConfig:
    """Return the data config of a task; after the change, two thirds of the episodes are for training."""
    task = task if when == "after" else origin_of(task)
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


def closed_loop(
    folder: Path, task: str, policy: Policy, *, seed: int, goals: int, when: str = "after"
) -> dict[str, Any]:
    """Return the results of a policy on the expert's problems, before or after the change."""
    trials, expert = problems(folder, task, seed, goals, when)
    with ExternalEnvironment(TASKS[task].command(when)) as world:
        return summarize(run_trials(world, policy, trials), expert)


def summarize(result: ClosedLoopResult, expert: ClosedLoopResult) -> dict[str, Any]:
    """Return the objects' distances to goals and the hand's final distance to the expert's (cm), and the successes."""
    ends = [np.stack([episode.states[-1, :3] for episode in each.episodes]) for each in (result, expert)]
    return {
        "distance_cm": np.round(result.distance_cm, 3).tolist(),
        "hand_cm": np.round(100 * np.linalg.norm(ends[0] - ends[1], axis=1), 3).tolist(),
        "solved": result.successes.tolist(),
    }
