"""Recording: every decision as a line of JSON with its pictures, enough to make it again with `vjepa2-ac plan`."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vjepa2_ac.media.images import encode_png
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.storage import require_new_folder, user_can_write, write_atomically
from vjepa2_ac.storage.structured import json_text, plain, utc_now

if TYPE_CHECKING:
    from vjepa2_ac.planning.controller import Controller

logger = logging.getLogger(__name__)

ABOUT, DECISIONS, IMAGES = "server.json", "decisions.jsonl", "images"
FORMAT = 1  # incremented when a reader would have to change


class _FullError(Exception):
    """The record has its size."""


class Recorder:
    """Writes decisions to a folder until it has its size. A disk that fails ends the record, never a decision.

    Raises:
        InputError: The folder holds something already, or cannot be written.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], most_bytes: int) -> None:
        """Make the folder.

        Args:
            folder: A new one.
            about: The server: model, settings, options.
            most_bytes: Of the folder.
        """
        self.folder, self._left = folder, most_bytes
        self._goals: tuple[SubGoal, ...] = ()
        self._mask: np.ndarray | None = None
        self._episode = 0
        self._is_on = True
        require_new_folder(folder)
        with user_can_write(folder):
            (folder / IMAGES).mkdir(parents=True, exist_ok=True)
            write_atomically(folder / ABOUT, json_text({"format": FORMAT, **about}))

    def goal(self, goals: Sequence[SubGoal], mask: np.ndarray | None) -> None:
        """Take note of a goal, with which an episode begins."""
        self._goals, self._mask, self._episode = tuple(goals), mask, self._episode + 1

    def decision(self, controller: Controller, frame: np.ndarray, state: np.ndarray, answer: Mapping[str, Any]) -> None:
        """Write down a decision that was made.

        Args:
            controller: With its `decision`.
            frame: What it saw.
            state: What was measured.
            answer: What was sent.
        """
        if not self._is_on:
            return
        number = controller.num_decisions - 1  # the controller also counts decisions that a stop kept from being sent
        try:
            line = {
                "time": utc_now(),
                "episode": self._episode,
                "decision": number,
                "answer": plain(answer),
                "plan": self._words(controller, frame, state, number),
            }
            text = json.dumps(line, allow_nan=False) + "\n"
            self._take(len(text.encode()))
            with (self.folder / DECISIONS).open("a") as file:
                file.write(text)
        except _FullError:
            self._end("has reached its size (--record-gb)")
        except OSError as error:
            self._end(f"cannot be written ({error.strerror})")

    def _words(self, controller: Controller, frame: np.ndarray, state: np.ndarray, number: int) -> list[str] | None:
        """Return the words of `vjepa2-ac plan MODEL` that make this decision again in this folder; None: none do."""
        decision, config = controller.decision, controller.config
        if decision is None:
            raise ValueError("nothing was decided")
        if (
            decision.why in {"out of time", "as planned", "uniform frame", "frozen frame"}
            or decision.from_samples
            or (number and (config.context > 1 or config.warm_start))
        ):
            return None  # it depends on the clock, on a policy, or on decisions before it
        goals, durations, left = self._goals[decision.progress.place :], [], number - decision.progress.since
        words = ["--start", self._image(frame), "--state=" + ",".join(repr(float(one)) for one in state)]
        for goal in goals:
            words += ["--goal", self._image(goal.image)]
            if goal is goals[-1] or goal.at_most is None:
                break
            durations.append(max(1, goal.at_most - left))
            left = 0
        words += ["--durations", ",".join(map(str, durations))] if durations else []
        if self._mask is not None:
            seen = (self._mask > 0).astype(np.uint8)[..., None] * np.uint8(255)
            words += ["--mask", self._image(np.repeat(seen, 3, axis=-1))]
        words += ["--seed", str(controller.seed + number)]
        return words + ([f"planning.limits.gripper_mode={goals[0].gripper}"] if goals[0].gripper else [])

    def _image(self, pixels: np.ndarray) -> str:
        """Write an image, once however often it comes; return its name in the folder."""
        digest = hashlib.sha256(repr(pixels.shape).encode() + np.ascontiguousarray(pixels).tobytes()).hexdigest()[:24]
        name = f"{IMAGES}/{digest}.png"
        if not (self.folder / name).exists():
            data = encode_png(pixels)
            self._take(len(data))
            write_atomically(self.folder / name, data)
        return name

    def _take(self, size: int) -> None:
        if size > self._left:
            raise _FullError
        self._left -= size

    def _end(self, why: str) -> None:
        self._is_on = False
        logger.warning("the record in %s %s: it ends here, the server goes on", self.folder, why)
