"""Video frames at given positions: an MP4 is decoded only where needed.

A frame is identified by its presentation time, never by counting at the rate in the header: that rate is often wrong
(DROID's), and frames are stored in another order than they are shown (B-frames).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError, require_library
from vjepa2_ac.media.frame_targets import FrameTargets, QuietFile
from vjepa2_ac.media.image_size import MOST_PIXELS, require_bounded
from vjepa2_ac.storage import ByteReader

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream

_DEMUXER = "mp4"  # by name: otherwise libav follows playlists to other files
_STRICT = {
    "err_detect": "crccheck+bitstream+buffer+explode",  # an error rather than a guessed frame
    "max_pixels": str(MOST_PIXELS),
}
_START = -(1 << 40)  # before every frame
_DEEP_GREY = re.compile(r"gray(9|1\d|f)")
_FIX = "Copy the file again, or leave the episode out"


@dataclass(frozen=True)
class Clock:
    """Where an episode's frames are in a file of many episodes: step k is shown at start_s + k / rate_hz."""

    start_s: float
    rate_hz: float


def read_frames(
    file: str | Path | ByteReader, steps: Sequence[int], *, where: str, clock: Clock | None = None
) -> UInt8[np.ndarray, "time height width 3"]:
    """Return the RGB frames at these positions of a video, in this order; positions may repeat.

    Decoding starts at the key frame before a requested frame; only requested frames become RGB.

    Args:
        file: Local path, URL, or a file open for reading, which stays open.
        steps: Positions in display order, from 0; with a clock, its steps.
        where: The file and its episode, for messages.
        clock: The times of the steps, where positions do not identify the frames.

    Raises:
        InputError: Not a video, damaged, without such frames, or of a codec that cannot be decoded.
        OSError: A file behind a URL cannot be read.
        ValueError: No steps, or one before the first.
    """
    if not steps or min(steps) < 0:
        raise ValueError(f"{where}: steps {list(steps)}")
    with _opened(file, where) as video:
        targets = video.targets_at(steps) if clock is None else video.targets_by(clock, steps)
        frames = video.decode(sorted(set(targets)), clock)
        if len(sizes := {frame.shape for frame in frames.values()}) > 1:
            found = f"frames of {' and '.join(f'{height}x{width}' for height, width, _ in sorted(sizes))}"
            raise _unusable(where, found, "frames of one size")
        return np.stack([frames[target] for target in targets])


def count_frames(file: str | Path | ByteReader, *, where: str) -> int:
    """Return how many frames a video shows: from its index, or by counting packets if it has none.

    Raises:
        InputError: Not a video, or damaged.
        OSError: A file behind a URL cannot be read.
    """
    with _opened(file, where) as video:
        return len(video.stored_times() if video.is_indexed else video.shown_times())


def is_deep_grey(pixel_format: str) -> bool:
    """Return whether a pixel format has one channel of more than 8 bits, such as gray12le: a depth map's."""
    return _DEEP_GREY.match(pixel_format) is not None


@contextmanager
def _opened(file: str | Path | ByteReader, where: str) -> Iterator[_Video]:
    """Open a video for decoding in one thread: the loader's workers are the parallelism."""
    av = _library(where)
    if isinstance(file, (str, Path)) and storage.is_url(file):
        with closing(storage.open_to_read(file)) as opened, _opened(opened, where) as video:
            yield video
        return
    if isinstance(file, (str, Path)):
        _require_readable(file, where)
    source = f"file:{file}" if isinstance(file, (str, Path)) else QuietFile(file)
    try:
        with av.open(source, format=_DEMUXER, metadata_errors="replace") as container:
            yield _video_of(container, av.video.reformatter.VideoReformatter(), where)
    except (av.FFmpegError, InputError) as error:
        if isinstance(source, QuietFile) and source.error is not None:
            raise source.error from None
        if isinstance(error, InputError):
            raise
        found = f"cannot be read as a video: {error.strerror}"
        raise _unusable(where, found, "a whole, undamaged MP4") from None
    if isinstance(source, QuietFile) and source.error is not None:
        raise source.error


def _require_readable(path: str | Path, where: str) -> None:
    """Raise the system's error for a local file, before libav reports it as damage."""
    try:
        storage.open_to_read(path).close()
    except OSError as error:
        raise storage.unreadable(where, error, needed="a whole, undamaged MP4", fix=_FIX) from None


def _video_of(container: InputContainer, converter: VideoReformatter, where: str) -> _Video:
    stream = container.streams.best("video")
    if stream is None:
        raise _unusable(where, "no video in the file", "an MP4 with frames")
    if stream.codec_context is None:
        raise InputError(
            where=where,
            found="a video of a codec that this build of PyAV cannot decode",
            needed="H.264, H.265 or AV1",
            fix="Install PyAV from PyPI, or convert the video",
        )
    video = cast("VideoStream", stream)
    if is_deep_grey(str(video.pix_fmt)):
        found = f"frames of {video.pix_fmt}: one channel of more than 8 bits, as depth is stored"
        raise InputError(where=where, found=found, needed="what a camera saw", fix="Name another camera")
    stream.codec_context.thread_count = 1
    stream.codec_context.options = _STRICT
    return _Video(container, video, converter, where)


@dataclass(frozen=True)
class _Video:
    """An open video. Times are in units of the stream; its index has decoding times, not presentation times."""

    container: InputContainer
    stream: VideoStream
    converter: VideoReformatter  # one for all frames: creating one takes as long as using it
    where: str

    @property
    def is_indexed(self) -> bool:
        """Whether the file's header lists every frame (a fragmented MP4's does not)."""
        return 0 < self.stream.frames == len(self.stream.index_entries)

    def stored_times(self) -> list[int]:
        """Return the decoding time of each frame, from the header; it is the presentation time if none is reordered."""
        return [entry.timestamp for entry in self.stream.index_entries if not entry.is_discard]

    def shown_times(self) -> list[int]:
        """Return the presentation time of each frame, in order; reads the whole file without decoding."""
        return sorted(int(packet.pts) for packet in self.packets() if packet.pts is not None and not packet.is_discard)

    def packets(self, seek_to: int = _START) -> Iterator[Packet[VideoStream]]:
        """Yield packets, from the start or from a key frame."""
        self.container.seek(seek_to, stream=self.stream, backward=True)
        yield from (packet for packet in self.container.demux(self.stream) if packet.dts is not None)

    def is_reordered(self) -> bool:
        """Return whether frames are shown in another order than stored, judged by the start of the file."""
        first = next(self.packets(), None)
        return bool(self.stream.codec_context.has_b_frames) or first is None or first.pts != first.dts

    def targets_at(self, steps: Sequence[int]) -> list[int]:
        """Return the presentation times of the frames at these positions."""
        in_header = self.is_indexed and not self.is_reordered()
        times = self.stored_times() if in_header else self.shown_times()
        if max(steps) >= len(times):
            raise _unusable(self.where, f"{len(times)} frames", f"at least {max(steps) + 1}")
        if len(set(times)) < len(times):
            raise _unusable(self.where, "frames shown at the same time", "a time for each")
        return [times[step] for step in steps]

    def targets_by(self, clock: Clock, steps: Sequence[int]) -> list[int]:
        """Return the times that a clock gives to these steps."""
        times = {step: round((clock.start_s + step / clock.rate_hz) / self._unit_s) for step in steps}
        if len(set(times.values())) < len(times):
            found = f"times in units of {self._unit_s:g} s for {clock.rate_hz:g} frames a second"
            raise _unusable(self.where, found, "a time for each")
        return [times[step] for step in steps]

    def decode(self, targets: list[int], clock: Clock | None) -> dict[int, UInt8[np.ndarray, "height width 3"]]:
        """Return the frames shown at these ascending times; with a clock, the first within half a step of each."""
        require_bounded(self.stream.height or 1, self.stream.width or 1, self.where, count=len(targets))
        wanted = FrameTargets(targets, 0 if clock is None else max(0, int(0.49 / clock.rate_hz / self._unit_s)))
        while (target := wanted.first) is not None:
            before = len(wanted.frames)
            self._decode_run(target, wanted)
            if len(wanted.frames) == before:
                needed = f"one for each of {len(targets)} times from {targets[0] * self._unit_s:.3f} s on"
                raise _unusable(self.where, f"no frame at {target * self._unit_s:.3f} s", needed)
        return wanted.frames

    def _decode_run(self, target: int, wanted: FrameTargets) -> None:
        """Decode from the key frame before a target for as long as that costs less than the next seek."""
        decoder = self.stream.codec_context
        delay: int | None = None
        for packet in self._packets_before(target):
            decoded = int(packet.dts or 0)
            shown = decoded if packet.pts is None else int(packet.pts)
            delay = shown - decoded if delay is None else delay  # of the key frame; all of the file have the same
            wanted.feed(shown)
            self._keep(decoder.decode(packet), wanted)
            if wanted.is_fed(target):
                following = wanted.next_to_feed
                if following is None or self._key_frame_before(following - delay) > decoded + int(packet.duration or 0):
                    break
        self._keep(decoder.decode(None), wanted)

    def _packets_before(self, target: int) -> Iterator[Packet[VideoStream]]:
        """Yield packets from the last key frame that is shown no later than the target."""
        sought = target
        while sought > _START:
            packets = self.packets(sought)
            first = next(packets, None)
            if first is not None and first.pts is not None and first.pts <= target:
                yield first
                yield from packets
                return
            sought = _START if first is None else self._key_frame_before(int(first.dts or 0) - 1)
        yield from self.packets()

    def _key_frame_before(self, time: int) -> int:
        """Return the decoding time of the last key frame that is decoded no later than a time."""
        place = self.stream.index_entries.search_timestamp(time, backward=True, any_frame=False)
        return int(self.stream.index_entries[place].timestamp) if place >= 0 else _START

    def _keep(self, frames: Sequence[VideoFrame], wanted: FrameTargets) -> None:
        for frame in frames:
            target = None if frame.pts is None else wanted.target_of(int(frame.pts))
            if target is None or target in wanted.frames:
                continue
            if frame.is_corrupt:
                raise _unusable(self.where, f"a damaged frame at {target * self._unit_s:.3f} s", "a whole MP4")
            require_bounded(frame.height, frame.width, self.where, count=wanted.count)
            converted = self.converter.reformat(frame, format="rgb24", threads=1)
            wanted.frames[target] = np.asarray(converted.to_ndarray())

    @property
    def _unit_s(self) -> float:
        return float(self.stream.time_base or 1)


def _unusable(where: str, found: str, needed: str) -> InputError:
    return InputError(where=where, found=found, needed=needed, fix=_FIX)


def require_decoder(where: str) -> None:
    """Check that videos can be decoded, before a data set with videos is used.

    Raises:
        UnreachableError: PyAV is not installed.
    """
    _library(where)


def _library(where: str) -> Any:
    return require_library("av", where=where, called="PyAV, which decodes video", extra="video")
