"""Encoder batching: frames of neighbouring episodes share a chunk, and all chunks have the same shape."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.clips import joined_latents
from vjepa2_ac.data.streams import Copies
from vjepa2_ac.data.transforms import pixels_to_input
from vjepa2_ac.encoding.prefetch import FramesToEncode, Part, Unreadable
from vjepa2_ac.episode import Episode, StoredLatents

_CHUNKS_UNDER_WAY = 2  # the device computes one while the one before it is fetched

Encode = Callable[[Float[Tensor, "time 3 size size"]], StoredLatents]  # normalised frames to their stored form


@dataclass(frozen=True, eq=False)
class Encoded:
    """All encoded frames of one camera of one episode."""

    wanted: FramesToEncode
    recording: Episode
    latents: StoredLatents  # of all its frames, on the CPU
    small_frames: UInt8[np.ndarray, "frames side side 3"]


@dataclass(eq=False)
class _Unfinished:
    """The frames of a request that have been decoded, and those of them that have been encoded."""

    recording: Episode
    small_frames: list[np.ndarray] = field(default_factory=list)
    latents: list[StoredLatents] = field(default_factory=list)


class Chunks:
    """Encodes frames in whole chunks, across episodes.

    The last chunk is padded with copies of its last frame: a matrix product of another shape may round differently.

    Args:
        encode: Encodes normalised frames on the device, to their stored form.
        chunk: Frames of a chunk.
        image_size: Height and width of a frame, in pixels.
        copies: Copies frames to the device, and latents back.
    """

    def __init__(self, encode: Encode, *, chunk: int, image_size: int, copies: Copies) -> None:
        self._encode, self._chunk = encode, chunk
        self._image_size, self._copies = image_size, copies
        self._inputs: list[Tensor] = []  # prepared, not yet encoded
        self._owners: list[FramesToEncode] = []  # of each of these frames
        self._under_way: deque[tuple[Callable[[], StoredLatents], list[FramesToEncode]]] = deque()
        self._unfinished: dict[FramesToEncode, _Unfinished] = {}  # in the order in which they were requested
        self.frames = 0  # encoded so far

    def encoded(self, parts: Iterable[Part | Unreadable]) -> Generator[Encoded | Unreadable, None, None]:
        """Yield finished episodes in order; for an unreadable one, its error."""
        for part in parts:
            if isinstance(part, Unreadable):
                self._unfinished.pop(part.wanted, None)
                yield part
                continue
            self._add(part)
            while len(self._owners) >= self._chunk:
                self._start()
            yield from self._complete(_CHUNKS_UNDER_WAY - 1)
        if self._owners:
            self._start()
        yield from self._complete(0)

    def _add(self, part: Part) -> None:
        frames = torch.from_numpy(part.frames)
        arrived = self._copies.to_device.start(lambda copy: copy(frames))()
        self._inputs.append(pixels_to_input(arrived[None], self._image_size)[0])
        self._owners += [part.wanted] * len(frames)
        self._unfinished.setdefault(part.wanted, _Unfinished(part.recording)).small_frames.append(part.small_frames)

    def _start(self) -> None:
        """Encode one chunk, and start copying its latents."""
        waiting = torch.cat(self._inputs)
        now, owners = waiting[: self._chunk], self._owners[: self._chunk]
        self._inputs, self._owners = [waiting[self._chunk :]], self._owners[self._chunk :]
        missing = self._chunk - len(now)
        if missing:
            now = torch.cat([now, now[-1:].expand(missing, -1, -1, -1)])
        self._under_way.append((self._copies.to_host.start(self._encode(now).mapped), owners))
        self.frames += len(owners)

    def _complete(self, under_way: int) -> Generator[Encoded, None, None]:
        """Fetch chunks until at most this many are in progress, and yield finished episodes."""
        while len(self._under_way) > under_way:
            fetched, owners = self._under_way.popleft()
            self._distribute(fetched().mapped(_unpinned), owners)
        for wanted, one in list(self._unfinished.items()):
            if sum(len(piece.values) for piece in one.latents) < len(wanted.steps):
                return
            del self._unfinished[wanted]
            latents = joined_latents(one.latents, torch.cat)
            yield Encoded(wanted, one.recording, latents, np.concatenate(one.small_frames))

    def _distribute(self, latents: StoredLatents, owners: list[FramesToEncode]) -> None:
        """Distribute the frames of a chunk to their owners."""
        start = 0
        for owner, frames in itertools.groupby(owners):
            end = start + len(list(frames))
            if owner in self._unfinished:  # else it was found to be unreadable
                self._unfinished[owner].latents.append(latents.mapped(itemgetter(slice(start, end))))
            start = end


def _unpinned(tensor: Tensor) -> Tensor:
    """Return a tensor in pageable memory, as it may be held for a whole episode: pinned memory is never given back."""
    return tensor.clone() if tensor.is_pinned() else tensor
