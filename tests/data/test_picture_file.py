"""A picture in a file becomes its RGB pixels, or the user reads what is in the file."""

import io
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from vjepa2_ac.data.picture_file import decode_picture, read_picture
from vjepa2_ac.errors import InputError

PIXELS = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def png(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, format="PNG")
    return file.getvalue()


def test_a_png_is_its_pixels(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png(Image.fromarray(PIXELS)))
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), PIXELS)


def test_a_jpeg_is_its_pixels_in_the_order_of_rgb() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    found = decode_picture(simplejpeg.encode_jpeg(red, colorspace="RGB", quality=95), "here")
    np.testing.assert_allclose(found.astype(int), red, atol=6)


def test_grey_and_transparent_pictures_become_rgb() -> None:
    grey = Image.fromarray(PIXELS[..., 0])
    np.testing.assert_array_equal(decode_picture(png(grey), "here"), PIXELS[..., :1].repeat(3, axis=-1))
    seen_through = Image.fromarray(np.dstack([PIXELS, PIXELS[..., :1]]))
    np.testing.assert_array_equal(decode_picture(png(seen_through), "here"), PIXELS)


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "0 bytes that are no picture"),
        (b"x,y,z\n1,2,3\n", "no picture, starting with b'x,y,'"),
        (png(Image.fromarray(PIXELS))[:60], "no picture"),
        (simplejpeg.encode_jpeg(PIXELS)[:60], "no picture"),
        (png(Image.fromarray(PIXELS[..., 0].astype(np.uint16))), "not 8 bits a channel"),
    ],
)
def test_what_is_no_picture_is_refused(data: bytes, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "goal.png").write_bytes(data)
    with pytest.raises(InputError, match=rf"goal\.png.*{complaint}"):
        read_picture(tmp_path / "goal.png")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"goal\.png: cannot be read: No such file"):
        read_picture(tmp_path / "goal.png")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_picture(tmp_path)
