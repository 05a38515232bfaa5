"""Processes that start at once, and runs killed with SIGKILL at chosen moments.

Starting Python with PyTorch takes seconds. A `ForkServer` is a single-threaded process that has imported all libraries.
It forks a child for each start, which runs the command line and exits like any other process.
"""

from __future__ import annotations

import atexit
import faulthandler
import gc
import json
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import psutil

from vjepa2_ac import process as output

KILLED = -signal.SIGKILL


class ForkServer:
    """Starts commands of `vjepa2-ac`, or scripts, each in a process of its own."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip

    def start(
        self, *arguments: str, folder: Path, die_at: int | None = None, out: str = os.devnull, err: str | None = None
    ) -> Child:
        """Start a command that kills itself before its `die_at`-th change to the files in a folder.

        Standard output is written to the file `out`, standard error to the file `err` or that of this process.
        """
        request = {"arguments": arguments, "folder": str(folder), "die_at": die_at, "out": out, "err": err}
        return Child(self._ask(request), self)

    def start_script(self, *words: str, environment: dict[str, str], out: str, err: str) -> Child:
        """Start `python SCRIPT …`, or `python -m vjepa2_ac.cli …`, in the current folder with another environment."""
        request = {"die_at": None, "out": out, "err": err, "environment": environment, "cwd": str(Path.cwd())}
        request |= {"arguments": words[2:]} if words[0] == "-m" else {"script": words[0], "arguments": words[1:]}
        return Child(self._ask(request), self)

    def run(self, *words: str, folder: Path) -> subprocess.CompletedProcess[str]:
        """Run a script as `start_script` does, in this environment, and wait; `folder` stores the output."""
        out, err = folder / "stdout.txt", folder / "stderr.txt"
        for file in (out, err):
            file.write_text("")
        child = self.start_script(*words, environment=dict(os.environ), out=str(out), err=str(err))
        return subprocess.CompletedProcess(words, child.wait(), out.read_text(), err.read_text())

    def wait_for(self, child: int) -> int:
        """Wait for a child; return its exit status, or minus the signal that ended it."""
        return self._ask({"wait": child})

    def close(self) -> None:
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(timeout=120)

    def _ask(self, request: dict) -> int:
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        reply = self._process.stdout.readline()
        assert reply, "the fork server has exited"
        return int(reply)


@cache
def fork_server() -> ForkServer:
    """Return the fork server of this test process, which exists until the process exits."""
    process = ForkServer()
    atexit.register(process.close)
    return process


@dataclass(frozen=True)
class Child:
    """A command that is running."""

    pid: int
    fork_server: ForkServer

    def is_running(self) -> bool:
        try:
            return "\nState:\tZ" not in Path(f"/proc/{self.pid}/status").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return False

    def wait(self) -> int:
        return self.fork_server.wait_for(self.pid)

    def kill_after(self, delay_s: float) -> int:
        """Kill the child after a delay; return its exit status, which is not KILLED if it exited earlier."""
        deadline_s = time.monotonic() + delay_s
        while time.monotonic() < deadline_s and self.is_running():
            time.sleep(0.0005)
        return self.kill()

    def kill(self) -> int:
        if self.is_running():
            os.kill(self.pid, signal.SIGKILL)  # not reaped before `wait`: the number cannot be another's
        return self.wait()


def wait_for_the_end_of(sessions: set[int], timeout_s: float) -> list[psutil.Process]:
    """Wait until no process of these sessions is left; return the processes that are left after the timeout."""
    left = [process for process in psutil.process_iter() if _session(process.pid) in sessions]
    return psutil.wait_procs(left, timeout=timeout_s)[1]


def _session(process: int) -> int:
    try:
        return os.getsid(process)
    except ProcessLookupError:
        return -1


def _serve() -> None:
    """Fork a child for each request on standard input, and print its process id; on request print its exit status."""
    import torch

    import vjepa2_ac.cli.progress
    import vjepa2_ac.training.loop  # noqa: F401 - what a start imports
    from vjepa2_ac.cli import main

    torch.set_num_threads(1)
    gc.freeze()  # no child looks for garbage in what is there, nor copies it so
    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            _tell(os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1]))
            continue
        child = os.fork()
        if child == 0:
            _become(request, main)
        _tell(child)


def _tell(number: int) -> None:
    sys.stdout.write(f"{number}\n")
    sys.stdout.flush()


def _become(request: dict, main: Callable[[list[str]], int]) -> None:
    """Run a command in this forked process, and exit."""
    status = 1
    try:
        os.setsid()  # its workers are in its session, and known by it when it is dead
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP):  # as from a terminal, even under `nohup`
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        output.LAST_S = 0.5 if Path(request["out"]).is_fifo() else 120.0  # a pipe has a reader who may never read
        os.dup2(os.open(os.devnull, os.O_RDWR), 0)
        os.dup2(os.open(request["out"], os.O_WRONLY | os.O_NOCTTY), 1)
        if request["err"] is not None:
            os.dup2(os.open(request["err"], os.O_WRONLY | os.O_NOCTTY), 2)
        faulthandler.dump_traceback_later(900, exit=True)  # no test waits for ever, and it says for what
        if request["die_at"] is not None:
            _die_at(request["die_at"], request["folder"])
        if "environment" in request:
            os.environ.clear()
            os.environ.update(request["environment"])
            os.chdir(request["cwd"])
        status = _script(request) if "script" in request else main(request["arguments"])
    except SystemExit as ended:
        status = int(ended.code or 0)
    finally:
        threading._shutdown()
        atexit._run_exitfuncs()  # as at the end of any process; otherwise semaphores stay, and their tracker says so
        os._exit(status)


def _script(request: dict) -> int:
    sys.argv = [request["script"], *request["arguments"]]
    sys.path.insert(0, str(Path(request["script"]).parent))
    try:
        runpy.run_path(request["script"], run_name="__main__")
    except SystemExit:
        raise
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def _die_at(number: int, folder: str) -> None:
    """Kill this process before its n-th change to the files of a folder.

    Python's audit events report each file that is opened, renamed or removed. Files that native code writes are noticed
    when they are opened afterwards, to flush or to hash them.
    """
    left = number
    changes = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"}

    def watch(event: str, values: tuple) -> None:
        nonlocal left
        if event in changes and isinstance(values[0], str | os.PathLike) and str(values[0]).startswith(folder):
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)


if __name__ == "__main__":
    _serve()
