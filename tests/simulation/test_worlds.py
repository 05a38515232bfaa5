"""Third-party environments are run and recorded; a faulty program gives one error, and no process is left."""

import base64
import json
import re
import shlex
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fake_world
from paths import ROOT
from ranks import wait_until
from vjepa2_ac.cli import main
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.npz import NpzSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.model_setup import load_for_planning
from vjepa2_ac.simulation import worlds
from vjepa2_ac.simulation.benchmark import BenchmarkOptions
from vjepa2_ac.simulation.policies import ZeroActions
from vjepa2_ac.simulation.rollout import Image, Observation, Trial, run_trials
from vjepa2_ac.simulation.worlds import (
    EnvironmentProcess,
    ExternalEnvironment,
    find_trials,
    record_world,
    run_world_benchmark,
)
from vjepa2_ac.storage.paths import CLOSED_LOOP_FILE

SMALL = ["planning.samples=6", "planning.iterations=2", "planning.planner.options.elites=3"]


def command(fault: str = "") -> str:
    return shlex.join([sys.executable, fake_world.__file__, fault])


def test_policies_act_on_problems_that_the_expert_solves(
    model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["simulate", model, "--world", command("sometimes hard"), "--episodes", "3", "--films", "1", "--all"]
    assert main([*arguments, "--sub-goals", "every-step", "--out", str(tmp_path), *SMALL]) == 0
    shown = capsys.readouterr().out
    assert "Come in fake 1.0: 3 problems of seed 0, 3 steps of 0.40 s" in shown
    results = json.loads((tmp_path / CLOSED_LOOP_FILE).read_text())
    assert (results["about"]["seeds"], results["about"]["left_out"]) == ([0, 2, 3], [1])
    assert list(results["policies"]) == ["tiny", "zero action", "random", "expert"]
    assert results["policies"]["expert"]["success"]["value"] == 1.0
    zero_action = np.array(results["policies"]["zero action"]["by_episode"]["distance_cm"])
    assert (zero_action == zero_action[:, :1]).all()
    model_distances = np.array(results["policies"]["tiny"]["by_episode"]["distance_cm"])
    np.testing.assert_array_equal(model_distances[:, 0], zero_action[:, 0])
    assert (np.abs(np.diff(model_distances, axis=1)) > 0.01).any()
    assert {path.name for path in tmp_path.iterdir()} == {CLOSED_LOOP_FILE, "closed_loop.mp4"}


def test_oracle_reaches_the_goal_in_an_external_environment() -> None:
    class Homing(ZeroActions):
        def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
            self.block_position = fake_world.draw_block_position(trial.seed)

        def _change(self, observation: Observation) -> np.ndarray:
            return np.append(self.block_position - observation.state[:3], np.zeros(4))

    with ExternalEnvironment(command()) as world:
        trials, shown = find_trials(world, BenchmarkOptions(episodes=4, seed=5), 4)
        repeated, repeated_views = find_trials(world, BenchmarkOptions(episodes=4, seed=5), 4)
        result = run_trials(world, Homing(), trials)
    assert result.success_rate.value == 1.0
    np.testing.assert_array_equal(shown.distance_cm, repeated_views.distance_cm)
    assert [trial.seed for trial in trials.trials] == [trial.seed for trial in repeated.trials] == [5, 6, 7, 8]


def test_recording_resumes_and_is_a_valid_data_set(tmp_path: Path) -> None:
    with ExternalEnvironment(command()) as world:
        assert record_world(world, tmp_path, range(2)) == (2, 2)
        first = {file.name: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
        assert record_world(world, tmp_path, range(4)) == (3, 3), "play solves nothing"
    assert {file.name: file.stat().st_mtime_ns for file in tmp_path.iterdir() if file.name in first} == first
    source = NpzSource(DataConfig.model_validate({"source": "npz", "path": str(tmp_path)}))
    episodes = [source.read(number) for number in range(4)]
    assert [episode.info.success for episode in episodes] == [True, True, False, True]
    assert {(episode.control_rate_hz, episode.metadata["language"]) for episode in episodes} == {(10.0, "come here")}
    for number, episode in enumerate(episodes):
        targets = np.load(tmp_path / f"Come_{number:06d}.npz")["actions"]
        assert len(targets) == len(episode.states) < fake_world.ABOUT["steps"] + 1
        assert (np.ptp(targets[:, :3], axis=0) > 0).any() == bool(number % 3), "one of three is the expert's alone"
        image = episode.read_frames([0])[0]
        assert image.shape == (24, 32, 3)
        assert image[..., 0].any()


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ("nowhere/python world.py", "cannot be started: .*nowhere/python"),
        (f"{sys.executable} 'world.py", "cannot be started: No closing quotation"),
        (command("no expert"), "fake 1.0 Come has no expert"),
        (command("hard"), "the expert solves 0 of 4 problems in 3 model steps. Expected at least half of the problems"),
    ],
)
def test_unusable_environment_raises(model: str, world: str, message: str) -> None:
    subject = load_for_planning(model, overrides=SMALL)
    with pytest.raises(InputError, match=message), ExternalEnvironment(world) as opened:
        run_world_benchmark(subject, opened, BenchmarkOptions(episodes=2, films=0))


def test_simulated_arm_options_with_world_raise(model: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", model, "--world", command(), "--task", "reach"]) == 2
    assert "--task: used with --world" in capsys.readouterr().err
    assert main(["simulate", model, "--world", command(), "--domain", "B"]) == 2
    assert "--domain: used with --world" in capsys.readouterr().err
    assert main(["simulate", model, "--world-timeout", "5"]) == 2
    assert "--world-timeout: no --world" in capsys.readouterr().err
    assert main(["simulate", "record", "folder", "--world", command(), "--cameras", "3"]) == 2
    assert "--world, which uses one camera" in capsys.readouterr().err


WORLDS = ("robosuite", "libero", "metaworld")


@pytest.mark.parametrize("name", WORLDS)
def test_environment_pins_agree_and_programs_do_not_import_this_package(name: str) -> None:
    patterns = {"Makefile": rf"WORLD_{name} := (.+)", "docs/worlds.md": rf"`{name}.py` \| `pip install ([^`]+)`"}
    patterns[f"examples/worlds/{name}.py"] = r"bin/pip install (.+)"
    pins = {path: re.findall(pattern, (ROOT / path).read_text()) for path, pattern in patterns.items()}
    assert len({tuple(versions) for versions in pins.values()}) == 1, pins
    text = (ROOT / f"examples/worlds/{name}.py").read_text()
    assert not re.search(r"^\s*(from|import) vjepa2_ac", text, flags=re.MULTILINE)


@pytest.mark.parametrize("name", WORLDS)
def test_installed_environment_is_solved_by_its_expert(name: str, tmp_path: Path) -> None:
    python = ROOT / "worlds" / name / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no environment of {name} (docs/worlds.md): make worlds/{name}")
    task = {"robosuite": ["Lift"], "libero": ["libero_object", "--near"], "metaworld": ["reach-v3"]}[name]
    words = shlex.join([str(python), str(ROOT / "examples" / "worlds" / f"{name}.py"), *task])
    with ExternalEnvironment(words) as world:
        other_start, far = world.reset(seed=3, options={"stride": 4})
    with ExternalEnvironment(words) as world:
        for _ in range(2):
            first, info = world.reset(seed=3, options={"stride": 4})
            np.testing.assert_array_equal(first.image, other_start.image)
            np.testing.assert_array_equal(first.state, other_start.state)
            assert info == far
        assert first.image.shape == (256, 256, 3)
        assert first.image.std() > 10
        assert record_world(world, tmp_path, range(1)) == (1, 1)
        for stride, up_m, min_change, max_change in ((4, 0.0, -0.02, 0.02), (15, 0.05, 0.03, 0.07)):
            before, _ = world.reset(seed=0, options={"stride": stride})
            after, *_ = world.step(up_m * np.eye(7)[2])
            assert min_change < after.state[2] - before.state[2] < max_change, "targets are metres in the base frame"


PIXELS = base64.b64encode(bytes(18)).decode()
START = f"""
import json, os, signal, subprocess, sys, time
def say(**changes):
    print(json.dumps(answer | changes), flush=True)
about = dict(world="w 1", task="t", rate_hz=10.0, steps=8, expert=True)
image = dict(height=2, width=3, rgb={PIXELS!r})
answer = dict(image=image, state=[0.4, 0, 0.3, 3.1, 0, 0, 0.2], distance_m=0.1, success=False)
"""
HELLO = "print(json.dumps(about), flush=True)\n"

Program = Callable[..., str]  # code of each request, and before and after the first line -> command


@pytest.fixture
def program(tmp_path: Path) -> Program:
    def command(request: str = "say()", *, first: str = HELLO, end: str = "") -> str:
        file = tmp_path / "world.py"
        file.write_text(f"{START}{first}\nfor number, line in enumerate(sys.stdin):\n    {request}\n{end}\n")
        return shlex.join([sys.executable, "-S", str(file)])

    return command


@pytest.fixture
def short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a loaded machine start a program within the limit of its first answer, and wait briefly for the others."""
    monkeypatch.setattr(worlds, "LOADING", 300)


def fail(command: str, timeout_s: float | None = None) -> str:
    """Return the error of the first answer that is refused."""

    def reset_often() -> None:
        with ExternalEnvironment(command, timeout_s) as world:
            for seed in range(3):
                world.reset(seed=seed, options={"stride": 1})

    with pytest.raises(InputError) as error:
        reset_often()
    assert str(error.value).startswith(f"--world {command!r}: ")
    return str(error.value)


@pytest.mark.usefixtures("short_wait")
@pytest.mark.parametrize("output", ["", "{"])
def test_environment_timeout_raises_with_last_error_output(program: Program, output: str) -> None:
    print_both = f"print('waiting for a key', file=sys.stderr, flush=True); print({output!r}, end='', flush=True)"
    message = fail(program(f"{print_both}; time.sleep(1000)"), 0.1)
    assert "no answer within 0.1 s\nwaiting for a key\n" in message
    assert "--world-timeout" in message


@pytest.mark.usefixtures("short_wait")
def test_environment_with_closed_output_raises(program: Program) -> None:
    assert "the program closed its output" in fail(program("os.close(1); time.sleep(1000)"), 0.1)


def test_endless_line_raises_at_size_limit(program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "_MAX_LINE_BYTES", 1 << 20)
    assert "a line of more than 1 MiB" in fail(program("while True: sys.stdout.write('x' * 65536)"))


@pytest.mark.usefixtures("short_wait")
def test_environment_with_unread_requests_raises(program: Program) -> None:
    with EnvironmentProcess(program(first=f"{HELLO}time.sleep(1000)"), 0.01) as world:
        world.exchange()
        errors = []
        for _ in range(30):  # some 4 kB each: a pipe holds 64 kB
            with pytest.raises(InputError) as error:
                world.exchange({"do": "x" * 3900})
            errors.append(str(error.value))
    assert "no answer within 0.01 s" in errors[0]
    assert "the program does not read its requests" in errors[-1]


@pytest.mark.parametrize(
    ("first", "request_code", "message"),
    [
        (HELLO, "print(json.dumps(answer) + chr(10) + json.dumps(answer), flush=True)", "after its answer"),
        (HELLO, "print('[' * 100_000, flush=True)", "the program wrote '\\[\\["),
        (HELLO, "print('[1]', flush=True)", "\\[1\\]"),
        (
            HELLO,
            "raise RuntimeError('the cube fell off')",
            "exited with status 1\n(.*\n)*RuntimeError: the cube fell off",
        ),
        (HELLO, "print(json.dumps({'error': 'the arm is asleep'}), flush=True)", "the arm is asleep"),
        (HELLO, "say(state=answer['state'][:6])", "state: 6 numbers with shape \\(6,\\). Expected 7: x"),
        ("print('Welcome!', flush=True)", "say()", "wrote 'Welcome!'. Expected one JSON object"),
        ("print(json.dumps(about | {'rate_hz': 0}), flush=True)", "say()", "rate_hz: "),
        (HELLO, "say(distance_m=float('nan'))", "distance_m nan"),
        (HELLO, "say(success='yes')", "success 'yes'"),
        (HELLO, "say(state=[400.0, 0, 300.0, 3.1, 0, 0, 0])", "state: .* Expected a position within 5 m"),
        (HELLO, "say(target=[float('nan')] * 7)", "target: .* Expected finite numbers"),
        (HELLO, "say(state=[10**400] * 7)", "int too large"),
        (HELLO, "say(image=image | {'height': -1})", "an image of -1x3 pixels"),
        (
            HELLO,
            "say(image=image | {'height': 3, 'width': 2} if number else image)",
            "\\(3, 2, 3\\) after images with shape",
        ),
        ("print(json.dumps(about | {'task': 'x' * 300}), flush=True)", "say()", "task: "),
    ],
)
def test_invalid_answer_raises_with_the_command(program: Program, first: str, request_code: str, message: str) -> None:
    assert re.search(message, fail(program(request_code, first=first)))


def test_unrequested_answer_raises(program: Program, tmp_path: Path) -> None:
    go_on, marker = tmp_path / "go on", tmp_path / "said"
    wait = f"while not os.path.exists({str(go_on)!r}): time.sleep(0.01)"
    with ExternalEnvironment(program(f"say()\n    {wait}\n    say()\n    open({str(marker)!r}, 'w')")) as world:
        world.reset(seed=0, options={"stride": 1})
        go_on.touch()
        wait_until(marker.exists)
        with pytest.raises(InputError, match="without a request"):
            world.reset(seed=1, options={"stride": 1})


@pytest.mark.parametrize("task", ["../../../out", "/out", "a\0b\nc\x1b[2J", ".."])
def test_task_name_with_separators_stays_in_the_recording_folder(program: Program, tmp_path: Path, task: str) -> None:
    folder = tmp_path / "a" / "b" / "set"
    with ExternalEnvironment(program(first=f"about['task'] = {task!r}\n{HELLO}")) as world:
        record_world(world, folder, range(1))
    (file,) = folder.iterdir()
    assert {path.name for path in tmp_path.iterdir()} == {"a", "world.py"}
    assert file.name.endswith("_000000.npz")
    assert file.name.isprintable()


def test_long_error_output_is_truncated_to_its_last_lines(program: Program) -> None:
    flood = "for _ in range(128): sys.stderr.write('e' * 65536)"
    tracemalloc.start()
    try:
        message = fail(program("sys.exit('out of luck')", first=f"{flood}\nsys.stderr.write(chr(10))\n{HELLO}"))
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    assert "the program exited with status 1\n" in message
    assert "out of luck\n" in message


STUBBORN = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nabout['child'] = subprocess.Popen(['sleep', '1000']).pid"
STUBBORN += f"\nabout['pid'] = os.getpid()\n{HELLO}"  # and it lives on at the end of its input
OPENER = """
import sys
from vjepa2_ac.simulation.worlds import EnvironmentProcess
with EnvironmentProcess(sys.argv[1]) as world:
    about = world.exchange()
    print(about["pid"], about["child"], flush=True)
    sys.stdin.read()
"""


def is_running(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_environment_and_children_are_killed_with_this_process(program: Program) -> None:
    words = [sys.executable, "-c", OPENER, program(first=STUBBORN, end="time.sleep(1000)")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as opener:
        started = [int(word) for word in opener.stdout.readline().split()]
        assert all(map(is_running, started))
        opener.kill()
        opener.wait()
        wait_until(lambda: not any(map(is_running, started)))


@pytest.mark.usefixtures("short_wait")
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_environment_that_ignores_closed_input_is_killed(program: Program) -> None:
    with EnvironmentProcess(program(first=STUBBORN, end="time.sleep(1000)"), 0.1) as world:
        about = world.exchange()
    wait_until(lambda: not any(map(is_running, [about["pid"], about["child"]])))
