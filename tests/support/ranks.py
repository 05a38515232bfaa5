"""Start several processes of a run on this machine, and wait for them."""

import os
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import killable

T = TypeVar("T")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Rank:
    """A process of a run, with the interface of `subprocess.Popen`."""

    def __init__(self, words: list[str], environment: dict[str, str]) -> None:
        self.returncode: int | None = None
        self._folder = Path(tempfile.mkdtemp())
        self._said = [self._folder / "out", self._folder / "err"]
        for file in self._said:
            file.touch()
        out, err = map(str, self._said)
        self._child = killable.fork_server().start_script(*words, environment=environment, out=out, err=err)

    @property
    def pid(self) -> int:
        return self._child.pid

    def poll(self) -> int | None:
        if self.returncode is None and not self._child.is_running():
            self.returncode = self._child.wait()
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self._child.pid, number)

    def kill(self) -> None:
        if self.poll() is None:
            self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float = 120.0) -> tuple[str, str]:
        """Wait for the process; return its output and error output."""
        deadline_s = time.monotonic() + timeout
        while self.poll() is None:
            assert time.monotonic() < deadline_s, self.read_outputs()
            time.sleep(0.01)
        return self.read_outputs()

    def read_outputs(self) -> tuple[str, str]:
        out, err = (file.read_text() for file in self._said)
        return out, err


def start_rank(words: list[str], rank: int, processes: int, port: int, **variables: str) -> Rank:
    """Start one process of a run, as srun does; `more` are additional environment variables."""
    rank_variables = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": processes, "LOCAL_WORLD_SIZE": processes}
    environment = {**os.environ, **{name: str(value) for name, value in rank_variables.items()}, "OMP_NUM_THREADS": "1"}
    environment |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), **variables}
    return Rank(words, environment)


def run_ranks(words: list[str], processes: int = 2, status: int = 0, timeout: float = 300.0) -> list[tuple[str, str]]:
    """Start all processes of a run, and wait for them; return the output and error output of each."""
    port = free_port()
    return finish([start_rank(words, rank, processes, port) for rank in range(processes)], status, timeout)


def finish(processes: list, status: int = 0, timeout: float = 120.0) -> list[tuple[str, str]]:
    """Wait for all processes, and kill them after the timeout; return the output and error output of each."""
    try:
        outputs = [process.communicate(timeout=timeout) for process in processes]
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.communicate()  # of those that hung; their pipes are closed so
    assert [process.returncode for process in processes] == [status] * len(processes), outputs
    return outputs


def wait_until(happened: Callable[[], T], processes: Sequence = (), timeout_s: float = 300.0) -> T:
    """Wait until `happened` returns a true value, and return the value; no process may exit earlier."""
    deadline_s = time.monotonic() + timeout_s
    while not (outcome := happened()):
        assert all(process.poll() is None for process in processes), finish([*processes])
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    return outcome
