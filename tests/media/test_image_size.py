"""The image size limit: the same for every form of data, before allocation, as an error of one episode."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from lerobot_sets import recorded, write_v30
from recordings import write_mp4
from synthetic import draw_frame, write_synthetic_droid
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.lerobot.source import LeRobotSource
from vjepa2_ac.data.sources.npz.source import NpzSource
from vjepa2_ac.data.sources.rlds.source import RldsSource
from vjepa2_ac.episode import FrameReader
from vjepa2_ac.errors import InputError
from vjepa2_ac.media import image_size, video_reader
from vjepa2_ac.media.jpeg import decode_jpegs
from vjepa2_ac.media.video_reader import read_frames

FRAMES = [draw_frame(np.full(7, 0.1 * step), size=(32, 64)) for step in range(3)]


def of_rlds(folder: Path) -> FrameReader:
    write_synthetic_droid(folder / "set", steps=[3], size=(32, 64), shards=1)
    source = RldsSource(DataConfig(path=str(folder / "set")))
    source.infos()
    return source.read(0).read_frames


def of_lerobot(folder: Path, pictures: str) -> FrameReader:
    write_v30(folder / "set", [recorded(0, 3, size=(32, 64))], pictures=pictures)
    source = LeRobotSource(DataConfig(source="lerobot", path=str(folder / "set")))
    source.infos()
    return source.read(0).read_frames


def of_npz(folder: Path) -> FrameReader:
    np.savez(folder / "one.npz", states=np.zeros((3, 7)), frames=np.stack(FRAMES), fps_hz=15.0)
    source = NpzSource(DataConfig(source="npz", path=str(folder)))
    source.infos()
    return source.read(0).read_frames


FORMS: dict[str, Callable[[Path], FrameReader]] = {
    "rlds": of_rlds,
    "lerobot videos": lambda folder: of_lerobot(folder, "video"),
    "lerobot images": lambda folder: of_lerobot(folder, "png"),
    "npz": of_npz,
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_data_refuses_images_beyond_the_bound(
    tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = FORMS[form](tmp_path)
    assert read([0, 2]).shape == (2, 32, 64, 3)
    monkeypatch.setattr(image_size, "MOST_PIXELS", 2_000)
    with pytest.raises(InputError, match="an image of 32 x 64 pixels"):
        read([0, 2])
    monkeypatch.undo()
    monkeypatch.setattr(image_size, "_MOST_BYTES", 10_000)
    with pytest.raises(InputError, match="2 images of 32 x 64 pixels at once"):
        read([0, 2])


def test_a_short_jpeg_that_claims_65500_pixels_each_way_breaks_an_episode_and_not_the_run() -> None:
    data = simplejpeg.encode_jpeg(np.zeros((16, 16, 3), np.uint8))
    place = data.index(b"\xff\xc0") + 5
    huge = data[:place] + (65_500).to_bytes(2, "big") * 2 + data[place + 4 :]
    assert len(huge) < 700
    with pytest.raises(InputError, match="episode 3: step 5: an image of 65500 x 65500 pixels"):
        decode_jpegs([huge], [5], "episode 3")


def test_libav_itself_makes_no_room_for_an_image_beyond_the_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES)
    assert read_frames(path, [0, 2], where="a.mp4").shape == (2, 32, 64, 3)
    assert video_reader._STRICT["max_pixels"] == "100000000"
    monkeypatch.setitem(video_reader._STRICT, "max_pixels", "1000")
    with pytest.raises(InputError, match=r"a\.mp4: (cannot be read as a video|no image)"):
        read_frames(path, [0, 2], where="a.mp4")
