"""Output of a command never stops the work that it reports. With real processes, pipes and full disks."""

import os
import pty
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from run_fixtures import Popen
from vjepa2_ac.process import guard_output

BEGINNING = """
import sys, os
from vjepa2_ac import process
with process.guard_output() as lost:
"""
Start = Callable[..., subprocess.Popen]


@pytest.fixture
def start(popen: Popen) -> Start:
    return lambda code, **streams: popen([sys.executable, "-c", BEGINNING + code], **streams)


def test_work_continues_after_the_pipe_is_closed(start: Start, tmp_path: Path) -> None:
    code = f"""
    for number in range(20_000):
        print(f"line {{number:06d}}", "." * 80)
    open({str(tmp_path / "done")!r}, "w").write(lost())
"""
    process = start(code, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout.readline() == b"line 000000 " + b"." * 80 + b"\n"
    process.stdout.close()
    assert (process.stderr.read(), process.wait(timeout=120)) == (b"", 0)
    process.stderr.close()
    assert (tmp_path / "done").read_text() == "", "a reader who left lost nothing"


def test_silent_command_reports_on_stderr_and_exits_on_signal(start: Start) -> None:
    code = """
    import time
    from vjepa2_ac.cli import waiting
    waiting._SILENT_S, waiting._CHECK_S = (0.1,), 0.01
    with waiting.watch_silence():
        print("{}")
        time.sleep(0.4)
    began = time.monotonic()
sys.exit(time.monotonic() - began > 0.1)
"""
    ended = start(code, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, err = ended.communicate(timeout=60)
    assert (ended.returncode, out) == (0, b"{}\n")
    assert err.startswith(b"loading libraries and model: ")


def command(*arguments: str, **streams: object) -> subprocess.CompletedProcess:
    code = f"import sys; from vjepa2_ac.cli import main; sys.exit(main({list(arguments)}))"
    return subprocess.run([sys.executable, "-c", code], check=False, timeout=120, stderr=subprocess.PIPE, **streams)


def test_closed_pipe_is_silent_and_full_disk_is_an_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    without_reader = command("config", "schema", stdout=writer)
    os.close(writer)
    assert (without_reader.returncode, messages_of(without_reader)) == (0, []), "as with `| head`"
    with Path("/dev/full").open("wb") as full:
        without_room = command("config", "schema", stdout=full)
    assert without_room.returncode == 2
    (message,) = messages_of(without_room)
    assert message.startswith(b"error: standard output: cannot be written (No space left on device)")


def messages_of(process: subprocess.CompletedProcess) -> list[bytes]:
    """Return the lines on stderr, without the progress lines of a slow machine."""
    return [line for line in process.stderr.splitlines() if not line.endswith(b" so far")]


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_closed_streams_are_not_reused_by_files(tmp_path: Path, closed: tuple[int, ...]) -> None:
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


def test_closed_terminal_is_no_error(start: Start) -> None:
    controller_fd, terminal_fd = pty.openpty()
    code = """
    print(sys.stdout.isatty(), flush=True)
    sys.stdin.readline()
    for _ in range(100):
        print("nobody there")
    assert not lost()
"""
    process = start(code, stdin=subprocess.PIPE, stdout=terminal_fd, stderr=terminal_fd)
    os.close(terminal_fd)
    printed = b""
    while not printed.endswith(b"\n"):
        printed += os.read(controller_fd, 100)
    assert printed == b"True\r\n", "it is known to be one"
    os.close(controller_fd)
    process.communicate(b"go\n", timeout=120)
    assert process.returncode == 0


def test_both_streams_on_one_file_keep_their_order_and_all_text(start: Start) -> None:
    code = """
    for number in range(100):
        print(number, file=sys.stderr if number % 2 else sys.stdout)
    print('Grüße', chr(0xDCFF), 'x' * 500_000)
"""
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    process = start(code, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment)
    printed, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    assert printed.split() == [
        *(str(number).encode() for number in range(100)),
        rb"Gr\xfc\xdfe",
        rb"\udcff",
        b"x" * 500_000,
    ]


def test_non_blocking_pipe_is_written_completely(start: Start) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    process = start("    print('x' * 500_000)\n    assert not lost()\n", stdout=writer)
    os.close(writer)
    with open(reader, "rb") as file:  # noqa: PTH123 - a descriptor
        assert file.read() == b"x" * 500_000 + b"\n"
    assert process.wait(timeout=120) == 0


def test_replaced_streams_are_not_changed(capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout
    with guard_output() as lost:
        assert sys.stdout is before
        assert lost() == ""
        sys.stdout.write("seen\n")
    assert capsys.readouterr().out == "seen\n"
