"""Image files: decoded to RGB pixels, or an error that describes the file."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_file import decode_image, read_image
from vjepa2_ac.media.image_size import require_bounded

PIXELS = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def png(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, format="PNG")
    return file.getvalue()


def test_a_png_is_its_pixels(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png(Image.fromarray(PIXELS)))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), PIXELS)


def test_a_jpeg_is_its_pixels_in_the_order_of_rgb() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    found = decode_image(simplejpeg.encode_jpeg(red, colorspace="RGB", quality=95), "here")
    np.testing.assert_allclose(found.astype(int), red, atol=6)


def test_grey_and_transparent_images_become_rgb() -> None:
    grey = Image.fromarray(PIXELS[..., 0])
    np.testing.assert_array_equal(decode_image(png(grey), "here"), PIXELS[..., :1].repeat(3, axis=-1))
    seen_through = Image.fromarray(np.dstack([PIXELS, PIXELS[..., :1]]))
    np.testing.assert_array_equal(decode_image(png(seen_through), "here"), PIXELS)


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "0 bytes that are no image"),
        (b"x,y,z\n1,2,3\n", "no image, starting with b'x,y,'"),
        (png(Image.fromarray(PIXELS))[:60], "no image"),
        (simplejpeg.encode_jpeg(PIXELS)[:60], "no image"),
        (png(Image.fromarray(PIXELS[..., 0].astype(np.uint16))), "not 8 bits a channel"),
    ],
)
def test_what_is_no_image_is_refused(data: bytes, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "goal.png").write_bytes(data)
    with pytest.raises(InputError, match=rf"goal\.png.*{complaint}"):
        read_image(tmp_path / "goal.png")


def claimed_png(height: int, width: int) -> bytes:
    """Return a PNG of a few hundred bytes that says to be of a size."""
    data = png(Image.fromarray(PIXELS))
    header = data[12:16] + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def claimed_jpeg(height: int, width: int) -> bytes:
    """Return a JPEG likewise."""
    data = simplejpeg.encode_jpeg(PIXELS)
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + struct.pack(">HH", height, width) + data[place + 4 :]


@pytest.mark.parametrize("claimed", [claimed_png, claimed_jpeg])
@pytest.mark.parametrize("size", [(65_500, 65_500), (10_001, 10_000), (1, 65_500 * 1_530)])
def test_an_image_that_claims_to_be_huge_is_refused_before_anything_is_made(
    claimed: Callable[[int, int], bytes], size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    if claimed is claimed_jpeg and max(size) > 65_535:
        pytest.skip("a JPEG cannot say so")
    monkeypatch.setattr(simplejpeg, "decode_jpeg", None)
    monkeypatch.setattr(Image.Image, "convert", None)
    with pytest.raises(InputError, match=f"goal: an image of {size[0]} x {size[1]} pixels.*100 megapixels"):
        decode_image(claimed(*size), "goal")


def test_a_jpeg_that_goes_over_its_pixels_again_and_again_is_refused() -> None:
    data = claimed_jpeg(10_000, 10_000)
    assert len(data) < 3_000
    with pytest.raises(InputError, match="in 501 scans"):
        decode_image(data[:-2] + b"\xff\xda" * 500 + data[-2:], "goal")
    progressive = io.BytesIO()
    Image.fromarray(PIXELS).save(progressive, format="JPEG", progressive=True)
    assert progressive.getvalue().count(b"\xff\xda") > 5
    assert decode_image(progressive.getvalue(), "goal").shape == PIXELS.shape


def test_a_tiff_is_taken_for_depth() -> None:
    file = io.BytesIO()
    Image.fromarray(np.full((8, 8), 900, np.uint16)).save(file, "TIFF")
    with pytest.raises(InputError, match=r"goal: a TIFF, as depth is stored\. needed: a camera's image"):
        decode_image(file.getvalue(), "goal")


def test_images_that_are_too_many_of_their_size_are_not_decoded_together() -> None:
    require_bounded(720, 1280, "clip", count=256)
    with pytest.raises(InputError, match="clip: 64 images of 10000 x 10000 pixels at once"):
        require_bounded(10_000, 10_000, "clip", count=64)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"goal\.png: cannot be read: No such file"):
        read_image(tmp_path / "goal.png")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_image(tmp_path)
