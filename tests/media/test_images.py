"""Images are decoded to RGB pixels or rejected with a description; all data formats have the same size limit."""

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
from vjepa2_ac.media import images
from vjepa2_ac.media.images import decode_image, read_image

PIXELS = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def encode(image: Image.Image, image_format: str = "PNG") -> bytes:
    file = io.BytesIO()
    image.save(file, format=image_format)
    return file.getvalue()


def test_images_decode_to_their_rgb_pixels(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode(Image.fromarray(PIXELS)))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), PIXELS)
    transparent = Image.fromarray(np.dstack([PIXELS, PIXELS[..., :1]]))
    np.testing.assert_array_equal(decode_image(encode(transparent), "here"), PIXELS)
    grey = Image.fromarray(PIXELS[..., 0])
    np.testing.assert_array_equal(decode_image(encode(grey), "here"), PIXELS[..., :1].repeat(3, axis=-1))
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    decoded = decode_image(simplejpeg.encode_jpeg(red, colorspace="RGB", quality=95), "here")
    np.testing.assert_allclose(decoded.astype(int), red, atol=6)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "0 bytes that are not an image"),
        (b"x,y,z\n1,2,3\n", "not an image, starting with b'x,y,'"),
        (encode(Image.fromarray(PIXELS))[:60], "not an image"),
        (simplejpeg.encode_jpeg(PIXELS)[:60], "not an image"),
        (encode(Image.fromarray(PIXELS[..., 0].astype(np.uint16))), "not 8 bits per channel"),
        (encode(Image.fromarray(PIXELS[..., 0].astype(np.uint16)), "TIFF"), "not an image, .*depth images, such as"),
    ],
)
def test_invalid_image_raises(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "goal.png").write_bytes(data)
    with pytest.raises(InputError, match=rf"goal\.png.*{message}"):
        read_image(tmp_path / "goal.png")


def make_png_with_size(height: int, width: int) -> bytes:
    """Return a PNG of a few hundred bytes whose header claims this size."""
    data = encode(Image.fromarray(PIXELS))
    header = data[12:16] + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def make_jpeg_with_size(height: int, width: int) -> bytes:
    """Return a JPEG of a few hundred bytes whose header claims this size."""
    data = simplejpeg.encode_jpeg(PIXELS)
    offset = data.index(b"\xff\xc0") + 5
    return data[:offset] + struct.pack(">HH", height, width) + data[offset + 4 :]


@pytest.mark.parametrize("size", [(65_500, 65_500), (10_001, 10_000)])
def test_huge_image_raises_before_decoding(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simplejpeg, "decode_jpeg", None)
    monkeypatch.setattr(Image.Image, "convert", None)
    calls: list[Callable[[], object]] = [
        lambda: decode_image(make_png_with_size(*size), "goal"),
        lambda: decode_image(make_jpeg_with_size(*size), "goal"),
        lambda: images.decode_images([make_jpeg_with_size(*size)], [5], "goal"),
    ]
    for decode in calls:
        with pytest.raises(InputError, match=f"goal.*: 1 image of {size[0]} x {size[1]} pixels.*100 megapixels"):
            decode()


def test_decoding_no_images_returns_an_empty_array() -> None:
    assert images.decode_images([], [], "goal").shape == (0, 0, 0, 3)


@pytest.mark.parametrize("data_format", ["rlds", "lerobot videos", "lerobot images", "npz"])
def test_all_data_formats_reject_images_above_the_limit(
    tmp_path: Path, data_format: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "set"
    if data_format == "rlds":
        write_synthetic_droid(path, steps=[3], size=(32, 64), shards=1)
    elif data_format == "npz":
        path.mkdir()
        frames = np.zeros((3, 32, 64, 3), np.uint8)
        np.savez(path / "one.npz", states=np.zeros((3, 7)), frames=frames, fps_hz=15.0)
    else:
        write_v30(
            path, [recorded(0, 3, size=(32, 64))], image_format="video" if data_format == "lerobot videos" else "png"
        )
    source = open_source(DataConfig(source=data_format.split(maxsplit=1)[0], path=str(path)))
    source.infos()
    read = source.read(0).read_frames
    assert read([0, 2]).shape == (2, 32, 64, 3)
    for name, limit, message in (("MAX_PIXELS", 2_000, "32 x 64"), ("_MAX_BYTES", 10_000, "2 images of 32 x 64")):
        monkeypatch.setattr(images, name, limit)
        with pytest.raises(InputError, match=message):
            read([0, 2])
        monkeypatch.undo()


def encode_with_orientation(pixels: np.ndarray, orientation: object, image_format: str) -> bytes:
    """Return an image file with an EXIF orientation."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x0112] = orientation
    options = {"quality": 98, "subsampling": 0} if image_format == "JPEG" else {}
    Image.fromarray(pixels).save(file, image_format, exif=exif, **options)
    return file.getvalue()


TO_STORED = {  # the stored image as a function of the displayed image, by EXIF orientation
    1: lambda displayed: displayed,
    2: lambda displayed: displayed[:, ::-1],
    3: lambda displayed: displayed[::-1, ::-1],
    4: lambda displayed: displayed[::-1],
    5: lambda displayed: displayed.swapaxes(0, 1),
    6: lambda displayed: np.rot90(displayed),
    7: lambda displayed: displayed[::-1, ::-1].swapaxes(0, 1),
    8: lambda displayed: np.rot90(displayed, -1),
}


@pytest.mark.parametrize("image_format", ["JPEG", "PNG"])
@pytest.mark.parametrize("orientation", TO_STORED)
def test_exif_orientation_is_applied(orientation: int, image_format: str, tmp_path: Path) -> None:
    displayed = np.zeros((24, 40, 3), np.uint8)
    displayed[:8, :8], displayed[:8, 32:], displayed[16:, :8] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    stored = np.ascontiguousarray(TO_STORED[orientation](displayed))
    (tmp_path / "goal").write_bytes(encode_with_orientation(stored, orientation, image_format))
    pixels = read_image(tmp_path / "goal")
    assert pixels.shape == displayed.shape
    assert abs(pixels.astype(int) - displayed).max() < (40 if image_format == "JPEG" else 1)


def test_pipe_or_too_large_image_file_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "goal.png")
    for path in (tmp_path / "goal.png", "/dev/zero"):
        with pytest.raises(InputError, match="a pipe or a device"):
            read_image(path)
    monkeypatch.setattr(images, "_MAX_FILE_BYTES", 1000)
    (tmp_path / "large.png").write_bytes(encode(Image.fromarray(PIXELS)))
    with pytest.raises(InputError, match=r"large\.png: .*at most 1,000 bytes"):
        read_image(tmp_path / "large.png")
