"""Frame prefetching for the encoder: threads decode parts of episodes in order."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int32, UInt8

from vjepa2_ac.data.clips.actions import require_widths
from vjepa2_ac.data.clips.dataset import Dataset
from vjepa2_ac.data.clips.transforms import view
from vjepa2_ac.encoding.disk_space import FRAMES_AT_ONCE
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError

_PREFETCHED_PARTS = 2  # per thread: one in progress, and one ready


@dataclass(frozen=True, eq=False)
class FramesToEncode:
    """Frames to encode, of one camera of one episode."""

    episode: int  # index into the data set's table
    camera: str
    steps: Int32[np.ndarray, " frames"]  # control steps, ascending


@dataclass(frozen=True, eq=False)
class Part:
    """Some neighbouring requested frames, cropped; the last part ends the request."""

    wanted: FramesToEncode
    recording: Episode
    frames: UInt8[np.ndarray, "frames height width 3"]
    small_frames: UInt8[np.ndarray, "frames side side 3"]  # the same, small, for display
    is_last: bool


@dataclass(frozen=True, eq=False)
class Unreadable:
    """A request that cannot be read; parts of it may have come before."""

    wanted: FramesToEncode
    error: InputError


def prefetched(
    dataset: Dataset, wanted: Iterable[FramesToEncode], *, threads: int, side: int
) -> Generator[Part | Unreadable, None, None]:
    """Yield frames in the requested order, while threads decode the next ones.

    Args:
        dataset: Their source.
        wanted: The requests.
        threads: Number of decoding threads.
        side: Height and width of the small frames, in pixels.

    Raises:
        UnreachableError: A failure of the connection, not of the episode.
    """
    pool = ThreadPoolExecutor(threads, thread_name_prefix="decode")
    waiting: deque[Future[Part | Unreadable]] = deque()
    tasks = _tasks(dataset, wanted, side)
    failed: FramesToEncode | None = None
    try:
        while True:
            while len(waiting) < threads * _PREFETCHED_PARTS and (task := next(tasks, None)) is not None:
                waiting.append(pool.submit(task))
            if not waiting:
                return
            done = waiting.popleft().result()
            if done.wanted is failed:
                continue  # one error is enough
            failed = done.wanted if isinstance(done, Unreadable) else None
            yield done
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True, eq=False)
class _Task:
    """One part to read."""

    source: _Recording
    first: int

    def __call__(self) -> Part | Unreadable:
        wanted, upto = self.source.wanted, self.first + FRAMES_AT_ONCE
        try:
            recording = self.source.opened()
            frames = recording.read_frames(wanted.steps[self.first : upto].tolist())
            frames = view(frames, self.source.dataset.config.crop)
            return Part(wanted, recording, frames, _small(frames, self.source.side), upto >= len(wanted.steps))
        except InputError as error:
            return Unreadable(wanted, error)


def _tasks(dataset: Dataset, wanted: Iterable[FramesToEncode], side: int) -> Iterator[_Task]:
    for one in wanted:
        source = _Recording(dataset, one, side)
        yield from (_Task(source, first) for first in range(0, len(one.steps), FRAMES_AT_ONCE))


class _Recording:
    """An episode that is opened once, by the first of its parts."""

    def __init__(self, dataset: Dataset, wanted: FramesToEncode, side: int) -> None:
        self.dataset, self.wanted, self.side = dataset, wanted, side
        self._lock = threading.Lock()
        self._episode: Episode | InputError | None = None

    def opened(self) -> Episode:
        """Return the episode; a failure to open it applies to all parts."""
        with self._lock:
            if self._episode is None:
                try:
                    self._episode = self._open()
                except InputError as error:
                    self._episode = error
        if isinstance(self._episode, InputError):
            raise self._episode
        return self._episode

    def _open(self) -> Episode:
        dataset, episode = self.dataset, self.wanted.episode
        recording = dataset.source.read(episode, self.wanted.camera, dataset.needed_steps(episode))
        require_widths(recording, dataset.widths)
        return recording


def _small(frames: UInt8[np.ndarray, "frames height width 3"], side: int) -> UInt8[np.ndarray, "frames side side 3"]:
    """Return frames resized to a square, as the encoder sees them."""
    pixels = torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2)
    small = torch.nn.functional.interpolate(
        pixels, size=(side, side), mode="bilinear", align_corners=False, antialias=True
    )
    return np.asarray(small.permute(0, 2, 3, 1).numpy())
