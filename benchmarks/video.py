"""How many 16-frame clips come out of MP4s in a second, in one process?

    python benchmarks/video.py [--clips 24]

Random clips of 16 frames at stride 4. Ours decodes what the asked pictures need, and turns only these to RGB; the
baselines, in the same run and on the same clips, go to the key frame before the clip and turn every frame of its window
to RGB, and decode from the start of the file. The videos are drawn: like DROID's raw recordings (1280x720, a key frame
in 12 or in 250, with and without B-frames), and like LeRobot's (320x180, a key frame in 2, many episodes in a file).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np

from vjepa2_ac.media.video import Clock, read_frames

FRAMES, STRIDE, RATE = 16, 4, 15
WINDOW = (FRAMES - 1) * STRIDE + 1


@dataclass(frozen=True)
class Recording:
    """A kind of video."""

    name: str
    height: int
    width: int
    steps: int
    gop: int
    b_frames: int
    codec: str = "libx264"
    is_shared: bool = False  # many episodes in the file, told apart by time


RECORDINGS = (
    Recording("raw DROID, 720p, GOP 12", 720, 1280, 300, 12, 0),
    Recording("raw DROID, 720p, GOP 250, B-frames", 720, 1280, 300, 250, 3),
    Recording("LeRobot, 180p, GOP 2, H.264", 180, 320, 6_000, 2, 0, is_shared=True),
    Recording("LeRobot, 180p, GOP 2, AV1", 180, 320, 3_000, 2, 0, "libsvtav1", is_shared=True),
)


def main(options: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=12, help="clips per measurement (default: %(default)s)")
    measure_all(parser.parse_args(options).clips)


def measure_all(clips: int) -> None:
    """Draw, measure and print every kind of video."""
    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder is talkative
    print(f"{FRAMES} frames at stride {STRIDE} from MP4s, {clips} random clips, medians, one thread\n")
    with tempfile.TemporaryDirectory() as scratch:
        for recording in RECORDINGS:
            measure(draw(Path(scratch) / "video.mp4", recording), recording, clips)


@contextlib.contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Undo what SVT-AV1 does as root: this thread, and all it starts later, would keep the processor from others."""
    policy = os.sched_getscheduler(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, os.sched_param(0))


def draw(path: Path, recording: Recording) -> Path:
    """Write a video in which a textured square moves over a textured ground."""
    generator = np.random.default_rng(0)
    small = generator.integers(60, 190, (recording.height // 10, recording.width // 10, 3), dtype=np.uint8)
    ground = np.kron(small, np.ones((10, 10, 1), np.uint8))
    square = generator.integers(0, 255, (recording.height // 4, recording.height // 4, 3), dtype=np.uint8)
    with ordinary_scheduling(), av.open(str(path), "w") as file:
        stream: Any = file.add_stream(recording.codec, rate=RATE)
        stream.height, stream.width, stream.pix_fmt = recording.height, recording.width, "yuv420p"
        fast = {"preset": "veryfast"} if recording.codec == "libx264" else {"preset": "12", "svtav1-params": "lp=1"}
        stream.codec_context.options = fast | {"g": str(recording.gop), "bf": str(recording.b_frames)}
        for step in range(recording.steps):
            frame = ground.copy()
            row, column = (np.array([0.4, 0.4]) + 0.3 * np.sin([step / 20, step / 13])) * frame.shape[:2]
            frame[int(row) : int(row) + len(square), int(column) : int(column) + len(square)] = square
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        file.mux(stream.encode())
    return path


def measure(path: Path, recording: Recording, clips: int) -> None:
    """Time every way of reading the same clips, in turns, and print clips per second and ratios."""
    starts = np.random.default_rng(1).integers(0, recording.steps - WINDOW, clips)

    def ours(start: int) -> np.ndarray:
        steps = range(start, start + WINDOW, STRIDE)
        if not recording.is_shared:
            return read_frames(path, steps, where=path.name)
        clock = Clock(start_s=start / RATE, rate_hz=float(RATE))
        return read_frames(path, range(0, WINDOW, STRIDE), where=path.name, clock=clock)

    ways: dict[str, Callable[[int], np.ndarray]] = {
        "from the file's start": lambda start: everything(path, start, 0),
        "every frame of the window": lambda start: everything(path, start, start),
        "ours": ours,
    }
    if recording.is_shared:
        ways.pop("from the file's start")  # minutes
    seconds = alternate(ways, starts.tolist())
    print(f"{recording.name} ({path.stat().st_size / 1e6:.1f} MB)")
    for name, taken in seconds.items():
        ratio = seconds["every frame of the window"] / taken
        print(f"  {name:28s}{1 / taken:8.1f} clips/s   {ratio:5.2f} x every frame of the window")


def everything(path: Path, start: int, seek_to: int) -> np.ndarray:
    """Decode every frame up to the clip's last one, turn each to RGB, and take the clip's."""
    frames: dict[int, np.ndarray] = {}
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        stream.codec_context.thread_count = 1
        tick = float(1 / (RATE * (stream.time_base or 1)))
        file.seek(int(seek_to * tick), stream=stream)
        for frame in file.decode(stream):
            frames[round((frame.pts or 0) / tick)] = frame.to_ndarray(format="rgb24")
            if (frame.pts or 0) >= (start + WINDOW - 1) * tick:
                break
    return np.stack([frames[step] for step in range(start, start + WINDOW, STRIDE)])


def alternate(ways: dict[str, Callable[[int], np.ndarray]], starts: list[int]) -> dict[str, float]:
    """Return each way's median seconds per clip; the ways take turns, and must agree."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for start in starts:
        found = []
        for name, way in ways.items():
            begin = time.perf_counter()
            found.append(way(start))
            seconds[name].append(time.perf_counter() - begin)
        assert all(np.array_equal(one, found[0]) for one in found)
    return {name: statistics.median(taken) for name, taken in seconds.items()}


if __name__ == "__main__":
    main()
