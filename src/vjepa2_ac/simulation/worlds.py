"""Third-party environments, each in its own process, for closed-loop tests and for recording their experts.

The process reads requests and writes answers, one JSON object per line, on standard input and output, with limits of
time and size. It does not import this project, so it can use its own versions of libraries. Protocol: docs/worlds.md.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import re
import select
import shlex
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from threading import Thread
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.goals.key_frames import MODEL_STEP_RULE, find_gripper_key_frames, select_every_nth_frame
from vjepa2_ac.media.video import import_pyav
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.simulation.arm import State
from vjepa2_ac.simulation.benchmark import (
    BenchmarkOptions,
    ClosedLoopBenchmark,
    goals_of_episode,
    make_policy,
    run_policies,
)
from vjepa2_ac.simulation.policies import Expert, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import (
    Action,
    ClosedLoopResult,
    EpisodeResult,
    Image,
    Observation,
    Step,
    Trial,
    Trials,
    iterate_steps,
    run_trial,
    target_state,
)
from vjepa2_ac.spaces import POSE, actions_from_states
from vjepa2_ac.storage import atomic_writer, translate_write_errors
from vjepa2_ac.storage.structured import parse_record

_ANSWER_S = 120.0  # default timeout of an answer
LOADING = 5  # factor of the timeout for the first answer
_EXIT_S = 10.0  # time for a program to exit after its input is closed
_MAX_LINE_BYTES = 64 << 20  # size limit of a line; fits an image of 16 million pixels in base64
_MAX_SHOWN_BYTES = 200  # bytes of an invalid line in an error message
_ERROR_BYTES, _ERROR_LINES = 64 << 10, 5  # stored bytes and displayed lines of the error output
_KEEPER = "import os, sys; world = int(sys.stdin.readline()); sys.stdin.read(); os.killpg(world, 9)"
PROTOCOL = "docs/worlds.md has the protocol; examples/worlds has programs that implement it"
TRIALS_PER_PROBLEM = 2  # at most this many times the required number of problems are tried with the expert


class EnvironmentProcess(ExitStack):
    """A program that answers each line of its input with one line; `close` stops it and all processes of its group.

    A second process, the keeper, kills the group when this process dies, even by SIGKILL, because the keeper's input is
    then closed. Unlike prctl(PR_SET_PDEATHSIG), this works on every Unix and from any thread, and it also kills the
    children of a shell.

    Args:
        command: The program and its arguments, in shell syntax.
        timeout_s: Timeout of an answer in seconds; for the first one, which includes loading, it is multiplied by
            `LOADING`. None: 120 seconds.

    Raises:
        InputError: The program cannot be started.
    """

    def __init__(self, command: str, timeout_s: float | None = None) -> None:
        super().__init__()
        self.command, self.where = command, f"--world {command!r}"
        self._timeout_s, self._errors = timeout_s or _ANSWER_S, b""
        try:
            keeper = self._start([sys.executable, "-I", "-S", "-c", _KEEPER], DEVNULL)
            self.callback(keeper.kill)
            self._process = self._start(shlex.split(command) or [""], PIPE)
        except (OSError, ValueError) as error:
            self.close()
            raise self.error(f"the program cannot be started: {error}") from None
        keeper.stdin.write(b"%d\n" % self._process.pid)
        os.set_blocking(self._process.stdin.fileno(), False)
        self._output, self._poll = self._process.stdout.fileno(), select.poll()
        self._poll.register(self._output, select.POLLIN)
        self._reader = Thread(target=self._read_errors, daemon=True)
        self._reader.start()
        self.callback(self._stop)

    def exchange(self, request: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send a request and return the answer; without a request return the first message of the program.

        Raises:
            InputError: There is no answer in time, the answer is not exactly one JSON object, or it is an error.
        """
        if request is not None:
            self._send(f"{json.dumps(request)}\n".encode())
        line = self._read_line(self._timeout_s * (LOADING if request is None else 1))
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):
            raise self.error(f"the program wrote {_quote(line)}", "one JSON object per line") from None
        if not isinstance(answer, dict) or "error" in answer:
            raise self.error(str(answer["error"] if isinstance(answer, dict) else answer))
        return answer

    def error(self, problem: str, needed: str = "", fix: str = PROTOCOL) -> InputError:
        """Return an error that names the command of this environment."""
        return InputError(where=self.where, found=problem, needed=needed, fix=fix)

    def _start(self, command: list[str], stderr: int) -> Any:
        process = Popen(command, stdin=PIPE, stdout=PIPE, stderr=stderr, bufsize=0, start_new_session=True)  # noqa: S603
        return self.enter_context(process)

    def _send(self, line: bytes) -> None:
        if self._poll.poll(0) and (unrequested := os.read(self._output, _MAX_SHOWN_BYTES)):
            raise self.error(
                f"the program wrote {_quote(unrequested)} without a request", "exactly one answer to each request"
            )
        with suppress(BrokenPipeError):  # the program has exited, which `_read_line` reports
            if self._process.stdin.write(line) is None:  # lines below PIPE_BUF are written completely or not at all
                raise self.error("the program does not read its requests", "exactly one answer to each request")

    def _read_line(self, limit_s: float) -> bytes:
        """Return the next line of the program's output.

        Raises:
            InputError: The line is not complete in time, is too long, is followed by more output, or the output ended.
        """
        parts, end_s = [b""], time.monotonic() + limit_s
        while b"\n" not in parts[-1]:
            if not self._poll.poll(1000 * max(0.0, end_s - time.monotonic())):
                current = f"now {self._timeout_s:g} s; {LOADING} times as long for the first answer"
                raise self._error_with_output(f"no answer within {limit_s:g} s", f"Raise --world-timeout ({current})")
            parts.append(os.read(self._output, 1 << 20))
            if not parts[-1]:
                with suppress(TimeoutExpired):
                    self._process.wait(min(_EXIT_S, self._timeout_s))
                    self._reader.join(1.0)
                status = self._process.returncode
                ending = "closed its output" if status is None else f"exited with status {status}"
                raise self._error_with_output(f"the program {ending}")
            if sum(map(len, parts)) > _MAX_LINE_BYTES:
                raise self.error(f"a line of more than {_MAX_LINE_BYTES >> 20} MiB", "one JSON object per line")
        line, _, rest = b"".join(parts).partition(b"\n")
        if rest:
            raise self.error(f"the program wrote {_quote(rest)} after its answer", "exactly one answer to each request")
        return line

    def _error_with_output(self, problem: str, fix: str = PROTOCOL) -> InputError:
        lines = self._errors.decode(errors="replace").strip().splitlines()[-_ERROR_LINES:]
        return self.error("\n".join([problem, *(line[:_MAX_SHOWN_BYTES] for line in lines)]) + "\n", fix=fix)

    def _read_errors(self) -> None:
        """Read the error output continuously and store its end, so that the program never blocks on a full pipe."""
        while part := self._process.stderr.read(_ERROR_BYTES):
            self._errors = (self._errors + part)[-_ERROR_BYTES:]

    def _stop(self) -> None:
        self._process.stdin.close()
        self._process.stdout.close()
        with suppress(TimeoutExpired):
            self._process.wait(min(_EXIT_S, self._timeout_s))
        with suppress(OSError):  # all processes of the group have exited already
            os.killpg(self._process.pid, signal.SIGKILL)
        self._reader.join(1.0)


def _quote(line: bytes) -> str:
    return repr(line[:_MAX_SHOWN_BYTES].decode(errors="replace").strip())


_Short = Annotated[str, Field(max_length=100)]


@dataclass(frozen=True)
class EnvironmentInfo:
    """The first message of a program, which describes its environment."""

    world: Annotated[str, Field(max_length=200)]  # name and version of the environment
    task: Annotated[str, Field(max_length=200)]  # name of the task, used in file names
    rate_hz: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]  # control steps per second
    steps: Annotated[int, Field(ge=1, le=1_000_000)]  # control steps that suffice for the task
    instruction: str = ""  # language instruction
    expert: bool = False  # whether the environment has a scripted expert
    versions: Annotated[dict[_Short, _Short], Field(max_length=50)] = field(default_factory=dict)  # of its libraries


class ExternalEnvironment(EnvironmentProcess):
    """A third-party environment that runs as a program; `close` stops it. It implements `rollout.Environment`.

    Args:
        command: The program and its arguments in shell syntax, such as PYTHON examples/worlds/robosuite.py Lift.
        timeout_s: As for `EnvironmentProcess`.

    Raises:
        InputError: The program cannot be started, or its first message is invalid.
    """

    def __init__(self, command: str, timeout_s: float | None = None) -> None:
        super().__init__(command, timeout_s)
        self._image_shape: tuple[int, ...] | None = None  # image shape of the first observation
        try:
            self.about = parse_record(
                EnvironmentInfo,
                self.exchange(),
                where=self.where,
                needed="a description of the environment",
                fix=PROTOCOL,
            )
        except BaseException:
            self.close()
            raise

    def reset(self, *, seed: int, options: Mapping[str, Any]) -> tuple[Observation, dict[str, Any]]:
        """Start the episode of a seed; the same seed starts the same episode. `options` contains the stride.

        Raises:
            InputError: The program has exited, or its answer is invalid.
        """
        self._stride = options["stride"]
        return self._request(do="reset", seed=seed)

    def step(self, action: Action | None) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command the pose after an action for one model step; None: let the expert act.

        Raises:
            InputError: As for `reset`.
        """
        target = None if action is None else target_state(self._state, action)
        target_values = None if target is None else target.tolist()
        observation, info = self._request(do="step", target=target_values, steps=self._stride)
        info.setdefault("target", observation.state if target is None else target)
        return observation, -info["distance_m"], info["success"], False, info

    def _request(self, **request: Any) -> tuple[Observation, dict[str, Any]]:
        answer = self.exchange(request)
        try:
            image, distance_m, is_done = _image(answer["image"]), float(answer["distance_m"]), answer["success"]
            self._image_shape = self._image_shape or image.shape
            if image.shape != self._image_shape:
                raise ValueError(f"an image with shape {image.shape} after images with shape {self._image_shape}")  # noqa: TRY301
            if not (np.isfinite(distance_m) and isinstance(is_done, bool)):
                raise ValueError(f"distance_m {distance_m}, success {is_done!r}")  # noqa: TRY301
            info: dict[str, Any] = {"distance_m": distance_m, "success": is_done}
            for name, read in (("target", self._pose), ("goal", _image)):
                if answer.get(name) is not None:
                    info["goal_image" if name == "goal" else name] = read(answer[name])
            self._state = self._pose(answer["state"], "state")
            return Observation(image, self._state), info
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            problem = f"an answer without {error}" if isinstance(error, KeyError) else str(error)
            raise self.error(problem, "an answer with image, state, distance_m and success") from None

    def _pose(self, numbers: Any, name: str = "target") -> np.ndarray:
        pose = np.array(numbers, dtype=np.float64)
        POSE.require_state(pose, f"{self.where}: {name}")
        return pose


def _image(encoded: dict[str, Any]) -> Image:
    """Decode an image from its height, width, and bytes in base64."""
    pixels = np.frombuffer(base64.b64decode(encoded["rgb"]), dtype=np.uint8)
    if min(encoded["height"], encoded["width"]) < 1:
        raise ValueError(f"an image of {encoded['height']}x{encoded['width']} pixels")
    return pixels.copy().reshape(encoded["height"], encoded["width"], 3)


# ---- benchmark in a third-party environment ----


def run_world_benchmark(
    subject: Subject,
    world: ExternalEnvironment,
    options: BenchmarkOptions,
    reporter: Reporter = SILENT,
    on_problems: Callable[[ClosedLoopResult], None] | None = None,
) -> ClosedLoopBenchmark:
    """Run a model, zero actions and random actions on problems that the expert of an environment solves.

    Args:
        subject: The model and its planning config.
        world: The environment.
        options: Number and first seed of the problems, and the sub-goals. Task and domain are ignored.
        reporter: Shows the progress of each policy.
        on_problems: Called with the expert's results, before the model is measured.

    Raises:
        InputError: The model needs inputs that such environments do not measure, the environment has no expert, or the
            expert solves fewer than half of the problems.
        UnreachableError: PyAV is missing.
    """
    if options.films:
        import_pyav()
    model = make_policy(subject, None)
    progress = reporter.task(f"{world.about.task}: {Expert.name}")
    trials, expert_result = find_trials(world, options, subject.config.data.model_stride, progress)
    if on_problems is not None:
        on_problems(expert_result)
    policies = (model, ZeroActions(), RandomActions(subject.config.planning.limits, options.seed))
    results = run_policies(world, policies, trials, options.films, reporter)
    return ClosedLoopBenchmark(subject, trials, (*results, expert_result))


def find_trials(
    world: ExternalEnvironment, options: BenchmarkOptions, stride: int, progress: Progress = no_progress
) -> tuple[Trials, ClosedLoopResult]:
    """Return the required number of trials that the expert solves, and its results; other trials are left out.

    With the seeds of a manifest, the trials are those of these seeds that the expert solves.

    Raises:
        InputError: The expert solves fewer than half of the trials, or there is no expert.
    """
    about = world.about
    if not about.expert:
        problem, needed = (
            f"{about.world} {about.task} has no expert",
            "an expert, which provides the goals and shows that the problems can be solved",
        )
        raise world.error(problem, needed)
    steps = options.steps or -(-about.steps // stride)
    trials, episodes, left_out = list[Trial](), list[EpisodeResult](), list[int]()
    seeds = options.seeds or range(options.seed, options.seed + TRIALS_PER_PROBLEM * options.episodes)
    for seed in seeds:
        episode = run_trial(world, Expert(), Trial(seed, steps, stride), keep_frames=True)
        if not episode.success:
            left_out.append(seed)
        else:
            trial = replace(episode.trial, goal_image=episode.goal_image)
            if options.sub_goals == "every-step":
                trial = replace(
                    trial, goals=goals_of_episode(episode, select_every_nth_frame(steps + 1, 1), "every-step")
                )
            elif options.sub_goals == "demonstration":
                keys = find_gripper_key_frames(episode.states, MODEL_STEP_RULE)
                trial = replace(trial, goals=goals_of_episode(episode, keys, "demonstration"))
            trials.append(trial)
            episodes.append(replace(episode, trial=trial, frames=None))
        progress(len(trials), options.episodes)
        if len(trials) == options.episodes:
            break
    if len(trials) < options.episodes * (1.0 if options.seeds is None else 0.5):
        tried = counted(len(trials) + len(left_out), "problem")
        problem = f"the expert solves {len(trials)} of {tried} in {counted(steps, 'model step')}"
        raise world.error(problem, "at least half of the problems", "Allow more model steps with --steps")
    selected = {"episodes": len(trials), "seed": options.seed, "sub_goals": options.sub_goals}
    numbers = {"seeds": [trial.seed for trial in trials], "left_out": left_out}
    length = {"stride": stride, "steps": steps, "seconds_per_step": stride / about.rate_hz}
    values = {**vars(about), **selected, **numbers, **length}
    solved = Trials(about.task, about.world, "done", stride / about.rate_hz, tuple(trials), values)
    return solved, ClosedLoopResult(solved, Expert.name, tuple(episodes))


# ---- recording of the expert, and of random play ----

REST_S = 0.5  # an episode ends this long after success
DISTURBANCE_M, DISTURBANCE_S = 0.02, 0.3  # standard deviation per axis, and duration, of a disturbance
DISTURBANCE_PERIOD_S = 1.5  # time from the start of a disturbance to the start of the next
TARGET_DURATION_S = 0.3, 1.0  # random play: range of the duration of a target
BOX_MARGIN_M = 0.05  # random play: margin of the box around the expert's positions
GRIPPER_CHANGE_SHARE = 0.3  # random play: share of targets at which the gripper is set to open or closed at random
POSITION_STRIDE = 4  # control steps between two expert positions from which the box of random play is computed
DISTURBED, PLAY = 1, 2  # kind of an episode by the remainder of its seed divided by three


class _DisturbedExpert(Expert):
    """Periodically commands a pose a few centimetres off for a short time; otherwise the expert acts."""

    def __init__(self, world: ExternalEnvironment, seed: int, every: int) -> None:
        self._rng, self._steps = np.random.default_rng([seed, 0]), itertools.count(0, every)
        self._every, rate_hz = every, world.about.rate_hz
        self._period, self._length = max(1, round(DISTURBANCE_PERIOD_S * rate_hz)), round(DISTURBANCE_S * rate_hz)

    def act(self, observation: Observation) -> Action | None:
        phase = next(self._steps) % self._period
        if phase < self._every:
            self._target = observation.state.copy()
            self._target[:3] += DISTURBANCE_M * self._rng.normal(size=3)
        return None if phase >= self._length else _action_to(self._target, observation)


class _RandomPlay(Expert):
    """Moves to random positions in a box around the expert's positions, and sometimes opens or closes the gripper."""

    def __init__(self, world: ExternalEnvironment, seed: int, every: int) -> None:
        self._rng, self._steps = np.random.default_rng([seed, 1]), itertools.count(0, every)
        self._rate_hz, self._until = world.about.rate_hz, 0.0
        expert = iterate_steps(world, Expert(), Trial(seed, world.about.steps // POSITION_STRIDE, POSITION_STRIDE))
        points = [step.observation.state[:3] for step in expert]
        self._low = np.min(points, axis=0) - [BOX_MARGIN_M, BOX_MARGIN_M, 0.0]  # not below the expert's lowest position
        self._high = np.max(points, axis=0) + BOX_MARGIN_M

    def act(self, observation: Observation) -> Action | None:
        step = next(self._steps)
        if step == 0:
            self._target = observation.state.copy()
        if step >= self._until:
            self._until = step + self._rng.uniform(*TARGET_DURATION_S) * self._rate_hz
            self._target[:3] = self._rng.uniform(self._low, self._high)
            self._target[6] = self._rng.integers(2) if self._rng.uniform() < GRIPPER_CHANGE_SHARE else self._target[6]
        return _action_to(self._target, observation)


def _action_to(target: State, observation: Observation) -> Action:
    return np.asarray(actions_from_states(np.stack([observation.state, target]))[0])


def record_world(
    world: ExternalEnvironment, folder: Path, seeds: Sequence[int], progress: Progress = no_progress, *, every: int = 1
) -> tuple[int, int]:
    """Record the episodes of some seeds; existing files are kept.

    One third of the episodes are the expert's. In another third the expert is disturbed, so that the data contain
    different solutions and recoveries. The last third is random play: without it a model learns the typical motion of
    experts, not the effect of actions.

    Args:
        world: An environment with an expert.
        folder: Folder for one .npz file per episode (format: data/sources/npz.py).
        seeds: Seeds of the episodes.
        progress: Called with (episodes done, episodes in total).
        every: Control steps per frame.

    Returns:
        The number of episodes that the expert solved, and the number in which it acted; both without random play.

    Raises:
        InputError: The folder cannot be written, or the program exits or its answer is invalid.
    """
    with translate_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    solved, name = 0, re.sub(r"[^\w .,()+-]", "-", world.about.task, flags=re.ASCII)  # a file name without separators
    for done, seed in enumerate(seeds, start=1):
        file = folder / f"{name}_{seed:06d}.npz"
        if not file.exists():
            _record(world, file, seed, every)
        with np.load(file) as recorded:
            solved += bool(recorded["success"]) and seed % 3 != PLAY
        progress(done, len(seeds))
    return solved, sum(seed % 3 != PLAY for seed in seeds)


def _record(world: ExternalEnvironment, file: Path, seed: int, every: int) -> None:
    about, kind = world.about, seed % 3
    policies = {DISTURBED: _DisturbedExpert, PLAY: _RandomPlay}
    policy = policies[kind](world, seed, every) if kind else Expert()
    steps, steps_after_success = list[Step](), -every
    for step in iterate_steps(world, policy, Trial(seed, -(-about.steps // every), every)):
        steps.append(step)
        steps_after_success = steps_after_success + every if step.info["success"] else 0
        if kind != PLAY and steps_after_success >= REST_S * about.rate_hz:
            break
    with translate_write_errors(file), atomic_writer(file) as stream:
        np.savez(
            stream,
            states=np.stack([step.observation.state for step in steps[:-1]]),
            actions=np.stack([step.info["target"] for step in steps[1:]]),
            frames=np.stack([step.observation.image for step in steps[:-1]]),
            fps_hz=about.rate_hz / every,
            success=steps[-1].info["success"],
            language=about.instruction,
        )
