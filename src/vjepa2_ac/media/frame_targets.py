"""Frames of a video that are still to be decoded, and their file. The parts of `video_reader` that need no libav."""

from __future__ import annotations

from bisect import bisect_left
from typing import Any


class FrameTargets:
    """The times whose frames are wanted, and the frames found so far.

    Args:
        targets: Times, ascending.
        tolerance: How far from a target a frame's time may lie.
    """

    def __init__(self, targets: list[int], tolerance: int) -> None:
        self._targets, self._tolerance = targets, tolerance
        self._fed: set[int] = set()
        self.frames: dict[int, Any] = {}

    @property
    def count(self) -> int:
        """How many frames are wanted."""
        return len(self._targets)

    @property
    def first(self) -> int | None:
        """The first time whose frame is missing."""
        return next((target for target in self._targets if target not in self.frames), None)

    @property
    def next_to_feed(self) -> int | None:
        """The first time whose packet the decoder has not received."""
        return next((target for target in self._targets if target not in self._fed), None)

    def target_of(self, time: int) -> int | None:
        """Return the target that a time matches, or None."""
        place = bisect_left(self._targets, time - self._tolerance)
        found = place < len(self._targets) and self._targets[place] <= time + self._tolerance
        return self._targets[place] if found else None

    def feed(self, time: int) -> None:
        """Record that the decoder has received the packet of the frame shown at a time."""
        target = self.target_of(time)
        if target is not None:
            self._fed.add(target)

    def is_fed(self, target: int) -> bool:
        """Return whether the decoder has received a target's packet."""
        return target in self._fed


class QuietFile:
    """A file for libav that seems to end where reading fails: PyAV would print the error and treat it as damage."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.error: Exception | None = None

    def read(self, size: int) -> bytes:
        """Return the next bytes; none after a failure."""
        if self.error is None:
            try:
                return bytes(self._file.read(size))
            except Exception as error:  # any error is raised again after libav has returned
                self.error = error
        return b""

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to an offset; those of a damaged file may be refused."""
        try:
            return int(self._file.seek(offset, whence))
        except (OSError, ValueError):
            return -1

    def tell(self) -> int:
        """Return the offset of the next byte."""
        return int(self._file.tell())
