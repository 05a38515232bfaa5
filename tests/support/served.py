"""A planning server in a thread of the test, the command in a process, and the small model behind them."""

import asyncio
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from ranks import Rank
from tiny_models import tiny_model
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.episode import Widths
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.serving.access import Access
from vjepa2_ac.serving.server import PlanningServer
from vjepa2_ac.serving.session import Session, SessionOptions
from vjepa2_ac.spaces import Spaces

STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])
QUICK = PlanningConfig(samples=12, iterations=2, horizon=2, planner={"name": "cem", "options": {"elites": 4}})


def image(seed: int, height: int = 48, width: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def controller(seed: int = 0, limits: LimitsConfig | None = None, **changes: object) -> Controller:
    config = QUICK.model_copy(update={"limits": limits or LimitsConfig(), **changes})
    return Controller(tiny_model(), config, seed=seed)


def vector_controller(joined: str) -> Controller:
    """Return a controller of eight joints, whose recorded commands were joined so."""
    sizes = tiny_model().sizes
    predictor = sizes.predictor.model_copy(update={"action_dim": 8, "state_dim": 8})
    model = WorldModel.random(sizes.model_copy(update={"predictor": predictor}), seed=0)
    config = QUICK.model_copy(update={"limits": LimitsConfig(axes=(0.1,))})
    return Controller(model, config, spaces=Spaces.of_vectors(Widths(8, 8), joined))


def session(options: SessionOptions | None = None, goals: dict | None = None, **changes: object) -> Session:
    return Session(controller(**changes), goals, options)


def request(seed: int = 0, **more: object) -> dict:
    """Return a request; `goal_image` is the key goal/image."""
    keys = {key.replace("goal_", "goal/"): value for key, value in more.items()}
    return {"observation/image": image(seed), "observation/state": STATE} | keys


class Running:
    """A server that listens."""

    def __init__(self, url: str, server: PlanningServer) -> None:
        self.url, self.server = url, server
        self.http = url.replace("ws://", "http://")


@contextmanager
def serving(
    load: Callable[[], Session],
    access: Access | None = None,
    told: dict | None = None,
) -> Iterator[Running]:
    """Serve in a thread as long as the context lasts."""
    lines: list[str] = []
    begun, loop_of, failed = threading.Event(), [], []

    def tell(line: str) -> None:
        lines.append(line)
        if line.startswith("listening on "):
            begun.set()

    async def run() -> bool:
        stop = asyncio.Event()
        server = PlanningServer(access or Access("127.0.0.1"), 0, tell)
        loop_of.extend((asyncio.get_running_loop(), stop, server))
        return await server.run(lambda: (load(), told or {}), stop)

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
    loop, stop, server = loop_of
    try:
        yield Running(lines[0].removeprefix("listening on "), server)
    finally:
        loop.call_soon_threadsafe(stop.set)
        running.join(120)
        assert not running.is_alive()


def started(*words: str) -> tuple[Rank, str]:
    """Start a server; return it and its address."""
    process = Rank(["-m", "vjepa2_ac.cli", "serve", *words, "--port", "0"], dict(os.environ))
    until = time.monotonic() + 120
    while not (addresses := re.findall(r"^listening on (.+)\n", process.written()[0], re.MULTILINE)):
        assert process.poll() is None, process.written()
        assert time.monotonic() < until
        time.sleep(0.02)
    return process, addresses[0]


def ended(process: Rank) -> str:
    """End a server as its host does; return what it wrote."""
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    return out + errors
