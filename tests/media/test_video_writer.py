"""Written videos: our reader reads them back completely."""

import sys
from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.media.video import count_frames, read_frames, write_video

av = pytest.importorskip("av", reason="the extra `video` is not installed")


def frames(count: int = 5, height: int = 33, width: int = 48) -> list[np.ndarray]:
    shades = np.linspace(40, 220, count).astype(np.uint8)
    made = [np.full((height, width, 3), shade, dtype=np.uint8) for shade in shades]
    for frame in made:
        frame[:, : width // 2, 0] = 200
        frame[:, : width // 2, 2] = 30
    return made


def test_what_was_written_is_what_is_shown(tmp_path: Path) -> None:
    made = frames()
    path = write_video(tmp_path / "new" / "film.mp4", iter(made), rate_hz=3.75)
    assert count_frames(path, where="film") == 5
    shown = read_frames(path, range(5), where="film")
    assert shown.shape == (5, 32, 48, 3)  # an odd row is left out
    for ours, theirs in zip(made, shown, strict=True):
        np.testing.assert_allclose(theirs.mean(axis=(0, 1)), ours[:32].mean(axis=(0, 1)), atol=6)
    with av.open(str(path)) as file:
        assert float(file.duration / av.time_base) == pytest.approx(5 / 3.75, abs=0.05)
        assert file.streams.video[0].codec_context.pix_fmt == "yuv420p"


def test_nothing_is_left_of_a_video_that_cannot_be(tmp_path: Path) -> None:
    for made, wrong in (([], "without frames"), ([*frames(1), *frames(1, 20)], "in one video")):
        with pytest.raises(ValueError, match=wrong):
            write_video(tmp_path / "film.mp4", made, rate_hz=4.0)
        assert not list(tmp_path.iterdir())


def test_missing_pyav_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UnreachableError, match=r"pip install .*\[video\]"):
        write_video(tmp_path / "film.mp4", frames(), rate_hz=4.0)
