"""Start several processes of a run on this machine, and wait for them."""

import os
import socket
import subprocess
import sys


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start_rank(arguments: list[str], rank: int, processes: int, port: int, **more: str) -> subprocess.Popen:
    """Start one process of a run, as srun does; `more` goes into its environment."""
    place = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": processes, "LOCAL_WORLD_SIZE": processes}
    environment = {**os.environ, **{name: str(value) for name, value in place.items()}, "OMP_NUM_THREADS": "1"}
    environment |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), **more}
    return subprocess.Popen(
        [sys.executable, *arguments],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def finish(processes: list[subprocess.Popen], status: int = 0) -> list[tuple[str, str]]:
    """Wait for all; return what each wrote. None is left behind."""
    try:
        said = [process.communicate(timeout=120) for process in processes]
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.communicate()  # of those that hung; their pipes are closed so
    assert [process.returncode for process in processes] == [status] * len(processes), said
    return said
