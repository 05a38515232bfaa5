"""Worlds that others made: a program in an environment of its own is one more place for a model to act in.

The program reads requests and writes answers, one JSON object a line, on its standard input and output. It knows
nothing of this project, so that its pins are its own. docs/worlds.md has the protocol; examples/worlds three programs.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from threading import Thread
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.goals.key_frames import (
    OF_MODEL_STEPS,
    Timing,
    every_key_frame,
    gripper_key_frames,
    sub_goals_of,
)
from vjepa2_ac.media.video import video_library
from vjepa2_ac.planning.goals import SubGoal, read_goal_folder
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.simulation.agent import Agent
from vjepa2_ac.simulation.benchmark import (
    BenchmarkOptions,
    ClosedLoopBenchmark,
    DemonstrationSpec,
    every_step,
    of_demonstrations_alike,
    try_policies,
    write_benchmark,
)
from vjepa2_ac.simulation.policies import GoalsOf, Image, Moves, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import (
    ClosedLoopResult,
    EpisodeResult,
    Observation,
    Span,
    commanded,
)
from vjepa2_ac.simulation.tasks import Problem
from vjepa2_ac.spaces import POSE, actions_from_states
from vjepa2_ac.storage import user_can_write
from vjepa2_ac.storage.structured import record_of

_ANSWER_S = 120.0
LOADING = 5  # the first answer may take this many times as long
_ENDS_S = 10.0  # time that a world has to exit when its input has ended
_MOST_BYTES = 64 << 20  # of a line: an image of 16 million pixels in base64
_MOST_SHOWN = 200  # bytes of a wrong line
_ERROR_BYTES, _ERROR_LINES = 64 << 10, 5  # of the error output: kept, and shown
_KEEPER = "import os, sys; world = int(sys.stdin.readline()); sys.stdin.read(); os.killpg(world, 9)"
PROTOCOL = "docs/worlds.md has the protocol; examples/worlds programs that follow it"
EXPERT = "expert"
TRIES = 2  # so many times the problems are drawn, until the expert has solved enough of them


class WorldProcess(ExitStack):
    """A program that answers each line of its input with one line; `close` ends it and every process of its group.

    A second process, the keeper, kills the group when this process dies, even by SIGKILL: the keeper's input ends then,
    because only this process can write to it. Unlike prctl(PR_SET_PDEATHSIG) this works on every Unix, whatever thread
    started the world, and reaches the children of a shell.

    Args:
        command: The program and its arguments, as in a shell.
        timeout_s: Longest wait for an answer; for the first one, which includes loading, `LOADING` times as long. None:
            120 seconds.

    Raises:
        InputError: The program cannot be started.
    """

    def __init__(self, command: str, timeout_s: float | None = None) -> None:
        super().__init__()
        self.where, self._timeout_s, self._errors = f"--world {command!r}", timeout_s or _ANSWER_S, b""
        try:
            keeper = self._started([sys.executable, "-I", "-S", "-c", _KEEPER], DEVNULL)
            self.callback(keeper.kill)
            self._process = self._started(shlex.split(command) or [""], PIPE)
        except (OSError, ValueError) as error:
            self.close()
            raise self.refused(f"it cannot be started: {error}") from None
        keeper.stdin.write(b"%d\n" % self._process.pid)
        os.set_blocking(self._process.stdin.fileno(), False)
        self._output, self._poll = self._process.stdout.fileno(), select.poll()
        self._poll.register(self._output, select.POLLIN)
        self._reader = Thread(target=self._read_errors, daemon=True)
        self._reader.start()
        self.callback(self._end)

    def exchange(self, request: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send a request and return its answer; None: return what the program writes at its start.

        Raises:
            InputError: There is no answer in time, or it is no JSON object, or an error, or not the only one.
        """
        if request is not None:
            self._send(f"{json.dumps(request)}\n".encode())
        line = self._line(self._timeout_s * (LOADING if request is None else 1))
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):
            raise self.refused(f"it wrote {_shown(line)}", "a JSON object in a line") from None
        if not isinstance(answer, dict) or "error" in answer:
            raise self.refused(str(answer["error"] if isinstance(answer, dict) else answer))
        return answer

    def refused(self, found: str, needed: str = "", fix: str = PROTOCOL) -> InputError:
        """Return an error that names the command of this world."""
        return InputError(where=self.where, found=found, needed=needed, fix=fix)

    def _started(self, words: list[str], errors: int) -> Any:
        process = Popen(words, stdin=PIPE, stdout=PIPE, stderr=errors, bufsize=0, start_new_session=True)  # noqa: S603
        return self.enter_context(process)

    def _send(self, line: bytes) -> None:
        if self._poll.poll(0) and (unasked := os.read(self._output, _MOST_SHOWN)):
            raise self.refused(f"it wrote {_shown(unasked)} without a request", "one answer for each request")
        with suppress(BrokenPipeError):  # the program has ended, which `_line` reports
            if self._process.stdin.write(line) is None:  # written as a whole or not at all: it is below PIPE_BUF
                raise self.refused("it does not read its requests", "one answer for each request")

    def _line(self, limit_s: float) -> bytes:
        """Return the next line of the program's output.

        Raises:
            InputError: It does not end in time, or is too long, or is not the last one, or the output has ended.
        """
        parts, end_s = [b""], time.monotonic() + limit_s
        while b"\n" not in parts[-1]:
            if not self._poll.poll(1000 * max(0.0, end_s - time.monotonic())):
                now = f"now {self._timeout_s:g} s, and {LOADING} times as long for the first answer"
                raise self._with_errors(f"no answer within {limit_s:g} s", f"Raise --world-timeout ({now})")
            parts.append(os.read(self._output, 1 << 20))
            if not parts[-1]:
                with suppress(TimeoutExpired):
                    self._process.wait(min(_ENDS_S, self._timeout_s))
                    self._reader.join(1.0)
                status = self._process.returncode
                ended = "closed its output" if status is None else f"ended with status {status}"
                raise self._with_errors(f"it has {ended}")
            if sum(map(len, parts)) > _MOST_BYTES:
                raise self.refused(f"a line of more than {_MOST_BYTES >> 20} MiB", "a JSON object in a line")
        line, _, rest = b"".join(parts).partition(b"\n")
        if rest:
            raise self.refused(f"it wrote {_shown(rest)} after its answer", "one answer for each request")
        return line

    def _with_errors(self, found: str, fix: str = PROTOCOL) -> InputError:
        lines = self._errors.decode(errors="replace").strip().splitlines()[-_ERROR_LINES:]
        return self.refused("\n".join([found, *(line[:_MOST_SHOWN] for line in lines)]) + "\n", fix=fix)

    def _read_errors(self) -> None:
        """Keep the end of the error output, so that neither memory nor disk fills, and the program never waits."""
        while part := self._process.stderr.read(_ERROR_BYTES):
            self._errors = (self._errors + part)[-_ERROR_BYTES:]

    def _end(self) -> None:
        self._process.stdin.close()
        self._process.stdout.close()
        with suppress(TimeoutExpired):
            self._process.wait(min(_ENDS_S, self._timeout_s))
        with suppress(OSError):  # no process of the group is left
            os.killpg(self._process.pid, signal.SIGKILL)
        self._reader.join(1.0)


def _shown(line: bytes) -> str:
    return repr(line[:_MOST_SHOWN].decode(errors="replace").strip())


@dataclass(frozen=True)
class AboutWorld:
    """What a world says of itself, unasked, in its first line."""

    world: Annotated[str, Field(max_length=200)]  # name and version
    task: Annotated[str, Field(max_length=200)]  # part of the names of files
    rate_hz: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]  # control steps per second
    steps: Annotated[int, Field(ge=1, le=1_000_000)]  # control steps that suffice for the task
    instruction: str = ""  # the task in words
    expert: bool = False  # whether it has one


@dataclass(frozen=True)
class WorldObservation(Observation):
    """What a world answers."""

    target: Float[np.ndarray, " 7"] | None = None  # that its expert held last
    goal: Image | None = None  # of a reset: the image to aim at, where the world has one


class OtherWorld(WorldProcess):
    """A third-party environment that runs as a program; `close` ends it.

    Args:
        command: Its program and arguments, as in a shell: PYTHON examples/worlds/robosuite.py Lift.
        timeout_s: As of `WorldProcess`.

    Raises:
        InputError: It cannot be started, or is no world.
    """

    def __init__(self, command: str, timeout_s: float | None = None) -> None:
        super().__init__(command, timeout_s)
        self._image_shape: tuple[int, ...] | None = None  # of the first observation
        try:
            self.about = record_of(AboutWorld, self.exchange(), where=self.where, needed="what it is", fix=PROTOCOL)
        except BaseException:
            self.close()
            raise

    def reset(self, seed: int) -> WorldObservation:
        """Begin the episode of a seed: the same one, whenever it is asked for.

        Raises:
            InputError: The world has ended, or answers something else.
        """
        return self._ask(do="reset", seed=seed)

    def move(self, target: Float[np.ndarray, " 7"], steps: int) -> WorldObservation:
        """Hold a target for some control steps: a pose in the frame of the robot's base, and a closedness.

        Raises:
            InputError: As `reset`.
        """
        return self._ask(do="move", target=target.tolist(), steps=steps)

    def let_expert(self, steps: int, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> WorldObservation:
        """Let the expert act for some control steps, its targets moved by an offset in metres.

        Raises:
            InputError: As `reset`.
        """
        return self._ask(do=EXPERT, steps=steps, offset=list(offset))

    def begin(self, problem: Problem) -> tuple[Image, Observation]:
        """Reset to a problem; return its goal image, and what is seen.

        Raises:
            InputError: As `reset`.
            ValueError: It is a problem of another world.
        """
        if not isinstance(problem, WorldProblem):
            raise ValueError(f"{problem} is no problem of {self.about.world}")  # noqa: TRY004 - a wrong argument
        self._now = self.reset(problem.index)
        return problem.goal_image, self._now

    def act(self, action: Float[np.ndarray, " dim"], moves: Moves, stride: int) -> tuple[bool, Observation]:  # noqa: ARG002
        """Hold the pose after an action for so many control steps; return True, and what is seen then.

        Raises:
            InputError: As `reset`.
        """
        self._now = self.move(commanded(self._now.state, action), stride)
        return True, self._now

    def _ask(self, **request: Any) -> WorldObservation:
        answer = self.exchange(request)
        try:
            image, distance_m, is_done = _image(answer["image"]), float(answer["distance_m"]), answer["success"]
            self._image_shape = self._image_shape or image.shape
            if image.shape != self._image_shape:
                raise ValueError(f"an image of {image.shape} after others of {self._image_shape}")  # noqa: TRY301
            if not (np.isfinite(distance_m) and isinstance(is_done, bool)):
                raise ValueError(f"distance_m {distance_m}, success {is_done!r}")  # noqa: TRY301
            state, target, goal = self._pose(answer["state"], "state"), answer.get("target"), answer.get("goal")
            held = None if target is None else self._pose(target, "target")
            aim = None if goal is None else _image(goal)
            return WorldObservation(image, state, distance_m, is_done, target=held, goal=aim)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            found = f"no {error}" if isinstance(error, KeyError) else str(error)
            raise self.refused(found, "image, state, distance_m and success") from None

    def _pose(self, numbers: Any, name: str) -> Float[np.ndarray, " 7"]:
        pose = np.array(numbers, dtype=np.float64)
        POSE.require_state(pose, f"{self.where}: {name}")
        return pose


def _image(found: dict[str, Any]) -> Image:
    """Return an image from its height, width, and bytes in base64."""
    pixels = np.frombuffer(base64.b64decode(found["rgb"]), dtype=np.uint8)
    if min(found["height"], found["width"]) < 1:
        raise ValueError(f"an image of {found['height']}x{found['width']} pixels")
    return pixels.copy().reshape(found["height"], found["width"], 3)


@dataclass(frozen=True, eq=False)
class WorldProblem:
    """An episode of a world, and how its expert solves it."""

    index: int  # the seed of its reset
    goal_image: Image
    goals: tuple[SubGoal, ...] = ()  # on the way, with the last one; none: the goal image alone


@dataclass(frozen=True)
class WorldTrials:
    """The problems that a world's expert solves."""

    about: AboutWorld
    seed: int
    stride: int
    model_steps: int
    problems: tuple[WorldProblem, ...]
    asked: BenchmarkOptions
    left_out: tuple[int, ...] = ()  # seeds that the expert does not solve

    @property
    def episodes(self) -> int:
        """Number of problems."""
        return len(self.problems)

    @property
    def seconds_per_step(self) -> float:
        """Length of a model step."""
        return self.stride / self.about.rate_hz

    @property
    def task_name(self) -> str:
        """What is to be done."""
        return self.about.task

    @property
    def place(self) -> str:
        """Where it is done."""
        return self.about.world

    @property
    def criterion(self) -> str:
        """When it is done, in a few words."""
        return "done"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            **vars(self.about),
            "episodes": self.episodes,
            "seeds": [problem.index for problem in self.problems],
            "left_out": list(self.left_out),
            "seed": self.seed,
            "stride": self.stride,
            "steps": self.model_steps,
            "seconds_per_step": self.seconds_per_step,
            "sub_goals": self.asked.sub_goals,
            "goals": self.asked.goals,
        }


def run_world_benchmark(
    agent: Agent, world: OtherWorld, options: BenchmarkOptions, folder: Path, reporter: Reporter = SILENT
) -> tuple[ClosedLoopBenchmark, tuple[Path, ...]]:
    """Let model, zero actions and chance solve what the world's expert solves; write closed_loop.json and the video.

    Args:
        agent: The model and its planning settings.
        world: Where they act.
        options: How many problems, from which seed on, and their goals on the way. Task and domain are the world's.
        folder: The output folder; created if it is missing.
        reporter: Shows the progress of each policy.

    Raises:
        InputError: A folder that is not writable, a model that needs what worlds do not tell, goals that cannot be
            used, or a world that has no goals, or whose expert solves fewer than half of the problems.
        UnreachableError: PyAV is missing.
    """
    if options.films:
        video_library()
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
    goals_of: GoalsOf | None = None
    if options.goals is not None:
        goals = agent.goals_of(read_goal_folder(Path(options.goals)))
        goals_of = lambda _: goals  # noqa: E731
    elif options.sub_goals != "none":
        goals_of = lambda problem: problem.goals  # noqa: E731
    model = agent.policy(None, goals_of)
    name = world.about.task
    trials, shown = find_problems(world, options, agent.stride, reporter.task(f"{name}: {EXPERT}"))
    if options.sub_goals == "alike":
        alike = of_demonstrations_alike(agent, world, trials.problems, reporter)
        trials = replace(trials, problems=tuple(replace(one, goals=tuple(alike(one))) for one in trials.problems))
    policies = (model, ZeroActions(), RandomActions(agent.planning.limits, options.seed))
    results = try_policies(world, policies, agent, trials, options.films, reporter)
    benchmark = ClosedLoopBenchmark(agent, trials, (*results, shown))
    return benchmark, write_benchmark(benchmark, folder)


def find_problems(
    world: OtherWorld, options: BenchmarkOptions, stride: int, progress: Progress
) -> tuple[WorldTrials, ClosedLoopResult]:
    """Return as many problems as are asked for, and how the expert solves them: those that it does not are left out.

    Raises:
        InputError: It solves fewer than half, or there is no expert.
    """
    about = world.about
    if not about.expert:
        found, needed = f"{about.world} {about.task} has no expert", "one: it shows the goals, and what can be reached"
        raise world.refused(found, needed)
    steps = options.steps or -(-about.steps // stride)
    problems, shown, left_out = list[WorldProblem](), list[EpisodeResult](), list[int]()
    for seed in range(options.seed, options.seed + TRIES * options.episodes):
        problem, episode = _demonstrated(world, seed, Span(steps, stride), options)
        if episode.success:
            problems.append(problem)
            shown.append(episode)
        else:
            left_out.append(seed)
        progress(len(problems), options.episodes)
        if len(problems) == options.episodes:
            break
    else:
        tried = counted(len(problems) + len(left_out), "problem")
        found = f"the expert solves {len(problems)} of {tried} in {counted(steps, 'model step')}"
        raise world.refused(found, "half of them", "Allow more of them with --steps")
    trials = WorldTrials(about, options.seed, stride, steps, tuple(problems), options, tuple(left_out))
    return trials, ClosedLoopResult(trials, EXPERT, tuple(shown))


def _demonstrated(
    world: OtherWorld, seed: int, span: Span, options: BenchmarkOptions
) -> tuple[WorldProblem, EpisodeResult]:
    """Let the expert solve an episode; return the problem with goals of what was seen, and the record."""
    first = world.reset(seed)
    seen = [first, *(world.let_expert(span.stride) for _ in range(span.steps))]
    states, images = np.stack([one.state for one in seen]), [one.image for one in seen]
    problem = WorldProblem(seed, images[-1] if first.goal is None else first.goal)
    if options.sub_goals in {"demonstration", "every-step"}:
        spec = every_step(DemonstrationSpec()) if options.sub_goals == "every-step" else DemonstrationSpec()
        keys = gripper_key_frames(states, OF_MODEL_STEPS) if spec.every is None else every_key_frame(len(seen), 1)
        timing = Timing(1, spec.slack, spec.share)
        goals = sub_goals_of([images[key.frame] for key in keys], keys, timing, states)
        problem = replace(problem, goals=tuple(goals))
    record = EpisodeResult(
        problem=problem,
        states=states,
        actions=actions_from_states(states),
        blocks=None,
        distances_m=np.array([one.distance_m for one in seen]),
        reached=np.array([one.is_done for one in seen]),
        seconds=np.zeros(span.steps),
        whys=("scripted",) * span.steps,
        unreachable=0,
        goal_image=problem.goal_image,
        frames=None,
    )
    return problem, record
