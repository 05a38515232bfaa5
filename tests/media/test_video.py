"""Reading video frames, which do not depend on the other requested frames, and writing videos."""

import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

from paths import GOLDEN
from recordings import write_mp4
from synthetic import draw_frame, synthetic_states
from vjepa2_ac.decoding import imagine
from vjepa2_ac.errors import InputError
from vjepa2_ac.media import video as video_reader
from vjepa2_ac.media.video import Clock, read_frame_times, read_frames, read_header, write_video

STEPS = 40
FRAMES = [draw_frame(state, size=(36, 64)) for state in synthetic_states(STEPS)]


def decode_all(path: Path) -> np.ndarray:
    with av.open(str(path)) as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


@pytest.mark.parametrize(("gop", "b_frames"), [(1, 0), (2, 0), (12, 3), (250, 3)])
def test_requested_frames_equal_those_of_a_full_decode(tmp_path: Path, gop: int, b_frames: int) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, gop=gop, b_frames=b_frames)
    frames, generator = decode_all(path), np.random.default_rng(gop)
    for _ in range(25):
        steps = generator.integers(0, STEPS, generator.integers(1, 9)).tolist()
        np.testing.assert_array_equal(read_frames(path, steps, where="a"), frames[steps])
        np.testing.assert_array_equal(read_frames(path, steps, where="a", clock=Clock(0.0, 15.0)), frames[steps])


def test_open_gop_is_decoded_from_a_valid_key_frame(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With x265, some frames that are displayed before a key frame are stored after it."""
    path = write_mp4(tmp_path / "a.mp4", FRAMES, gop=12, codec="libx265")
    frames = decode_all(path)
    capfd.readouterr()  # discards the output of the encoder
    for step in range(STEPS):
        np.testing.assert_array_equal(read_frames(path, [step], where="a")[0], frames[step])
        np.testing.assert_array_equal(read_frames(path, [step], where="a", clock=Clock(0.0, 15.0))[0], frames[step])


def test_av1_is_decoded() -> None:
    path = GOLDEN / "av1.mp4"  # a stored file, because SVT-AV1 run by root blocks all other processes (SCHED_FIFO)
    np.testing.assert_array_equal(read_frames(path, [19, 4, 3], where="a"), decode_all(path)[[19, 4, 3]])


@pytest.mark.parametrize(("codec", "pixels"), [("libx265", "gray12le"), ("ffv1", "gray16le")])
def test_depth_video_raises(codec: str, pixels: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=15, width=64, height=64, pix_fmt=pixels)
        for _ in range(3):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64), 900, np.uint16), format=pixels)))
        file.mux(stream.encode(None))
    capfd.readouterr()  # discards the output of the encoder
    with pytest.raises(InputError, match=f"a: frames of {pixels}: one channel of more than 8 bits, as in depth videos"):
        read_frames(path, [0], where="a")


@pytest.mark.parametrize(("rate", "b_frames"), [(15, 0), (60, 3)])
def test_header_rate_does_not_affect_frames(tmp_path: Path, rate: int, b_frames: int) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, rate=rate, b_frames=b_frames)
    np.testing.assert_array_equal(read_frames(path, [31, 2], where="a"), decode_all(path)[[31, 2]])
    assert read_header(path, where="a").num_frames == STEPS


FRAME_TIMES = {  # presentation times in 1/15360 s, for steps at 10 Hz
    "30 frames a second": [512 * frame for frame in range(STEPS)],
    "50 frames a second": [307 * frame for frame in range(STEPS)],
    "25 frames a second, half of the steps between two frames": [614 * frame for frame in range(STEPS)],
    "uneven": np.cumsum(np.random.default_rng(3).integers(50, 700, STEPS)).tolist(),
}


@pytest.mark.parametrize(("gop", "b_frames"), [(1, 0), (12, 3)])
@pytest.mark.parametrize("times", FRAME_TIMES.values(), ids=FRAME_TIMES)
def test_step_gets_the_nearest_frame_independent_of_other_steps(
    times: list[int], gop: int, b_frames: int, tmp_path: Path
) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, gop=gop, b_frames=b_frames, times=times)
    frames, shown = decode_all(path), read_frame_times(path, where="a")
    assert np.diff(shown).tolist() == np.diff(times).tolist()
    clock = Clock(0.105, 10.0)
    targets = [round(15360 * (0.105 + step / 10)) for step in range(int(shown[-1] / 1536))]
    nearest = [min(range(STEPS), key=lambda frame: (abs(shown[frame] - target), frame)) for target in targets]
    steps = [step for step, frame in enumerate(nearest) if abs(shown[frame] - targets[step]) < 0.49 * 1536]
    expected = frames[[nearest[step] for step in steps]]
    np.testing.assert_array_equal(read_frames(path, steps, where="a", clock=clock), expected)
    for first, second in zip(range(len(steps)), (3, 0, *range(len(steps))), strict=False):
        pair = read_frames(path, [steps[first], steps[second]], where="a", clock=clock)
        np.testing.assert_array_equal(pair, expected[[first, second]])
        np.testing.assert_array_equal(read_frames(path, [steps[first]], where="a", clock=clock), expected[[first]])


def test_frame_half_a_step_away_is_rejected(tmp_path: Path) -> None:
    times = [1024 * frame + 500 * (frame == 20) for frame in range(STEPS)]  # steps of 1024
    path = write_mp4(tmp_path / "a.mp4", FRAMES, times=times)
    assert len(read_frames(path, [19, 20, 21], where="a", clock=Clock(0.0, 15.0))) == 3
    times[20] += 10
    path = write_mp4(tmp_path / "a.mp4", FRAMES, times=times)
    assert len(read_frames(path, [19, 21], where="a", clock=Clock(0.0, 15.0))) == 2
    with pytest.raises(InputError, match=r"a: no frame at 1\.333 s\. .*each of 3 times, starting at 1\.267 s"):
        read_frames(path, [19, 20, 21], where="a", clock=Clock(0.0, 15.0))


def test_video_slower_than_its_clock_raises_with_both_rates(tmp_path: Path) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, rate=10)
    message = (
        r"a: no frame at 0\.033 s: the video has 10 frames per second, but meta/info\.json states 30\. Expected a frame"
    )
    with pytest.raises(InputError, match=message):
        read_frames(path, [0, 1], where="a", clock=Clock(0.0, 30.0, "meta/info.json"))


def test_header_gives_frame_count_and_rate_without_gaps(tmp_path: Path) -> None:
    for b_frames in (0, 3):
        header = read_header(write_mp4(tmp_path / "a.mp4", FRAMES, rate=30, b_frames=b_frames), where="a")
        assert header.num_frames == STEPS
        assert header.span_s == pytest.approx(39 / 30)
        assert header.rate_hz == pytest.approx(30, rel=0.02)
    times = [1024 * frame + 15360 * (frame > 20) for frame in range(STEPS)]
    for options in ({}, {"movflags": "empty_moov+default_base_moof+frag_keyframe"}):
        header = read_header(write_mp4(tmp_path / "a.mp4", FRAMES, times=times, container=options), where="a")
        assert header.rate_hz == pytest.approx(15)
        assert header.span_s == pytest.approx(39 / 15 + 1)
    assert read_header(write_mp4(tmp_path / "a.mp4", FRAMES[:1]), where="a").rate_hz == 0


MATRICES = {  # a, b, c, d of the header's matrix, and the displayed image
    "rotated by 90 degrees": ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
    "rotated by 180 degrees": ((-1, 0, 0, -1), lambda image: np.rot90(image, 2)),
    "rotated by 270 degrees": ((0, -1, 1, 0), np.rot90),
    "mirrored": ((-1, 0, 0, 1), lambda image: image[:, ::-1]),
    "mirrored and rotated": ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
}


def with_matrix(path: Path, *matrix: int) -> Path:
    """Replace the display matrix in the header of an MP4 by (a b 0, c d 0, 0 0 1), and return the path."""

    def pack(a: int, b: int, c: int, d: int) -> bytes:
        values = (a, b, 0, c, d, 0, 0, 0, 16384)
        return b"".join(int(value * 65536).to_bytes(4, "big", signed=True) for value in values)

    data = path.read_bytes()
    offset = data.index(pack(1, 0, 0, 1), data.index(b"tkhd"))
    path.write_bytes(data[:offset] + pack(*matrix) + data[offset + 36 :])
    return path


@pytest.mark.parametrize("clock", [None, Clock(0.0, 15.0)])
@pytest.mark.parametrize(("matrix", "to_displayed"), MATRICES.values(), ids=MATRICES)
def test_display_matrix_is_applied_to_frames(
    matrix: tuple[int, ...], to_displayed: Callable[[np.ndarray], np.ndarray], clock: Clock | None, tmp_path: Path
) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, b_frames=2)
    stored = read_frames(path, [0, 7], where="a", clock=clock)
    displayed = read_frames(with_matrix(path, *matrix), [0, 7], where="a", clock=clock)
    np.testing.assert_array_equal(displayed, [to_displayed(image) for image in stored])


@pytest.mark.parametrize("matrix", [(0, 0, 0, 0), (1, 1, -1, 1), (1, 0, 0, 0)])
def test_display_matrix_that_is_not_a_rotation_by_90_degrees_raises(matrix: tuple[int, ...], tmp_path: Path) -> None:
    path = with_matrix(write_mp4(tmp_path / "a.mp4", FRAMES), *matrix)
    with pytest.raises(InputError, match="a: a display matrix that is not a rotation by a multiple of 90 degrees"):
        read_frames(path, [0], where="a")


def test_only_necessary_packets_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, gop=12)
    decoded_times: list[int] = []
    original_collect = video_reader._Video._collect

    def collect(self: video_reader._Video, frames: Sequence[Any], *arguments: Any) -> None:
        decoded_times.extend(frame.pts for frame in frames)
        original_collect(self, frames, *arguments)

    monkeypatch.setattr(video_reader._Video, "_collect", collect)
    read_frames(path, [14, 38], where="a")
    assert [time // 1024 for time in decoded_times] == [12, 13, 14, 36, 37, 38]


def test_libav_does_not_allocate_images_above_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES)
    monkeypatch.setitem(video_reader._DECODER_OPTIONS, "max_pixels", "1000")
    with pytest.raises(InputError, match=r"a\.mp4: (cannot be read as a video|no image)"):
        read_frames(path, [0, 2], where="a.mp4")


class FailingFile(io.BytesIO):
    """A file whose reads fail after a number of reads, like those of a network."""

    def __init__(self, data: bytes, reads: int) -> None:
        super().__init__(data)
        self.reads = reads

    def read(self, size: int | None = -1, /) -> bytes:
        self.reads -= 1
        if self.reads < 0:
            raise ConnectionResetError("gone")
        return super().read(size)


@pytest.mark.parametrize("reads", [0, 1, 2])
def test_network_failure_is_not_reported_as_a_damaged_video(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], reads: int
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, 72, 128, 3), dtype=np.uint8)
    data = write_mp4(tmp_path / "a.mp4", list(noise)).read_bytes()
    with pytest.raises(ConnectionResetError):
        read_frames(FailingFile(data, reads), [20], where="a")
    assert capfd.readouterr().err == ""


def truncate(data: bytes, fraction: float) -> bytes:
    return data[: int(len(data) * fraction)]


def zero_middle(data: bytes) -> bytes:
    """Replace 3,000 bytes of the encoded frames by zeros."""
    start = data.index(b"mdat") + 4000
    return data[:start] + bytes(3000) + data[start + 3000 :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda _: b"", "cannot be read as a video"),
        (lambda _: b"<html>" * 100, "cannot be read as a video"),
        (lambda data: truncate(data, 0.5), "cannot be read as a video"),
        (lambda data: truncate(data, 0.99), "cannot be read as a video"),
        (lambda data: data.replace(b"vide", b"soun"), "no video"),
        (lambda data: data.replace(b"avc1", b"zzz1"), "codec"),
        (zero_middle, "cannot be read as a video"),
    ],
)
def test_damaged_video_raises_and_libav_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], damage: Callable[[bytes], bytes], message: str
) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES * 2)
    path.write_bytes(damage(path.read_bytes()))
    capfd.readouterr()
    with pytest.raises(InputError, match=f"a.mp4 of seven: .*{message}"):
        read_frames(path, range(2 * STEPS), where="a.mp4 of seven")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("clock", [None, Clock(0.0, 15.0)])
def test_frame_past_the_end_raises(tmp_path: Path, clock: Clock | None) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES)
    with pytest.raises(InputError, match=r"40 frames. Expected at least 43|no frame at 2.800 s"):
        read_frames(path, [3, 42], where="a", clock=clock)


def test_reordered_frames_without_header_information_are_found_by_time(tmp_path: Path) -> None:
    """Frames of a file with key frames only may be displayed in another order than they are stored."""
    times = [1, 3, 2, 5, 4, 7, 6, 8]  # presentation time of each stored frame
    frames = decode_all(write_mp4(tmp_path / "original.mp4", FRAMES[:8], gop=1))
    with av.open(str(tmp_path / "original.mp4")) as source, av.open(str(tmp_path / "reordered.mp4"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for index, packet in enumerate(list(source.demux(source.streams.video[0]))[:8]):
            packet.pts, packet.dts, packet.stream = times[index] * 1024, index * 1024, stream
            target.mux(packet)
    expected = frames[np.argsort(times)]
    np.testing.assert_array_equal(read_frames(tmp_path / "reordered.mp4", range(8), where="a"), expected)


def test_time_unit_too_coarse_for_the_rate_raises(tmp_path: Path) -> None:
    """Libav reads a time scale of 0 as whole seconds, so all frames of a second have the same time."""
    path = write_mp4(tmp_path / "a.mp4", FRAMES)
    data = bytearray(path.read_bytes())
    scale = data.index(b"mdhd") + 16
    data[scale : scale + 4] = bytes(4)
    path.write_bytes(data)
    with pytest.raises(
        InputError,
        match=r"a time unit of 1 s.*too coarse for 15 frames per second\. .*a different time",
    ):
        read_frames(path, [0, 5], where="a", clock=Clock(0.0, 15.0))


def make_frames(count: int = 5, height: int = 33, width: int = 48) -> list[np.ndarray]:
    shades = np.linspace(40, 220, count).astype(np.uint8)
    frames = [np.full((height, width, 3), shade, dtype=np.uint8) for shade in shades]
    for frame in frames:
        frame[:, : width // 2, 0] = 200
        frame[:, : width // 2, 2] = 30
    return frames


def test_written_video_reads_back(tmp_path: Path) -> None:
    frames = make_frames()
    path = write_video(tmp_path / "new" / "a.mp4", iter(frames), rate_hz=3.75)
    assert read_header(path, where="a").num_frames == 5
    decoded = read_frames(path, range(5), where="a")
    assert decoded.shape == (5, 32, 48, 3)  # an odd row is dropped
    for image, frame in zip(decoded, frames, strict=True):
        np.testing.assert_allclose(image.mean(axis=(0, 1)), frame[:32].mean(axis=(0, 1)), atol=6)
    with av.open(str(path)) as file:
        assert float(file.duration / av.time_base) == pytest.approx(5 / 3.75, abs=0.05)
        assert file.streams.video[0].codec_context.pix_fmt == "yuv420p"


def test_failed_video_write_leaves_no_file(tmp_path: Path) -> None:
    for frames, message in (([], "without frames"), ([*make_frames(1), *make_frames(1, 20)], "in one video")):
        with pytest.raises(ValueError, match=message):
            write_video(tmp_path / "a.mp4", frames, rate_hz=4.0)
        assert not list(tmp_path.iterdir())


def test_rollouts_without_pyav_are_written_as_gif_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[str] = []
    monkeypatch.setitem(sys.modules, "av", None)
    for name, value in (
        ("draw_strip", FRAMES[0]),
        ("render_frames", FRAMES[:2]),
        ("schedule_loop", [(1, 0.1), (0, 0.1)]),
    ):
        monkeypatch.setattr(imagine, name, lambda *_, value=value, **__: value)
    monkeypatch.setattr(imagine, "make_strip", lambda _: {})
    paths = imagine.write_rollouts(None, tmp_path, reporter=SimpleNamespace(note=notes.append))  # type: ignore[arg-type]
    assert imagine.VIDEO not in {path.name for path in paths}
    assert all(path.is_file() for path in paths)
    assert "pip install" in notes[0]
