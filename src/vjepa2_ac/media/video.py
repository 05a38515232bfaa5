"""Read frames of an MP4 at requested positions or times, decoding only the necessary packets; write videos and GIFs.

Frames are identified by their presentation time, not by the frame rate in the header, because this rate is often wrong
(as in DROID) and B-frames are stored in another order than they are displayed. Frames are rotated and mirrored
according to the display matrix of the file. Videos are written atomically.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError, require_library
from vjepa2_ac.media.images import MAX_PIXELS, require_decodable_size
from vjepa2_ac.storage import ByteReader, atomic_writer

if TYPE_CHECKING:
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

_DECODER_OPTIONS = {
    "err_detect": "crccheck+bitstream+buffer+explode",  # raises an error instead of concealing damage
    "max_pixels": str(MAX_PIXELS),
}
_START = -(1 << 40)  # a time before all frames
_SAME_RATE = 0.98  # minimum ratio of the video's rate to the steps' rate; times in ms round 30 Hz to 30.3 Hz
_FIX = "Copy the file again, or exclude the episode"
_CRF = 20  # x264's constant rate factor: text stays sharp
_PALETTE_SIZE = 255  # colours of a GIF
_PALETTE_STRIDE = 4  # every n-th pixel along both axes is used to compute the palette

Frame = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Clock:
    """The times of an episode's steps in a video file, which may contain many episodes: start_s + step / rate_hz."""

    start_s: float
    rate_hz: float
    source: str = "the clock"  # the file that states the rate, for messages


@dataclass(frozen=True)
class VideoHeader:
    """The number and the rate of a video's frames, determined without decoding."""

    num_frames: int
    span_s: float  # time from the first frame to the last
    rate_hz: float  # frames per second, from the median interval; 0 for a single frame


def read_frames(
    file: str | Path | ByteReader,
    steps: Sequence[int],
    *,
    where: str,
    clock: Clock | None = None,
    times: Sequence[int] | None = None,
) -> UInt8[np.ndarray, "time height width 3"]:
    """Return the RGB frames at the requested positions of a video, in the order of the request.

    Decoding starts at the key frame before a requested frame, and only requested frames are converted to RGB. With a
    clock, the frame of a step is the frame nearest to the time of the step, at most 0.49 steps away. If two frames are
    equally near, the earlier frame is used. The frame of a step does not depend on the other requested steps.

    Args:
        file: Local path, URL, or a file open for reading, which stays open.
        steps: Positions in display order, counted from 0; with a clock, the episode's steps. They may repeat.
        where: The file and episode, for messages.
        clock: The times of the steps, if positions do not identify the frames.
        times: The result of `read_frame_times` for the file, if it is known. For videos with B-frames it is slow to
            compute, because every packet is read.

    Raises:
        InputError: The file is not a video, is damaged, lacks requested frames, or has a codec that cannot be decoded.
        OSError: A file behind a URL cannot be read.
        ValueError: There are no steps, or a step is negative.
    """
    if not steps or min(steps) < 0:
        raise ValueError(f"{where}: steps {list(steps)}; expected one or more steps from 0")
    with _open_video(file, where) as video:
        if clock is not None:
            frame_times = _find_times_by_clock(video, clock, steps)
        else:
            frame_times = _find_times_by_position(steps, video.times() if times is None else times, where)
        frames = video.decode(sorted(set(frame_times)))
        if len(sizes := {frame.shape for frame in frames.values()}) > 1:
            problem = f"frames of {' and '.join(f'{height}x{width}' for height, width, _ in sorted(sizes))}"
            raise _video_error(where, problem, "frames of one size")
        return np.stack([frames[time] for time in frame_times])


def _find_times_by_position(steps: Sequence[int], times: Sequence[int], where: str) -> list[int]:
    if max(steps) >= len(times):
        raise _video_error(where, f"{len(times)} frames", f"at least {max(steps) + 1} frames")
    if len(set(times)) < len(times):
        raise _video_error(where, "several frames with the same presentation time", "a different time for each frame")
    return [times[step] for step in steps]


def _find_times_by_clock(video: _Video, clock: Clock, steps: Sequence[int]) -> list[int]:
    """Return the presentation time of the frame nearest to the time of each step."""
    targets = [round((clock.start_s + step / clock.rate_hz) / video.unit_s) for step in steps]
    if len(set(targets)) < len(set(steps)):
        problem = f"a time unit of {video.unit_s:g} s, which is too coarse for {clock.rate_hz:g} frames per second"
        raise _video_error(video.where, problem, "a different time for each frame")
    nearest = video.nearest_times(sorted(set(targets)), max(0, int(0.49 / clock.rate_hz / video.unit_s)))
    if not (missing := set(targets) - nearest.keys()):
        return [nearest[target] for target in targets]
    problem, rate_hz = f"no frame at {min(missing) * video.unit_s:.3f} s", video.header().rate_hz
    if 0 < rate_hz < _SAME_RATE * clock.rate_hz:
        problem += f": the video has {rate_hz:.4g} frames per second, but {clock.source} states {clock.rate_hz:g}"
        fix = "Correct the frame rate of the video or the rate of the steps, or exclude the episode"
        raise InputError(where=video.where, found=problem, needed="a frame for each step", fix=fix)
    needed = f"a frame at each of {len(targets)} times, starting at {min(targets) * video.unit_s:.3f} s"
    raise _video_error(video.where, problem, needed)


def read_header(file: str | Path | ByteReader, *, where: str) -> VideoHeader:
    """Return the number and the rate of a video's frames, from its index, or from its packets if it has no index.

    Raises:
        InputError: The file is not a video, or is damaged.
        OSError: A file behind a URL cannot be read.
    """
    with _open_video(file, where) as video:
        return video.header()


def read_frame_times(file: str | Path | ByteReader, *, where: str) -> list[int]:
    """Return the presentation time of each frame of a video in the video's time units; errors as in `read_header`."""
    with _open_video(file, where) as video:
        return video.times()


def is_depth_format(pixel_format: str) -> bool:
    """Return whether a pixel format is that of a depth map: one channel of more than 8 bits, such as gray12le."""
    return re.match(r"gray(9|1\d|f)", pixel_format) is not None


@contextmanager
def _open_video(file: str | Path | ByteReader, where: str) -> Iterator[_Video]:
    """Open a video for decoding in one thread, because the loader's workers already run in parallel."""
    av = import_pyav(where)
    if isinstance(file, (str, Path)):
        with storage.translate_read_errors(where, needed="a whole, undamaged MP4", fix=_FIX):
            opened = storage.open_for_reading(file)
        with closing(opened), _open_video(opened, where) as video:
            yield video
        return
    source = _ErrorStoringFile(file)
    try:
        # The format is set, because libav would otherwise also open playlists, which refer to other files.
        with av.open(source, format="mp4", metadata_errors="replace") as container:
            yield _Video(container, _select_stream(container, where), av.video.reformatter.VideoReformatter(), where)
    except (av.FFmpegError, InputError) as error:
        if source.error is not None:
            raise source.error from None
        if isinstance(error, InputError):
            raise
        raise _video_error(where, f"cannot be read as a video: {error.strerror}", "a whole, undamaged MP4") from None
    if source.error is not None:
        raise source.error


def _select_stream(container: Any, where: str) -> VideoStream:
    stream = container.streams.best("video")
    if stream is None:
        raise _video_error(where, "no video in the file", "an MP4 with frames")
    if stream.codec_context is None:
        problem, fix = "a codec that this build of PyAV cannot decode", "Install PyAV from PyPI, or convert the video"
        raise InputError(where=where, found=problem, needed="H.264, H.265 or AV1", fix=fix)
    if is_depth_format(str(stream.pix_fmt)):
        problem = f"frames of {stream.pix_fmt}: one channel of more than 8 bits, as in depth videos"
        raise InputError(where=where, found=problem, needed="a colour video", fix="Choose another camera")
    stream.codec_context.thread_count = 1
    stream.codec_context.options = _DECODER_OPTIONS
    return cast("VideoStream", stream)


class _ErrorStoringFile:
    """A file for libav that returns end of file on a read error and stores the error.

    PyAV would print such an error and treat the file as damaged.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self.tell = file.tell
        self.error: Exception | None = None

    def read(self, size: int) -> bytes:
        if self.error is None:
            try:
                return bytes(self._file.read(size))
            except Exception as error:  # raised again after libav has returned
                self.error = error
        return b""

    def seek(self, offset: int, whence: int = 0) -> int:
        try:
            return int(self._file.seek(offset, whence))
        except (OSError, ValueError):  # an invalid offset in a damaged file
            return -1


@dataclass(frozen=True)
class _Video:
    """An open video. Times are in units of the stream. Its index has decoding times, not presentation times."""

    container: Any
    stream: VideoStream
    converter: Any  # shared by all frames, because creating a converter takes as long as using it
    where: str

    @property
    def unit_s(self) -> float:
        return float(self.stream.time_base or 1)

    @property
    def is_indexed(self) -> bool:
        """Whether the header of the file lists every frame, which is false for a fragmented MP4."""
        return 0 < self.stream.frames == len(self.stream.index_entries)

    def stored_times(self) -> list[int]:
        """Return the decoding time of each frame from the header: the presentation time if there are no B-frames."""
        return [entry.timestamp for entry in self.stream.index_entries if not entry.is_discard]

    def times(self) -> list[int]:
        """Return the presentation time of each frame, in order; with B-frames this reads every packet of the file."""
        if self.is_indexed:
            first = next(self.packets(), None)
            if first is not None and first.pts == first.dts and not self.stream.codec_context.has_b_frames:
                return self.stored_times()
        return sorted(int(packet.pts) for packet in self.packets() if packet.pts is not None and not packet.is_discard)

    def packets(self, seek_to: int = _START) -> Iterator[Packet[VideoStream]]:
        """Yield packets from the start, or from the key frame at or before `seek_to`."""
        self.container.seek(seek_to, stream=self.stream, backward=True)
        yield from (packet for packet in self.container.demux(self.stream) if packet.dts is not None)

    def header(self) -> VideoHeader:
        """Return the number and rate of the frames; decoding times have the same intervals as presentation times."""
        times = self.stored_times() if self.is_indexed else self.times()
        intervals = np.diff(times) * self.unit_s
        interval_s = float(np.median(intervals)) if len(intervals) else 0.0
        return VideoHeader(len(times), float(intervals.sum()), 1 / interval_s if interval_s > 0 else 0.0)

    def nearest_times(self, targets: Sequence[int], tolerance: int) -> dict[int, int]:
        """Return the presentation time of the frame nearest to each of these ascending times, without decoding.

        If two frames are equally near, the earlier frame is used. The result does not contain times without a frame
        within the tolerance.
        """
        times: list[int] = []
        for packet in self._packets_before(targets[0]):
            if int(packet.dts or 0) > targets[-1] + tolerance:  # all following frames are displayed later
                break
            if packet.pts is not None and not packet.is_discard:
                times.append(int(packet.pts))
        times.sort()
        nearest = {target: _nearest(times, target) for target in targets}
        return {target: time for target, time in nearest.items() if abs(time - target) <= tolerance}

    def decode(self, times: list[int]) -> dict[int, Frame]:
        """Return the frames with these ascending presentation times."""
        require_decodable_size(self.stream.height or 1, self.stream.width or 1, self.where, count=len(times))
        frames: dict[int, Frame] = {}
        while missing := [time for time in times if time not in frames]:
            self._decode_run(missing, frames)
            if missing[0] not in frames:
                raise _video_error(self.where, f"no frame at {missing[0] * self.unit_s:.3f} s", "a whole MP4")
        return frames

    def _decode_run(self, times: list[int], frames: dict[int, Frame]) -> None:
        """Decode from the key frame before the first time until a later key frame precedes the next missing time."""
        decoder = self.stream.codec_context
        sent: set[int] = set()
        delay: int | None = None
        for packet in self._packets_before(times[0]):
            dts = int(packet.dts or 0)
            pts = dts if packet.pts is None else int(packet.pts)
            delay = pts - dts if delay is None else delay  # all key frames of a file have the same delay
            sent.add(pts)
            self._collect(decoder.decode(packet), times, frames)
            if times[0] in sent:
                missing = next((time for time in times if time not in sent), None)
                if missing is None or self._key_frame_before(missing - delay) > dts + int(packet.duration or 0):
                    break
        self._collect(decoder.decode(None), times, frames)

    def _packets_before(self, target: int) -> Iterator[Packet[VideoStream]]:
        """Yield packets from the last key frame whose presentation time is at most the target."""
        seek_time = target
        while seek_time > _START:
            packets = self.packets(seek_time)
            first = next(packets, None)
            if first is not None and first.pts is not None and first.pts <= target:
                yield first
                yield from packets
                return
            seek_time = _START if first is None else self._key_frame_before(int(first.dts or 0) - 1)
        yield from self.packets()

    def _key_frame_before(self, time: int) -> int:
        """Return the decoding time of the last key frame whose decoding time is at most `time`."""
        index = self.stream.index_entries.search_timestamp(time, backward=True, any_frame=False)
        return int(self.stream.index_entries[index].timestamp) if index >= 0 else _START

    def _collect(self, decoded: Sequence[VideoFrame], times: list[int], frames: dict[int, Frame]) -> None:
        for frame in decoded:
            time = frame.pts
            if time is None or time in frames or time not in times:
                continue
            if frame.is_corrupt:
                raise _video_error(self.where, f"a damaged frame at {time * self.unit_s:.3f} s", "a whole MP4")
            require_decodable_size(frame.height, frame.width, self.where, count=len(times))
            image = np.asarray(self.converter.reformat(frame, format="rgb24", threads=1).to_ndarray())
            frames[time] = _apply_display_matrix(image, frame, self.where)


def _nearest(times: Sequence[int], target: int) -> int:
    """Return the one of ascending times that is nearest to a target (the earlier of two); `_START` if empty."""
    index = bisect_left(times, target)
    return min(times[max(0, index - 1) : index + 1], key=lambda time: abs(time - target), default=_START)


def _apply_display_matrix(
    image: Frame, frame: VideoFrame, where: str
) -> UInt8[np.ndarray, "displayed_height displayed_width 3"]:
    """Rotate and mirror an image according to its display matrix, with which phones store rotated videos."""
    if not frame.rotation:
        return image
    stored = cast("Any", frame.side_data)["DISPLAYMATRIX"]
    matrix = np.frombuffer(bytes(stored), np.int32).reshape(3, 3)[:2, :2]
    if matrix[0, 0] == matrix[1, 1] == 0:
        image, matrix = image.swapaxes(0, 1), matrix[::-1]  # x becomes y
    if np.count_nonzero(matrix) != 2 or not matrix.diagonal().all():
        problem = "a display matrix that is not a rotation by a multiple of 90 degrees"
        needed = "a rotation by 90, 180 or 270 degrees, or no display matrix"
        raise InputError(where=where, found=problem, needed=needed, fix="Convert the video")
    return image[:: int(np.sign(matrix[1, 1])), :: int(np.sign(matrix[0, 0]))]


def _video_error(where: str, problem: str, needed: str) -> InputError:
    return InputError(where=where, found=problem, needed=needed, fix=_FIX)


def import_pyav(where: str = "video") -> Any:
    """Import and return PyAV.

    Raises:
        UnreachableError: PyAV is not installed.
    """
    return require_library("av", where=where, called="PyAV, which decodes and writes video", extra="video")


def write_video(
    path: str | Path, frames: Iterable[Frame], *, rate_hz: float, crf: int = _CRF, key_frame_every: int | None = None
) -> Path:
    """Write RGB frames as a video and return its path; an odd last row or column of pixels is dropped.

    Args:
        path: A local file; missing folders are created.
        frames: One or more frames of one size.
        rate_hz: Frames per second.
        crf: x264's constant rate factor; a lower value means higher quality.
        key_frame_every: Interval between key frames, in frames; a small interval makes random access fast. None: x264's
            default.

    Raises:
        UnreachableError: PyAV is not installed.
        ValueError: There are no frames, or the frames differ in size.
    """
    av = import_pyav()
    size: tuple[int, int] | None = None
    with atomic_writer(path) as file, av.open(file, "w", format="mp4", options={"movflags": "faststart"}) as container:
        options = {"crf": str(crf), "preset": "medium"} | ({"g": str(key_frame_every)} if key_frame_every else {})
        stream = container.add_stream("libx264", rate=Fraction(rate_hz).limit_denominator(1000), options=options)
        stream.pix_fmt = "yuv420p"  # supported by browsers
        for frame in frames:
            even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
            if size is None:
                size = even.shape[:2]
                stream.height, stream.width = size
            elif even.shape[:2] != size:
                raise ValueError(f"frames of {size} and {even.shape[:2]} pixels in one video")
            encoded = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            container.mux(stream.encode(encoded))
        if size is None:
            raise ValueError("a video without frames")
        container.mux(stream.encode(None))
    return Path(path)


def write_gif(path: str | Path, frames: Sequence[Frame], *, seconds: Sequence[float]) -> Path:
    """Write RGB frames as an endless GIF and return its path.

    The number of colours is reduced to 255. Dithering is not used, because it would flicker and make the file several
    times larger.

    Args:
        path: A local file; missing folders are created.
        frames: One or more frames of one size.
        seconds: Duration of each frame in seconds; GIFs store hundredths of a second.
    """
    from PIL import Image

    sample = np.concatenate([frame[::_PALETTE_STRIDE, ::_PALETTE_STRIDE].reshape(-1, 3) for frame in frames])
    palette = Image.fromarray(sample[None]).quantize(_PALETTE_SIZE)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    milliseconds = [max(20, round(100 * duration_s) * 10) for duration_s in seconds]
    with atomic_writer(path) as file:
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0, optimize=True
        )
    return Path(path)
