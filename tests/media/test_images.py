"""Images: decoded to RGB pixels, or an error that describes them; one size limit for every form of data."""

import io
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from lerobot_sets import recorded, write_v30
from synthetic import write_synthetic_droid
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.errors import InputError
from vjepa2_ac.media import images as jpeg
from vjepa2_ac.media.images import decode_image, read_image

PIXELS = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def png(image: Image.Image, form: str = "PNG") -> bytes:
    file = io.BytesIO()
    image.save(file, format=form)
    return file.getvalue()


def test_images_decode_to_their_rgb_pixels(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png(Image.fromarray(PIXELS)))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), PIXELS)
    seen_through = Image.fromarray(np.dstack([PIXELS, PIXELS[..., :1]]))
    np.testing.assert_array_equal(decode_image(png(seen_through), "here"), PIXELS)
    grey = Image.fromarray(PIXELS[..., 0])
    np.testing.assert_array_equal(decode_image(png(grey), "here"), PIXELS[..., :1].repeat(3, axis=-1))
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    found = decode_image(simplejpeg.encode_jpeg(red, colorspace="RGB", quality=95), "here")
    np.testing.assert_allclose(found.astype(int), red, atol=6)


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "0 bytes that are not an image"),
        (b"x,y,z\n1,2,3\n", "not an image, starting with b'x,y,'"),
        (png(Image.fromarray(PIXELS))[:60], "not an image"),
        (simplejpeg.encode_jpeg(PIXELS)[:60], "not an image"),
        (png(Image.fromarray(PIXELS[..., 0].astype(np.uint16))), "not 8 bits per channel"),
        (png(Image.fromarray(PIXELS[..., 0].astype(np.uint16)), "TIFF"), "not an image, .*depth images, such as TIFF"),
    ],
)
def test_invalid_image_raises(data: bytes, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "goal.png").write_bytes(data)
    with pytest.raises(InputError, match=rf"goal\.png.*{complaint}"):
        read_image(tmp_path / "goal.png")


def claimed_png(height: int, width: int) -> bytes:
    """Return a PNG of a few hundred bytes whose header claims a size."""
    data = png(Image.fromarray(PIXELS))
    header = data[12:16] + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def claimed_jpeg(height: int, width: int) -> bytes:
    """Return a JPEG of a few hundred bytes whose header claims a size."""
    data = simplejpeg.encode_jpeg(PIXELS)
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + struct.pack(">HH", height, width) + data[place + 4 :]


@pytest.mark.parametrize("size", [(65_500, 65_500), (10_001, 10_000)])
def test_huge_image_raises_before_decoding(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simplejpeg, "decode_jpeg", None)
    monkeypatch.setattr(Image.Image, "convert", None)
    huge: list[Callable[[], object]] = [
        lambda: decode_image(claimed_png(*size), "goal"),
        lambda: decode_image(claimed_jpeg(*size), "goal"),
        lambda: jpeg.decode_images([claimed_jpeg(*size)], [5], "goal"),
    ]
    for decode in huge:
        with pytest.raises(InputError, match=f"goal.*: 1 image of {size[0]} x {size[1]} pixels.*100 megapixels"):
            decode()


def test_decoding_no_images_returns_an_empty_array() -> None:
    assert jpeg.decode_images([], [], "goal").shape == (0, 0, 0, 3)


FORMS = ("rlds", "lerobot videos", "lerobot images", "npz")


@pytest.mark.parametrize("form", FORMS)
def test_all_formats_reject_images_above_the_limit(tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "set"
    if form == "rlds":
        write_synthetic_droid(path, steps=[3], size=(32, 64), shards=1)
    elif form == "npz":
        path.mkdir()
        frames = np.zeros((3, 32, 64, 3), np.uint8)
        np.savez(path / "one.npz", states=np.zeros((3, 7)), frames=frames, fps_hz=15.0)
    else:
        write_v30(path, [recorded(0, 3, size=(32, 64))], pictures="video" if form == "lerobot videos" else "png")
    source = open_source(DataConfig(source=form.split(maxsplit=1)[0], path=str(path)))
    source.infos()
    read = source.read(0).read_frames
    assert read([0, 2]).shape == (2, 32, 64, 3)
    for bound, most, message in (("MAX_PIXELS", 2_000, "32 x 64"), ("_MAX_BYTES", 10_000, "2 images of 32 x 64")):
        monkeypatch.setattr(jpeg, bound, most)
        with pytest.raises(InputError, match=message):
            read([0, 2])
        monkeypatch.undo()


def tagged(pixels: np.ndarray, orientation: object, form: str) -> bytes:
    """Return an image file with an EXIF orientation."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x0112] = orientation
    options = {"quality": 98, "subsampling": 0} if form == "JPEG" else {}
    Image.fromarray(pixels).save(file, form, exif=exif, **options)
    return file.getvalue()


STORED_AS = {  # by EXIF orientation: how a camera stores what a viewer shows
    1: lambda shown: shown,
    2: lambda shown: shown[:, ::-1],
    3: lambda shown: shown[::-1, ::-1],
    4: lambda shown: shown[::-1],
    5: lambda shown: shown.swapaxes(0, 1),
    6: lambda shown: np.rot90(shown),
    7: lambda shown: shown[::-1, ::-1].swapaxes(0, 1),
    8: lambda shown: np.rot90(shown, -1),
}


@pytest.mark.parametrize("form", ["JPEG", "PNG"])
@pytest.mark.parametrize("orientation", STORED_AS)
def test_exif_orientation_is_applied(orientation: int, form: str, tmp_path: Path) -> None:
    shown = np.zeros((24, 40, 3), np.uint8)
    shown[:8, :8], shown[:8, 32:], shown[16:, :8] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    stored = np.ascontiguousarray(STORED_AS[orientation](shown))
    (tmp_path / "goal").write_bytes(tagged(stored, orientation, form))
    found = read_image(tmp_path / "goal")
    assert found.shape == shown.shape
    assert abs(found.astype(int) - shown).max() < (40 if form == "JPEG" else 1)


def test_pipe_or_too_large_image_file_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "goal.png")
    for path in (tmp_path / "goal.png", "/dev/zero"):
        with pytest.raises(InputError, match="a pipe or a device"):
            read_image(path)
    monkeypatch.setattr(jpeg, "_MAX_FILE_BYTES", 1000)
    (tmp_path / "large.png").write_bytes(png(Image.fromarray(PIXELS)))
    with pytest.raises(InputError, match=r"large\.png: .*at most 1,000 bytes"):
        read_image(tmp_path / "large.png")
