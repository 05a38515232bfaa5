"""Planning servers with a tiny model, in a thread of the test or as a process of the command `serve`."""

import asyncio
import os
import re
import signal
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

import numpy as np

from decisions import STATE, make_controller
from ranks import Rank, wait_until
from vjepa2_ac.serving.access import Access
from vjepa2_ac.serving.server import PlanningServer
from vjepa2_ac.serving.session import Session, SessionOptions


def image(seed: int, height: int = 48, width: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def session(options: SessionOptions | None = None, goals: dict | None = None, **changes: object) -> Session:
    return Session(make_controller(**changes), goals, options)


def request(seed: int = 0, **fields: object) -> dict:
    """Return a request; `goal_image` is the key goal/image."""
    keys = {key.replace("goal_", "goal/"): value for key, value in fields.items()}
    return {"observation/image": image(seed), "observation/state": STATE} | keys


class ServerAddress:
    """The addresses of a running server."""

    def __init__(self, url: str) -> None:
        self.url, self.http = url, url.replace("ws://", "http://")


@contextmanager
def run_in_thread(
    serve: Callable[[asyncio.Event, Callable[[str], None]], Awaitable[object]], ready_line: str
) -> Iterator[list[str]]:
    """Run a server during the `with` block; yield its status lines as soon as a line starts with `until`."""
    lines: list[str] = []
    has_started, loop_and_stop, errors = threading.Event(), [], []

    def print_status(line: str) -> None:
        lines.append(line)
        if line.startswith(ready_line):
            has_started.set()

    async def run() -> None:
        stop = asyncio.Event()
        loop_and_stop.extend((asyncio.get_running_loop(), stop))
        await serve(stop, print_status)

    def run_and_store_errors() -> None:
        try:
            asyncio.run(run())
        except BaseException as error:
            errors.append(error)
        finally:
            has_started.set()

    thread = threading.Thread(target=run_and_store_errors)
    thread.start()
    assert has_started.wait(120)
    if errors:
        thread.join()
        raise errors[0]
    try:
        yield lines
    finally:
        loop, stop = loop_and_stop
        loop.call_soon_threadsafe(stop.set)
        thread.join(120)
        assert not thread.is_alive()


@contextmanager
def serving(
    load: Callable[[], Session], access: Access | None = None, metadata: dict | None = None
) -> Iterator[ServerAddress]:
    """Run a planning server during the `with` block."""

    def serve(stop: asyncio.Event, print_status: Callable[[str], None]) -> Awaitable[object]:
        return PlanningServer(access or Access("127.0.0.1"), 0, print_status).run(
            lambda: (load(), metadata or {}), stop
        )

    with run_in_thread(serve, "listening on ") as lines:
        yield ServerAddress(lines[0].removeprefix("listening on "))


def start_server(*arguments: str) -> tuple[Rank, str]:
    """Start the command `serve`; return its process and its address."""
    process = Rank(["-m", "vjepa2_ac.cli", "serve", *arguments, "--port", "0"], dict(os.environ))
    (address,) = wait_until(
        lambda: re.findall(r"^listening on (.+)\n", process.read_outputs()[0], re.MULTILINE), [process]
    )
    return process, address


def stop_server(process: Rank) -> str:
    """Stop a server with SIGTERM; return its output."""
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    return out + errors
