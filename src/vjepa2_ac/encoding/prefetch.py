"""Frame prefetching for the encoder: threads decode parts of episodes in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch
from jaxtyping import Int32, UInt8

from vjepa2_ac.data.dataset import Dataset, require_widths
from vjepa2_ac.data.transforms import view
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
    """Some neighbouring requested frames, cropped."""

    wanted: FramesToEncode
    recording: Episode
    frames: UInt8[np.ndarray, "frames height width 3"]
    small_frames: UInt8[np.ndarray, "frames side side 3"]  # the same, small, for display


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
    parts = _started(pool, dataset, wanted, side)
    waiting = deque(islice(parts, threads * _PREFETCHED_PARTS))
    failed: FramesToEncode | None = None
    try:
        while waiting:
            done = waiting.popleft().result()
            waiting.extend(islice(parts, 1))
            if done.wanted is failed:
                continue  # one error is enough
            failed = done.wanted if isinstance(done, Unreadable) else None
            yield done
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _started(
    pool: ThreadPoolExecutor, dataset: Dataset, wanted: Iterable[FramesToEncode], side: int
) -> Iterator[Future[Part | Unreadable]]:
    """Start to read part after part; an episode is opened once, before the first of its parts."""
    for one in wanted:
        recording = pool.submit(_opened, dataset, one)
        for first in range(0, len(one.steps), FRAMES_AT_ONCE):
            yield pool.submit(_read, dataset, recording, one, first, side)


def _opened(dataset: Dataset, wanted: FramesToEncode) -> Episode:
    recording = dataset.source.read(wanted.episode, wanted.camera, dataset.needed_steps(wanted.episode))
    require_widths(recording, dataset.widths)
    return recording


def _read(
    dataset: Dataset, opened: Future[Episode], wanted: FramesToEncode, first: int, side: int
) -> Part | Unreadable:
    """Read one part; a failure to open the episode is one of each part."""
    try:
        recording = opened.result()
        steps = wanted.steps[first : first + FRAMES_AT_ONCE].tolist()
        frames = view(recording.read_frames(steps), dataset.config.crop)
        return Part(wanted, recording, frames, _small(frames, side))
    except InputError as error:
        return Unreadable(wanted, error)


def _small(frames: UInt8[np.ndarray, "frames height width 3"], side: int) -> UInt8[np.ndarray, "frames side side 3"]:
    """Return frames resized to a square, as the encoder sees them."""
    pixels = torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2)
    small = torch.nn.functional.interpolate(
        pixels, size=(side, side), mode="bilinear", align_corners=False, antialias=True
    )
    return np.asarray(small.permute(0, 2, 3, 1).numpy())
