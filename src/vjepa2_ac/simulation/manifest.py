"""Problem manifests: the problems, the search and the seeds of a closed-loop measurement, in a file for repetitions."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
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
from vjepa2_ac.simulation.rollout import ClosedLoopResult
from vjepa2_ac.simulation.tasks import TaskName, TaskProblem
from vjepa2_ac.simulation.worlds import EnvironmentInfo, ExternalEnvironment
from vjepa2_ac.storage import translate_write_errors, write_atomically
from vjepa2_ac.storage.structured import format_json, parse_record, read_json_object

FORMAT: Literal[1] = 1  # incremented at changes that require changes of readers
_NEEDED = "a manifest, as `vjepa2-ac simulate --manifest` writes it"
_BUDGET = (
    *("planner", "horizon", "action_repeat", "samples", "iterations", "budget_s", "limits", "energy", "warm_start"),
    "views",
)
_PROGRAM, _LIBRARIES = "vjepa2-ac", ("torch", "numpy", "scipy")
_SAME_M = 1e-3  # two starts with a smaller difference are the same
_Pose = Annotated[tuple[float, ...], Field(min_length=4, max_length=7)]


@dataclass(frozen=True)
class _Settings:
    """The steps, budget and seeds of a measurement, and the versions of this program and its libraries."""

    format: Literal[1]
    seed: int  # seed from which the problems were drawn
    steps: Annotated[int, Field(ge=1)]  # model steps per problem
    stride: Annotated[int, Field(ge=1)]  # control steps per model step
    sub_goals: SubGoals
    planning: dict[str, Any]  # the keys of the config section `planning` that determine the search
    planning_seed: int
    versions: dict[str, str]  # not compared: other versions may change last digits

    @property
    def overrides(self) -> list[str]:
        """The settings for planning as overrides of a config."""
        return [f"planning.{key}={json.dumps(value)}" for key, value in self.planning.items()]

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

    def _get_common_options(self, episodes: int, films: int) -> dict[str, Any]:
        common = {name: getattr(self, name) for name in ("seed", "steps", "stride", "sub_goals")}
        return dict(common, episodes=episodes, films=min(films, episodes))


def _get_search(subject: Subject) -> dict[str, Any]:
    planning = subject.config.planning.model_dump(mode="json")
    return {"planning": {key: planning[key] for key in _BUDGET}, "planning_seed": subject.config.seed}


def _list_versions(*more: str) -> dict[str, str]:
    return {_PROGRAM: __version__} | {name: version(name) for name in (*_LIBRARIES, *more)}


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
class Manifest(_Settings):
    """The problems and settings of a measurement on the simulated arm."""

    task: TaskName
    domain: Domain
    problems: Annotated[tuple[ManifestProblem, ...], Field(min_length=1)]

    @classmethod
    def of(cls, options: BenchmarkOptions, subject: Subject) -> Manifest:
        """Return the manifest of a measurement before it starts.

        Args:
            options: The problems.
            subject: The model, loaded for planning; its stride and its settings for planning are used.
        """
        stride = subject.config.data.model_stride
        trials = replace(options, stride=stride).trials()
        return cls(
            format=FORMAT,
            task=options.task,
            domain=options.world,
            seed=options.seed,
            steps=trials.steps,
            stride=stride,
            sub_goals=options.sub_goals,
            **_get_search(subject),
            problems=tuple(ManifestProblem.of(trial.problem) for trial in trials.trials if trial.problem is not None),
            versions=_list_versions("mujoco"),
        )

    def options(self, films: int) -> BenchmarkOptions:
        """Return the problems as options of a benchmark."""
        return BenchmarkOptions(
            task=self.task,
            domain=self.domain,
            **self._get_common_options(len(self.problems), films),
            problems=tuple(problem.as_problem(self.task) for problem in self.problems),
        )


# ---- third-party environments ----


@dataclass(frozen=True)
class WorldProblem:
    """The seed of one problem, and its start, by which another environment is recognised."""

    seed: int
    start: Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]  # state of the hand
    distance_m: float  # distance of the task's object from its goal at the start


@dataclass(frozen=True)
class WorldManifest(_Settings):
    """The problems and settings of a measurement in a third-party environment.

    A problem is the seed with which the environment is reset. The goals are images of the expert's solution, which are
    not stored: the expert of the environment solves the problems again.
    """

    world: str  # name and version of the environment
    task: str
    command: tuple[str, ...]  # the program and its arguments, without paths
    rate_hz: float  # control steps per second
    world_versions: dict[str, str]  # versions of the environment's libraries, as its program reports them
    problems: Annotated[tuple[WorldProblem, ...], Field(min_length=1)]

    @classmethod
    def of(
        cls, options: BenchmarkOptions, subject: Subject, world: ExternalEnvironment, expert: ClosedLoopResult
    ) -> WorldManifest:
        """Return the manifest of a measurement after the expert has solved its problems.

        Args:
            options: The options of the measurement.
            subject: The model, loaded for planning.
            world: The environment.
            expert: Results of the expert on the problems.
        """
        return cls(
            format=FORMAT,
            world=world.about.world,
            task=world.about.task,
            command=remove_paths(world.command),
            rate_hz=world.about.rate_hz,
            seed=options.seed,
            steps=expert.trials.steps,
            stride=subject.config.data.model_stride,
            sub_goals=options.sub_goals,
            **_get_search(subject),
            problems=tuple(_list_world_problems(expert)),
            versions=_list_versions(),
            world_versions=dict(world.about.versions),
        )

    def options(self, films: int) -> BenchmarkOptions:
        """Return the problems as options of a benchmark."""
        return BenchmarkOptions(
            **self._get_common_options(len(self.problems), films),
            seeds=tuple(problem.seed for problem in self.problems),
        )

    def require_environment(self, world: ExternalEnvironment) -> None:
        """Check that an environment has the task, the arguments and the control rate of the manifest.

        Raises:
            InputError: One of them differs.
        """
        about, command = world.about, remove_paths(world.command)
        for name, value, needed in (
            ("task", about.task, self.task),
            ("command", shlex.join(command), shlex.join(self.command)),
            ("rate_hz", about.rate_hz, self.rate_hz),
        ):
            if value != needed:
                fix = "Start the environment of the manifest, or write another manifest"
                raise world.error(f"{name} {value}", f"{needed}, as in the manifest", fix)

    def describe_versions(self, about: EnvironmentInfo) -> list[str]:
        """Return a line for each difference between the versions of an environment and those of the manifest."""
        names = sorted(self.world_versions.keys() | about.versions.keys())
        pairs = {"environment": (about.world, self.world)} | {
            name: (about.versions.get(name, ""), self.world_versions.get(name, "")) for name in names
        }
        return [
            f"{name}: {reported or 'version not reported'}, in the manifest {expected or 'not reported'}"
            for name, (reported, expected) in pairs.items()
            if reported != expected
        ]

    def describe_starts(self, expert: ClosedLoopResult) -> list[str]:
        """Return a line for each problem that the expert does not solve here, or that starts differently here."""
        here, lines = {problem.seed: problem for problem in _list_world_problems(expert)}, list[str]()
        for problem in self.problems:
            if problem.seed not in here:
                lines.append(f"problem {problem.seed}: left out, because the expert does not solve it")
                continue
            start = here[problem.seed]
            hand_m = float(np.linalg.norm(np.subtract(start.start[:3], problem.start[:3])))
            object_m = abs(start.distance_m - problem.distance_m)
            if max(hand_m, object_m) > _SAME_M:
                moved = f"the hand {100 * hand_m:.1f} cm, the object's distance {100 * object_m:.1f} cm"
                lines.append(f"problem {problem.seed}: another start than in the manifest ({moved})")
        return lines


def remove_paths(command: str) -> tuple[str, ...]:
    """Return the program of a command and its arguments: without the interpreter of a script, and without folders."""
    words = [re.sub(r"[^=]*/", "", word) for word in shlex.split(command)]
    scripts = [number for number, word in enumerate(words) if word.endswith(".py")]
    return tuple(words[scripts[0] if scripts else 0 :])


def _list_world_problems(expert: ClosedLoopResult) -> Iterator[WorldProblem]:
    for episode in expert.episodes:
        state = tuple(float(number) for number in episode.states[0])
        yield WorldProblem(episode.trial.seed, state, float(episode.distances_m[0]))


def read_manifest(path: Path) -> Manifest | WorldManifest:
    """Read a manifest of the simulated arm or of a third-party environment.

    Raises:
        InputError: The file is not a manifest, or is damaged.
    """
    where, fix = f"--manifest {path}", "Download or write the manifest again"
    values = read_json_object(path, needed=_NEEDED, fix=fix)
    kind: type[Manifest | WorldManifest] = WorldManifest if "world" in values else Manifest
    manifest = parse_record(kind, values, where=where, needed=_NEEDED, fix=fix)
    if unknown := manifest.planning.keys() - set(_BUDGET):
        raise InputError(where=where, found=f"planning.{min(unknown)}", needed=_NEEDED, fix=fix)
    return manifest
