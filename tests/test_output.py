"""Output of a command: it never stops a command and never blocks a run. With real processes and pipes."""

import errno
import fcntl
import os
import pty
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from run_fixtures import Popen
from vjepa2_ac import output
from vjepa2_ac.output import Writer

BEGINNING = """
import sys, os
from vjepa2_ac import output
output.LAST_S = 120.0
with output.own_streams() as streams:
"""
SAY_MUCH = """
    for number in range(20_000):
        print(f"line {number:06d}", "." * 80)
    os.write(3, b"done")
"""
NEVER_WAIT = "    output.never_wait()\n"
SMALLEST_PIPE = 4096


Start = Callable[..., subprocess.Popen]


@pytest.fixture
def start(popen: Popen) -> Start:
    return lambda code, **streams: popen([sys.executable, "-c", BEGINNING + code], **streams)


def full_pipe() -> tuple[int, int]:
    """Return a pipe that nobody reads and that has room for nothing more."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, SMALLEST_PIPE)
    os.write(writer, b"x" * SMALLEST_PIPE)
    return reader, writer


@pytest.fixture
def third(tmp_path: Path):
    """A file that code can write to as number 3, whatever becomes of its streams."""
    path = tmp_path / "third"

    def shift() -> None:
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), 3)

    return path, shift


@pytest.mark.parametrize("mode", ["", NEVER_WAIT], ids=["waits", "never waits"])
def test_a_reader_who_leaves_changes_nothing(start: Start, third, mode: str) -> None:
    path, shift = third
    process = start(mode + SAY_MUCH, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=shift, close_fds=False)
    assert process.stdout.readline() == b"line 000000 " + b"." * 80 + b"\n"
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(timeout=120) == 0
    process.stderr.close()
    assert path.read_bytes() == b"done"


def test_a_reader_who_never_reads_holds_up_nothing_and_what_was_left_out_is_told(start: Start, third) -> None:
    path, shift = third
    reader, writer = full_pipe()
    process = start(
        "    output.LAST_S = 0.3\n" + NEVER_WAIT + SAY_MUCH,
        stdout=writer, stderr=subprocess.PIPE, preexec_fn=shift, close_fds=False,
    )  # fmt: skip
    _, said = process.communicate(timeout=120)
    os.close(reader), os.close(writer)
    assert process.returncode == 0
    assert path.read_bytes() == b"done"
    assert said == b"warning: standard output: 20000 lines were dropped, because they were not read in time\n"


def test_what_waits_for_a_reader_is_bounded() -> None:
    reader, writer = full_pipe()
    mouth = Writer(writer)
    mouth.never_wait()
    line, lines = b"." * 999 + b"\n", 3 * output.MOST_BYTES // 1000
    for _ in range(lines):
        mouth.write(line)
    waiting = lines - mouth.lines_dropped
    assert output.MOST_BYTES - 2000 < waiting * len(line) <= output.MOST_BYTES
    received = bytearray()

    def read_after_all() -> None:
        while not received.endswith(b"again\n"):
            received.extend(os.read(reader, 1 << 16))

    late = threading.Thread(target=read_after_all)
    late.start()
    mouth.finish(60.0)
    mouth.write(b"again\n")
    late.join(timeout=120)
    assert received == b"x" * SMALLEST_PIPE + line * waiting + b"again\n"


def test_a_slow_reader_gets_all_of_what_a_command_is_there_to_print(start: Start) -> None:
    process = start("    print('x' * 500_000 + 'end')\n", stdout=subprocess.PIPE)
    slow = threading.Event()
    received = b""
    while piece := os.read(process.stdout.fileno(), 9_973):
        slow.wait(0.001)
        received += piece
    assert process.wait(timeout=120) == 0
    assert received == b"x" * 500_000 + b"end\n"


def test_a_full_disk_of_a_log_is_told_once_where_somebody_reads(start: Start, third) -> None:
    path, shift = third
    with Path("/dev/full").open("wb") as full:
        process = start(
            NEVER_WAIT + SAY_MUCH, stdout=full, stderr=subprocess.PIPE, preexec_fn=shift, close_fds=False
        )  # fmt: skip
        _, said = process.communicate(timeout=120)
    assert (process.returncode, path.read_bytes()) == (0, b"done")
    assert said == (b"warning: standard output: cannot be written (No space left on device): some output is missing\n")


COMMAND = "from vjepa2_ac.cli import main; sys.exit(main({}))"


def command(*arguments: str, **streams: object) -> subprocess.CompletedProcess:
    code = f"import sys; {COMMAND.format(list(arguments))}"
    return subprocess.run([sys.executable, "-c", code], check=False, timeout=120, **streams)


def test_a_command_that_only_prints_ends_quietly_without_its_reader_and_loudly_without_room() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    told = command("config", "schema", stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (told.returncode, told.stderr) == (0, b""), "as with `| head`"
    with Path("/dev/full").open("wb") as full:
        told = command("config", "schema", stdout=full, stderr=subprocess.PIPE)
    assert told.returncode == 2
    assert told.stderr.startswith(b"error: standard output: cannot be written (No space left on device)")


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_streams_that_were_closed_are_no_files_of_ours(tmp_path: Path, closed: tuple[int, ...]) -> None:
    def close() -> None:
        for handle in closed:
            os.close(handle)

    code = """
    print("out"); print("err", file=sys.stderr)
    with open(sys.argv[1], "w") as file:
        os.write(2, b"of a library, straight to number 2")
        file.write("ours")
"""
    process = subprocess.run(
        [sys.executable, "-c", BEGINNING + code, str(tmp_path / "file")], preexec_fn=close, check=False, timeout=120,
        capture_output=True,
    )  # fmt: skip
    assert process.returncode == 0
    assert (tmp_path / "file").read_text() == "ours"


def test_a_terminal_that_is_gone_is_nobodys_error(start: Start) -> None:
    ours, theirs = pty.openpty()
    code = """
    print(sys.stdout.isatty(), flush=True)
    sys.stdin.readline()
    for _ in range(100):
        print("nobody there")
"""
    process = start(code, stdin=subprocess.PIPE, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said = b""
    while not said.endswith(b"\n"):
        said += os.read(ours, 100)
    assert said == b"True\r\n", "it is known to be one"
    os.close(ours)
    process.communicate(b"go\n", timeout=120)
    assert process.returncode == 0


def test_both_streams_on_one_file_keep_their_order(start: Start) -> None:
    code = """
    output.never_wait()
    for number in range(100):
        print(number, file=sys.stderr if number % 2 else sys.stdout)
"""
    process = start(code, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    said, _ = process.communicate(timeout=120)
    assert said.split() == [str(number).encode() for number in range(100)]


def test_what_a_terminal_cannot_show_is_spelt_out(start: Start) -> None:
    process = start(
        "    print('Grüße', chr(0xDCFF))\n", stdout=subprocess.PIPE, env={**os.environ, "PYTHONIOENCODING": "ascii"}
    )
    said, _ = process.communicate(timeout=120)
    assert (process.returncode, said) == (0, rb"Gr\xfc\xdfe \udcff" + b"\n")


def test_a_file_that_others_made_unblocking_is_waited_for() -> None:
    reader, writer = full_pipe()
    os.set_blocking(writer, False)
    mouth = Writer(writer)
    thread = threading.Thread(target=mouth.write, args=(b"y" * 10,))
    thread.start()
    assert os.read(reader, SMALLEST_PIPE) == b"x" * SMALLEST_PIPE
    thread.join(timeout=120)
    assert os.read(reader, 100) == b"y" * 10
    assert mouth.problem is None


def test_streams_of_a_test_or_a_notebook_stay_theirs(capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout
    with output.own_streams() as streams:
        output.never_wait()
        assert sys.stdout is before
        assert not streams.writers
        sys.stdout.write("seen\n")
    assert capsys.readouterr().out == "seen\n"


def test_a_lost_reader_is_no_loss_and_a_lost_disk_is() -> None:
    for number, lost in ((errno.EPIPE, False), (errno.ENOSPC, True), (errno.EIO, True)):
        mouth = Writer(os.open(os.devnull, os.O_WRONLY))
        mouth.problem = OSError(number, os.strerror(number))
        assert mouth.has_lost == lost
        os.close(mouth.handle)
