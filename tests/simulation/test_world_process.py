"""A third-party program may hang, answer twice, flood its outputs or ignore its end: one error, and no process left."""

import base64
import re
import shlex
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation import worlds
from vjepa2_ac.simulation.worlds import OtherWorld, WorldProcess, record_world

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
        with OtherWorld(command, timeout_s) as world:
            for seed in range(3):
                world.reset(seed=seed, options={"stride": 1})

    with pytest.raises(InputError) as error:
        reset_often()
    assert str(error.value).startswith(f"--world {command!r}: ")
    return str(error.value)


@pytest.mark.usefixtures("short_wait")
@pytest.mark.parametrize("written", ["", "{"])
def test_a_world_that_does_not_answer_is_refused_in_time_with_its_last_errors(program: Program, written: str) -> None:
    print_both = f"print('waiting for a key', file=sys.stderr, flush=True); print({written!r}, end='', flush=True)"
    message = fail(program(f"{print_both}; time.sleep(1000)"), 0.1)
    assert "no answer within 0.1 s\nwaiting for a key\n" in message
    assert "--world-timeout" in message


@pytest.mark.usefixtures("short_wait")
def test_a_world_that_closes_its_output_and_still_runs_is_refused(program: Program) -> None:
    assert "it has closed its output" in fail(program("os.close(1); time.sleep(1000)"), 0.1)


def test_a_line_without_end_is_refused_at_a_bounded_size(program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "_MOST_BYTES", 1 << 20)
    assert "a line of more than 1 MiB" in fail(program("while True: sys.stdout.write('x' * 65536)"))


@pytest.mark.usefixtures("short_wait")
def test_a_world_that_does_not_read_its_requests_is_refused(program: Program) -> None:
    with WorldProcess(program(first=f"{HELLO}time.sleep(1000)"), 0.01) as world:
        world.exchange()
        errors = []
        for _ in range(30):  # some 4 kB each: a pipe holds 64 kB
            with pytest.raises(InputError) as error:
                world.exchange({"do": "x" * 3900})
            errors.append(str(error.value))
    assert "no answer within 0.01 s" in errors[0]
    assert "it does not read its requests" in errors[-1]


@pytest.mark.parametrize(
    ("first", "request_code", "found"),
    [
        (HELLO, "print(json.dumps(answer) + chr(10) + json.dumps(answer), flush=True)", "after its answer"),
        (HELLO, "print('[' * 100_000, flush=True)", "it wrote '\\[\\["),
        (HELLO, "print('[1]', flush=True)", "\\[1\\]"),
        (HELLO, "say(distance_m=float('nan'))", "distance_m nan"),
        (HELLO, "say(success='yes')", "success 'yes'"),
        (HELLO, "say(state=[400.0, 0, 300.0, 3.1, 0, 0, 0])", "state: .* needed: a position within 5 m"),
        (HELLO, "say(target=[float('nan')] * 7)", "target: .* needed: finite numbers"),
        (HELLO, "say(state=[10**400] * 7)", "int too large"),
        (HELLO, "say(image=image | {'height': -1})", "an image of -1x3 pixels"),
        (HELLO, "say(image=image | {'height': 3, 'width': 2} if number else image)", "\\(3, 2, 3\\) after others of"),
        ("print(json.dumps(about | {'task': 'x' * 300}), flush=True)", "say()", "task: "),
    ],
)
def test_a_wrong_answer_is_one_error_that_names_the_command(
    program: Program, first: str, request_code: str, found: str
) -> None:
    assert re.search(found, fail(program(request_code, first=first)))


def test_an_answer_that_no_request_asked_for_is_refused(program: Program, tmp_path: Path) -> None:
    go_on, said = tmp_path / "go on", tmp_path / "said"
    wait = f"while not os.path.exists({str(go_on)!r}): time.sleep(0.01)"
    with OtherWorld(program(f"say()\n    {wait}\n    say()\n    open({str(said)!r}, 'w')")) as world:
        world.reset(seed=0, options={"stride": 1})
        go_on.touch()
        wait_until(said.exists)
        with pytest.raises(InputError, match="without a request"):
            world.reset(seed=1, options={"stride": 1})


@pytest.mark.parametrize("task", ["../../../out", "/out", "a\0b\nc\x1b[2J", ".."])
def test_no_task_leaves_the_folder_of_its_recordings(program: Program, tmp_path: Path, task: str) -> None:
    folder = tmp_path / "a" / "b" / "set"
    with OtherWorld(program(first=f"about['task'] = {task!r}\n{HELLO}")) as world:
        record_world(world, folder, range(1))
    (file,) = folder.iterdir()
    assert {path.name for path in tmp_path.iterdir()} == {"a", "world.py"}
    assert file.name.endswith("_000000.npz")
    assert file.name.isprintable()


def test_an_error_output_of_any_length_takes_little_memory_and_its_end_is_shown(program: Program) -> None:
    flood = "for _ in range(128): sys.stderr.write('e' * 65536)"
    tracemalloc.start()
    try:
        message = fail(program("sys.exit('out of luck')", first=f"{flood}\nsys.stderr.write(chr(10))\n{HELLO}"))
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    assert "it has ended with status 1\n" in message
    assert "out of luck\n" in message


STUBBORN = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nabout['child'] = subprocess.Popen(['sleep', '1000']).pid"
STUBBORN += f"\nabout['pid'] = os.getpid()\n{HELLO}"  # and it lives on at the end of its input
OPENER = """
import sys
from vjepa2_ac.simulation.worlds import WorldProcess
with WorldProcess(sys.argv[1]) as world:
    about = world.exchange()
    print(about["pid"], about["child"], flush=True)
    sys.stdin.read()
"""


def wait_until(is_done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not is_done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_running(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_world_and_its_children_end_when_we_are_killed(program: Program) -> None:
    words = [sys.executable, "-c", OPENER, program(first=STUBBORN, end="time.sleep(1000)")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as opener:
        started = [int(word) for word in opener.stdout.readline().split()]
        assert all(map(is_running, started))
        opener.kill()
        opener.wait()
        wait_until(lambda: not any(map(is_running, started)))


@pytest.mark.usefixtures("short_wait")
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_a_world_that_ignores_the_end_of_its_input_is_killed_with_its_children(program: Program) -> None:
    with WorldProcess(program(first=STUBBORN, end="time.sleep(1000)"), 0.1) as world:
        about = world.exchange()
    wait_until(lambda: not any(map(is_running, [about["pid"], about["child"]])))
