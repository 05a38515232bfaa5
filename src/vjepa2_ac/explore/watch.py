"""The page of a robot that is served: what the planner sees, wants and is about to do; and a STOP.

Images are packed and plans decoded in a separate thread, only while a page is open, and only for the newest decision.
With a decoder this thread runs the model on the device of the planner: a page that is open can delay the next decision.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.decoding.imagine import shown
from vjepa2_ac.errors import require_library
from vjepa2_ac.explore.messages import Image, packed, shown_units
from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.pages import Page
from vjepa2_ac.serving.session import STOPPED, Session

logger = logging.getLogger(__name__)

_FILES = ("watch.html", "style.css", "shared.js", "watch.js")
_LOOK_S = 0.25  # between looks for news


@dataclass(frozen=True, eq=False)
class _Seen:
    """A decision."""

    number: int
    episode: int
    frame: np.ndarray
    goal: SubGoal | None  # that applied
    goals: int
    answer: Mapping[str, Any]
    decision: Decision | None  # None: a stop or a deadline took its place


class WatchPage:
    """Shows the decisions of a session to pages, read-only but for their STOP."""

    def __init__(self, subject: str, decoder: TrainedDecoder | None, tell: Callable[[str], None]) -> None:
        """Prepare.

        Args:
            subject: What plans.
            decoder: Shows what it imagined; None: nothing does.
            tell: Takes a line for whoever started the server.
        """
        self.page, self.decoder = Page.of_package("/watch/", "explore/page", _FILES), decoder
        self._subject, self._tell = subject, tell
        self._session: Session | None = None
        self._robot: Callable[[], str | None] = lambda: None
        self._goals: tuple[SubGoal, ...] = ()
        self._seen: _Seen | None = None
        self._drawing = ThreadPoolExecutor(1, "watching")
        self._drawn: tuple[_Seen, bytes] | None = None

    # ---- the session's side: in the planning thread ----

    def begin(self, session: Session, robot: Callable[[], str | None]) -> None:
        """Watch a session, and know the address of the robot that is served, if one is."""
        self._session, self._robot = session, robot
        session.watcher = self

    def goal(self, goals: Sequence[SubGoal], mask: np.ndarray | None) -> None:
        """Take note of a goal."""
        del mask
        self._goals = tuple(goals)

    def decision(self, controller: Controller, frame: np.ndarray, state: np.ndarray, answer: Mapping[str, Any]) -> None:
        """Take note of a decision; nothing is computed here."""
        del state
        place, number = answer["goal"], 0 if self._seen is None else self._seen.number + 1
        goal = None if place is None else self._goals[place["index"]]
        decision = None if place is None or answer["why"] == STOPPED else controller.decision
        episode = 0 if self._session is None else self._session.counts.episodes
        self._seen = _Seen(number, episode, frame, goal, len(self._goals), answer, decision)

    # ---- the pages' side: in the loop ----

    async def show(self, connection: Any) -> None:
        """Show the newest decisions to a page, until that is closed."""
        closed = require_library("websockets.exceptions", where="serve", called="websockets", extra="serve")
        session = self._session
        if session is None:
            await connection.close(1013, "the model is loading")
            return
        listening = asyncio.ensure_future(self._listen(connection, session))
        told: list[Any] = [None, None]  # the newest decision and status
        with contextlib.suppress(closed.ConnectionClosed):
            await connection.send(self._hello(session))
            while not listening.done():
                if (seen := self._seen) is not None and seen is not told[0]:
                    await connection.send(await self._drawn_in_thread(seen, session))
                    told[0] = seen
                if (status := self._status(session)) != told[1]:
                    await connection.send(packed("status", None, status))
                    told[1] = status
                await asyncio.wait([listening], timeout=_LOOK_S)
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)

    async def _listen(self, connection: Any, session: Session) -> None:
        async for message in connection:
            with contextlib.suppress(ValueError, RecursionError):
                asked = json.loads(message)
                if isinstance(asked, dict) and asked.get("kind") == "stop":
                    self._stop(session, connection.remote_address)
                    await connection.send(packed("stop", asked.get("seq"), {"stopped": True}))

    def _stop(self, session: Session, address: Any) -> None:
        if not session.stopped.is_set():
            session.stopped.set()
            name = address[0] if isinstance(address, tuple) else "an unknown address"
            self._tell(f"STOPPED by a page at {name}: every action is zero until `kill -USR1 {os.getpid()}`")

    def _hello(self, session: Session) -> bytes:
        space = session.controller.spaces.state
        units = shown_units(space)
        told = {
            "subject": self._subject,
            "action": [{**unit, "name": name} for unit, name in zip(units, space.change_names, strict=True)],
            "goals": sorted(session.goals),
            "dry_run": session.options.dry_run,
            "decodes": self.decoder is not None,
            "release": f"kill -USR1 {os.getpid()}",
        }  # fmt: skip
        return packed("hello", None, told)

    def _status(self, session: Session) -> dict[str, Any]:
        counts = session.counts
        numbers = {"refused": counts.refused, "failed": counts.failed, "episodes": counts.episodes}
        return {**numbers, "stopped": session.stopped.is_set(), "robot": self._robot()}

    async def _drawn_in_thread(self, seen: _Seen, session: Session) -> bytes:
        return await asyncio.get_running_loop().run_in_executor(self._drawing, self._draw, seen, session)

    def _draw(self, seen: _Seen, session: Session) -> bytes:
        """Return the message of a decision, made once for all pages."""
        if self._drawn is not None and self._drawn[0] is seen:
            return self._drawn[1]
        answer, goal = seen.answer, seen.answer["goal"]
        told = {
            "number": seen.number,
            "episode": seen.episode,
            "goal": None if goal is None else {**goal, "count": seen.goals},
            "action": _first_change(seen, len(session.controller.spaces.state)),
            "seconds": answer["server_timing"]["infer_ms"] / 1e3,
            **{name: answer[name] for name in ("why", "energy", "notes", "done")},
        }
        images = [Image("camera", seen.frame, "what the camera sees")]
        images += [] if seen.goal is None else [Image("goal", seen.goal.image, f"the goal {seen.goal.name}")]
        try:
            images += self._imagined(seen)
        except Exception:
            logger.exception("what was imagined cannot be shown")
        self._drawn = seen, packed("decision", None, told, images)
        return self._drawn[1]

    @torch.no_grad()
    def _imagined(self, seen: _Seen) -> list[Image]:
        decision = seen.decision
        if self.decoder is None or decision is None or decision.cost is None or decision.plan is None:
            return []
        latents, _ = decision.cost.imagine(decision.plan.actions[None])
        (end,) = shown(self.decoder.decoder, latents[0, -1:], decision.cost.views)
        return [Image("imagined", end, "the end of the plan, imagined")]


def _first_change(seen: _Seen, width: int) -> list[float]:
    """Return what the next action changes; zeros where it is to do nothing."""
    if seen.decision is None or seen.decision.plan is None:
        return [0.0] * width
    return [float(number) for number in seen.decision.plan.actions[0]]
