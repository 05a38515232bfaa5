"""Problem manifests: the problems, the search and the seeds of a closed-loop measurement, in a file for repetitions."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vjepa2_ac import __version__
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, SubGoals
from vjepa2_ac.simulation.domains import Domain
from vjepa2_ac.simulation.tasks import TaskName, TaskProblem
from vjepa2_ac.storage import translate_write_errors, write_atomically
from vjepa2_ac.storage.structured import format_json, parse_record, read_json_object

FORMAT: Literal[1] = 1  # incremented at changes that require changes of readers
_NEEDED = "a manifest, as `vjepa2-ac simulate --manifest` writes it"
_BUDGET = ("planner", "horizon", "action_repeat", "samples", "iterations", "limits", "energy", "warm_start")
_PROGRAM, _LIBRARIES = "vjepa2-ac", ("torch", "mujoco", "numpy", "scipy")
_Pose = Annotated[tuple[float, ...], Field(min_length=4, max_length=7)]


@dataclass(frozen=True)
class ManifestProblem:
    """Start and goal of one problem, in the base frame of the arm; a block has x, y, z and its rotation about z."""

    index: int
    start: _Pose
    goal: _Pose
    block_start: _Pose | None = None
    block_goal: _Pose | None = None

    @classmethod
    def of(cls, problem: TaskProblem) -> ManifestProblem:
        """Return a problem as plain values."""
        poses = (problem.start, problem.goal, problem.block_start, problem.block_goal)
        return cls(problem.index, *(None if pose is None else tuple(pose.tolist()) for pose in poses))  # type: ignore[arg-type]  # start and goal are never None

    def as_problem(self, task: TaskName) -> TaskProblem:
        """Return the problem with arrays."""
        poses = (self.start, self.goal, self.block_start, self.block_goal)
        return TaskProblem(task, self.index, *(None if pose is None else np.array(pose) for pose in poses))  # type: ignore[arg-type]  # as above


@dataclass(frozen=True)
class Manifest:
    """The problems, steps, budget and seeds of a measurement on the simulated arm, and the versions that made it."""

    format: Literal[1]
    task: TaskName
    domain: Domain
    seed: int  # seed from which the problems were drawn
    steps: Annotated[int, Field(ge=1)]  # model steps per problem
    stride: Annotated[int, Field(ge=1)]  # control steps per model step
    sub_goals: SubGoals
    planning: dict[str, Any]  # the keys of the config section `planning` that determine the search
    planning_seed: int
    problems: Annotated[tuple[ManifestProblem, ...], Field(min_length=1)]
    versions: dict[str, str]  # not compared: other versions may change last digits

    @classmethod
    def of(cls, options: BenchmarkOptions, subject: Subject) -> Manifest:
        """Return the manifest of a measurement before it starts.

        Args:
            options: The problems.
            subject: The model, loaded for planning; its stride and its settings for planning are used.
        """
        stride = subject.config.data.model_stride
        trials, planning = replace(options, stride=stride).trials(), subject.config.planning.model_dump(mode="json")
        return cls(
            format=FORMAT,
            task=options.task,
            domain=options.world,
            seed=options.seed,
            steps=trials.steps,
            stride=stride,
            sub_goals=options.sub_goals,
            planning={key: planning[key] for key in _BUDGET},
            planning_seed=subject.config.seed,
            problems=tuple(ManifestProblem.of(trial.problem) for trial in trials.trials if trial.problem is not None),
            versions={_PROGRAM: __version__} | {name: version(name) for name in _LIBRARIES},
        )

    @property
    def overrides(self) -> list[str]:
        """The settings for planning as overrides of a config."""
        return [f"planning.{key}={json.dumps(value)}" for key, value in self.planning.items()]

    def options(self, films: int) -> BenchmarkOptions:
        """Return the problems as options of a benchmark."""
        return BenchmarkOptions(
            task=self.task,
            domain=self.domain,
            episodes=len(self.problems),
            seed=self.seed,
            steps=self.steps,
            stride=self.stride,
            films=min(films, len(self.problems)),
            sub_goals=self.sub_goals,
            problems=tuple(problem.as_problem(self.task) for problem in self.problems),
        )

    def require_stride(self, stride: int) -> None:
        """Check that a model has the length of a model step for which the manifest was written.

        Raises:
            InputError: It has another one.
        """
        if stride != self.stride:
            needed = f"{self.stride}, the stride of the manifest"
            fix = "Use a model with this stride, or write another manifest"
            raise InputError(where="data.stride", found=str(stride), needed=needed, fix=fix)

    def write(self, path: Path) -> None:
        """Write the manifest.

        Raises:
            InputError: The file cannot be written.
        """
        with translate_write_errors(f"--manifest {path}"):
            write_atomically(path, format_json(asdict(self)))


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        InputError: The file is not a manifest, or is damaged.
    """
    where, fix = f"--manifest {path}", "Download or write the manifest again"
    values = read_json_object(path, needed=_NEEDED, fix=fix)
    manifest = parse_record(Manifest, values, where=where, needed=_NEEDED, fix=fix)
    if unknown := manifest.planning.keys() - set(_BUDGET):
        raise InputError(where=where, found=f"planning.{min(unknown)}", needed=_NEEDED, fix=fix)
    return manifest
