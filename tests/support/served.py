"""A planning server in a thread of the test, the command in a process, and the small model behind them."""

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


def request(seed: int = 0, **more: object) -> dict:
    """Return a request; `goal_image` is the key goal/image."""
    keys = {key.replace("goal_", "goal/"): value for key, value in more.items()}
    return {"observation/image": image(seed), "observation/state": STATE} | keys


class Running:
    """A server that listens."""

    def __init__(self, url: str) -> None:
        self.url, self.http = url, url.replace("ws://", "http://")


@contextmanager
def in_a_thread(
    serve: Callable[[asyncio.Event, Callable[[str], None]], Awaitable[object]], until: str
) -> Iterator[list[str]]:
    """Run a server as long as the context lasts; yield its status lines, once one starts with `until`."""
    lines: list[str] = []
    begun, of_loop, failed = threading.Event(), [], []

    def tell(line: str) -> None:
        lines.append(line)
        if line.startswith(until):
            begun.set()

    async def run() -> None:
        stop = asyncio.Event()
        of_loop.extend((asyncio.get_running_loop(), stop))
        await serve(stop, tell)

    def thread() -> None:
        try:
            asyncio.run(run())
        except BaseException as error:
            failed.append(error)
        finally:
            begun.set()

    running = threading.Thread(target=thread)
    running.start()
    assert begun.wait(120)
    if failed:
        running.join()
        raise failed[0]
    try:
        yield lines
    finally:
        of_loop[0].call_soon_threadsafe(of_loop[1].set)
        running.join(120)
        assert not running.is_alive()


@contextmanager
def serving(
    load: Callable[[], Session], access: Access | None = None, metadata: dict | None = None
) -> Iterator[Running]:
    """Serve robots as long as the context lasts."""

    def serve(stop: asyncio.Event, tell: Callable[[str], None]) -> Awaitable[object]:
        return PlanningServer(access or Access("127.0.0.1"), 0, tell).run(lambda: (load(), metadata or {}), stop)

    with in_a_thread(serve, "listening on ") as lines:
        yield Running(lines[0].removeprefix("listening on "))


def started(*words: str) -> tuple[Rank, str]:
    """Start a server; return it and its address."""
    process = Rank(["-m", "vjepa2_ac.cli", "serve", *words, "--port", "0"], dict(os.environ))
    (address,) = wait_until(lambda: re.findall(r"^listening on (.+)\n", process.written()[0], re.MULTILINE), [process])
    return process, address


def ended(process: Rank) -> str:
    """End a server as its host does; return what it wrote."""
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    return out + errors
