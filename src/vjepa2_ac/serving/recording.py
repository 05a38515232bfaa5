"""Record every decision of a server: one line of JSON, and its images."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.media.images import encode_png
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.storage import require_new_folder, translate_write_errors, write_atomically
from vjepa2_ac.storage.structured import format_json, to_plain, utc_now

logger = logging.getLogger(__name__)

SERVER_FILE, DECISIONS_FILE, IMAGES_FOLDER = "server.json", "decisions.jsonl", "images"
FORMAT = 2  # incremented when readers must change
MAX_RECORDING_BYTES = 2 * 10**9  # default size limit of a recording


class Recorder:
    """Writes decisions to a folder until the size limit is reached. A disk error ends the recording, not the server.

    Raises:
        InputError: The folder is not empty, or cannot be written.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], max_bytes: int = MAX_RECORDING_BYTES) -> None:
        """Create the folder and write the description of the server.

        Args:
            folder: A new or empty folder.
            about: Description of the server: model, config, options.
            max_bytes: Size limit of the folder in bytes.
        """
        self.folder, self._bytes_left = folder, max_bytes
        self._goals: tuple[np.ndarray, ...] = ()  # images of the current goals, then the mask
        self._episode = 0
        self._is_active = True
        require_new_folder(folder)
        with translate_write_errors(folder):
            (folder / IMAGES_FOLDER).mkdir(parents=True, exist_ok=True)
            write_atomically(folder / SERVER_FILE, format_json({"format": FORMAT, **about}))

    def set_goals(self, goals: Sequence[SubGoal], mask: np.ndarray | None) -> None:
        """Set the goals of the next decisions, and start a new episode of the recording."""
        masks = () if mask is None else (np.repeat(np.uint8(255) * (mask > 0)[..., None], 3, axis=-1),)
        self._goals, self._episode = (*(goal.image for goal in goals), *masks), self._episode + 1

    def write_decision(self, frame: np.ndarray, state: np.ndarray, reply: Mapping[str, Any]) -> None:
        """Record the observation and the reply of a decision.

        Args:
            frame: The camera image.
            state: The measured state.
            reply: The reply to the robot.
        """
        if not self._is_active:
            return
        try:
            line = {
                "time": utc_now(),
                "episode": self._episode,
                "frame": self._write_image(frame),
                "state": to_plain(state),
            }
            line |= {"goals": [self._write_image(image) for image in self._goals], "answer": to_plain(reply)}
            text = json.dumps(line, allow_nan=False) + "\n"
            self._reserve_bytes(len(text.encode()))
            with (self.folder / DECISIONS_FILE).open("a") as file:
                file.write(text)
        except OSError as error:
            self._is_active = False
            logger.warning(
                "recording to %s has stopped, the server continues: %s", self.folder, error.strerror or error
            )

    def _write_image(self, pixels: np.ndarray) -> str:
        """Write an image unless the folder contains it already; return its name in the folder."""
        digest = hashlib.sha256(repr(pixels.shape).encode() + np.ascontiguousarray(pixels).tobytes()).hexdigest()[:24]
        name = f"{IMAGES_FOLDER}/{digest}.png"
        if not (self.folder / name).exists():
            data = encode_png(pixels)
            self._reserve_bytes(len(data))
            write_atomically(self.folder / name, data)
        return name

    def _reserve_bytes(self, size: int) -> None:
        if size > self._bytes_left:
            raise OSError("the size limit is reached")
        self._bytes_left -= size
