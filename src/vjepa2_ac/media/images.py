"""Decode and encode PNG and JPEG images, limit the size of decoded images, and check the frames of cameras."""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path

import numpy as np
import simplejpeg
from jaxtyping import Float, UInt8
from PIL import ExifTags, Image, ImageOps
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.spaces import StateSpace, rotation_angles
from vjepa2_ac.storage import read_small_file, translate_read_errors

MAX_PIXELS = 100_000_000  # ten times the pixels of a robot's camera; the header of a tiny file may claim 4 billion
_MAX_BYTES = 1 << 32  # limit for images that are decoded together
_MAX_FILE_BYTES = 1 << 28  # an uncompressed PNG of the largest allowed image has 300 MB
_MIN_SIDE = 16  # minimum height and width of an image of a robot's scene, in pixels


def require_decodable_size(height: int, width: int, where: str, *, count: int = 1) -> None:
    """Refuse images that are too large, alone or together, before memory is allocated for decoding.

    Args:
        height: Height of each image in pixels.
        width: Width of each image in pixels.
        where: The file, episode and step, for messages.
        count: Number of images that are decoded together.

    Raises:
        InputError: The images are too large.
    """
    if not 0 < height * width <= MAX_PIXELS or count * height * width * 3 > _MAX_BYTES:
        problem = f"{counted(count, 'image')} of {height} x {width} pixels, decoded together"
        needed = f"at most {MAX_PIXELS // 10**6} megapixels each, and {_MAX_BYTES // 10**9} GB together"
        fix = "Reduce the size of the images, exclude the episode, or lower data.frames"
        raise InputError(where=where, found=problem, needed=needed, fix=fix)


def require_image(image: np.ndarray, *, where: str, like: np.ndarray | None = None) -> None:
    """Refuse an array that is not an RGB image, or whose size differs from a reference image.

    Args:
        image: The array.
        where: Name of the image, for messages.
        like: A reference image of the same camera; None: any size.

    Raises:
        InputError: The array has another shape or type.
    """
    problem = f"an array of shape {image.shape} and type {image.dtype}"
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or min(image.shape[:2]) < _MIN_SIDE:
        needed = f"an RGB image: height x width x 3, uint8, {_MIN_SIDE} pixels or more"
        raise InputError(where=where, found=problem, needed=needed)
    if like is not None and image.shape != like.shape:
        problem = f"{image.shape[1]} x {image.shape[0]} pixels (width x height)"
        needed = f"{like.shape[1]} x {like.shape[0]}, like the goal image: same camera, viewpoint and resolution"
        raise InputError(where=where, found=problem, needed=needed)


def require_mask(mask: np.ndarray, *, where: str, like: np.ndarray) -> None:
    """Refuse a mask whose height and width differ from those of an image.

    Raises:
        InputError: The sizes differ.
    """
    if mask.shape != like.shape[:2]:
        problem, needed = f"shape {mask.shape} (height, width)", f"{like.shape[:2]}, like the goal image"
        raise InputError(where=where, found=problem, needed=needed)


def decode_images(
    images: Sequence[bytes], steps: Sequence[int], where: str
) -> UInt8[np.ndarray, "time height width 3"]:
    """Decode PNG or JPEG images to RGB. The pixels of a JPEG are bit-exactly those of TensorFlow's decoder.

    Args:
        images: Encoded images of one size. The format is detected from the content. Without images the result is empty.
        steps: Control step of each image, for messages.
        where: File, episode and camera, for messages.

    Raises:
        InputError: An image is neither PNG nor JPEG, has more than 8 bits per channel, is too large, or differs in size
            from the first image.
    """
    decode = decode_image if images and images[0].startswith(_PNG) else _decode_as_tensorflow
    decoded = (decode(image, f"{where}: step {step}") for image, step in zip(images, steps, strict=True))
    return stack_frames(decoded, steps, where)


def _decode_as_tensorflow(image: bytes, where: str) -> UInt8[np.ndarray, "height width 3"]:
    try:
        return _decode_jpeg(image, where, is_fast=True)
    except ValueError as error:
        problem = f"{len(image)} bytes that are not a JPEG, starting with {bytes(image[:4])!r} ({error})"
        raise InputError(where=where, found=problem, needed="a JPEG or PNG image") from None


def stack_frames(
    frames: Iterable[UInt8[np.ndarray, "height width 3"]], steps: Sequence[int], where: str
) -> UInt8[np.ndarray, "time height width 3"]:
    """Stack frames from an iterator, which may decode them on demand, and check their size.

    Args:
        frames: Frames of one size. Without frames the result is empty.
        steps: Control step of each frame, for messages.
        where: File, episode and camera, for messages.

    Raises:
        InputError: A frame differs in size from the first frame, or the frames are too large together.
    """
    stacked: list[UInt8[np.ndarray, "height width 3"]] = []
    for frame, step in zip(frames, steps, strict=True):
        step_where = f"{where}: step {step}"
        require_decodable_size(frame.shape[0], frame.shape[1], step_where, count=len(steps))
        if stacked and frame.shape != stacked[0].shape:
            problem, needed = (f"an image of {image.shape[0]}x{image.shape[1]}" for image in (frame, stacked[0]))
            raise InputError(where=step_where, found=problem, needed=f"{needed}, as at step {steps[0]}")
        stacked.append(frame)
    return np.stack(stacked) if stacked else np.zeros((0, 0, 0, 3), np.uint8)


def encode_jpeg(frame: UInt8[np.ndarray, "height width 3"], *, quality: int = 95) -> bytes:
    """Encode an RGB image as JPEG; the default quality is that of TensorFlow Datasets."""
    return bytes(
        simplejpeg.encode_jpeg(np.ascontiguousarray(frame), quality=quality, colorspace="RGB", colorsubsampling="420")
    )


_PNG = b"\x89PNG"
_EXIF = b"Exif\0\0"  # header of the EXIF data in a JPEG
_EIGHT_BIT = {"1", "L", "LA", "P", "RGB", "RGBA"}  # Pillow's modes with at most 8 bits per channel


def read_image(path: str | Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read a PNG or JPEG file and return its RGB pixels, as `decode_image` does.

    Raises:
        InputError: The file is missing, too large, a pipe or a device, or neither PNG nor JPEG.
    """
    with translate_read_errors(path, needed="an image: PNG or JPEG"):
        data = read_small_file(path, _MAX_FILE_BYTES)
    return decode_image(data, str(path))


def decode_image(data: bytes, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Decode PNG or JPEG bytes to RGB pixels, rotated and mirrored according to the EXIF orientation.

    Transparency is dropped.

    Raises:
        InputError: The bytes are neither PNG nor JPEG, damaged, too large, or have more than 8 bits per channel.
    """
    try:
        if data.startswith(b"\xff\xd8"):
            pixels = _decode_jpeg(data, where)
            if _EXIF not in data:  # a fast search, which avoids opening the images of robot cameras a second time
                return pixels
            with JpegImageFile(io.BytesIO(data)) as image:  # reads the header only
                return _apply_orientation(pixels, image)
        with PngImageFile(io.BytesIO(data)) as image:  # reads the header only
            require_decodable_size(image.height, image.width, where)
            return _apply_orientation(_as_rgb(image), image)
    except (OSError, ValueError, SyntaxError, struct.error, zlib.error, EOFError, IndexError) as error:
        problem = f"{len(data)} bytes that are not an image, starting with {data[:4]!r} ({error})"
        needed = "a PNG or JPEG image; depth images, such as TIFF, are not supported"
        raise InputError(where=where, found=problem, needed=needed) from None


def _decode_jpeg(data: bytes, where: str, *, is_fast: bool = False) -> UInt8[np.ndarray, "height width 3"]:
    height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    require_decodable_size(height, width, where)
    return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB", fastdct=is_fast))


def _apply_orientation(
    pixels: UInt8[np.ndarray, "height width 3"], image: Image.Image
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Rotate and mirror pixels according to the EXIF orientation of an image; unreadable EXIF data are ignored."""
    with suppress(OSError, ValueError, SyntaxError, struct.error, LookupError):
        orientation = image.getexif()[ExifTags.Base.Orientation]
        unoriented = Image.fromarray(pixels)
        unoriented.getexif()[ExifTags.Base.Orientation] = orientation
        return np.array(ImageOps.exif_transpose(unoriented))
    return pixels


def _as_rgb(image: Image.Image) -> UInt8[np.ndarray, "height width 3"]:
    if image.mode not in _EIGHT_BIT:
        raise ValueError(f"pixel format {image.mode}, not 8 bits per channel")
    return np.array(image.convert("RGB"))


def encode_png(pixels: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """Encode RGB or RGBA pixels as PNG."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", optimize=True)
    return file.getvalue()


def encode_webp(
    frames: Sequence[UInt8[np.ndarray, "height width channels"]], seconds: Sequence[float], *, quality: int
) -> bytes:
    """Encode RGB or RGBA frames of one size as an endless WebP animation, or a single frame as a still image.

    Args:
        frames: The frames.
        seconds: Duration of each frame in seconds.
        quality: Quality of the compression, from 0 to 100.
    """
    file = io.BytesIO()
    first, *remaining = (Image.fromarray(frame) for frame in frames)
    times = [int(1000 * duration_s) for duration_s in seconds]
    first.save(file, "WEBP", save_all=True, append_images=remaining, duration=times, loop=0, quality=quality)
    return file.getvalue()


# ---- checks of a camera ----

_BLOCKS = 16  # blocks along each side of an image; averaging over a block removes sensor noise but not the scene
_MIN_CONTRAST = 1.0  # of 255; a covered lens with noise of 10 is below, a scene at 5 % of its brightness is above
_STILL_M, _STILL_RAD = 0.005, math.radians(3.0)  # larger than the noise of the measured states of a still arm
_STILL_FRACTION = 0.5  # the threshold for vectors, as a fraction of the largest change in a model step

CameraFrame = tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, " dim"]]
"""The newest frame of one camera, and the state that was measured when this frame appeared."""


def newest_frames(
    views: Iterable[np.ndarray], state: Float[np.ndarray, " dim"], previous: Iterable[CameraFrame]
) -> tuple[CameraFrame, ...]:
    """Return the newest distinct frame of each camera: a repeated image keeps the state of its first appearance.

    Args:
        views: The current image of each camera. It is copied, because a driver may reuse its memory for the next image.
        state: The measured state.
        previous: The previous result; empty after a reset.
    """
    pairs = zip_longest(views, previous)
    return tuple(last if last and np.array_equal(last[0], view) else (view.copy(), state) for view, last in pairs)


def has_moved(
    earlier: Float[np.ndarray, " dim"],
    later: Float[np.ndarray, " dim"],
    space: StateSpace,
    max_change: Float[np.ndarray, " dim"],
) -> bool:
    """Return whether two measured states differ by more than the noise of a still robot.

    Args:
        earlier: The earlier state.
        later: The later state.
        space: The space of the states.
        max_change: The largest change of each number in a model step; used for vectors, whose units are unknown.
    """
    (change,) = space.compute_differences(np.stack([earlier, later]))
    if not space.is_pose:
        return bool(((max_change > 0) & (abs(change) > _STILL_FRACTION * max_change)).any())
    return float(np.linalg.norm(change[:3])) > _STILL_M or float(rotation_angles(change[None, 3:6])[0]) > _STILL_RAD


def is_uniform(image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Return whether an image has no contrast, as from a black, covered or defective camera, with or without noise.

    The criterion is that the standard deviation of the means of 16 x 16 blocks is below 1 of 255 in each colour.
    """
    blocks = Image.fromarray(np.ascontiguousarray(image)).resize((_BLOCKS, _BLOCKS), Image.Resampling.BOX)
    return bool(np.asarray(blocks, dtype=float).std(axis=(0, 1)).max() < _MIN_CONTRAST)


def require_contrast(views: Iterable[np.ndarray], *, where: str) -> None:
    """Refuse an image if the view of any of its cameras has no contrast.

    Raises:
        InputError: A view is uniform.
    """
    if any(map(is_uniform, views)):
        problem, needed = "an image without contrast, as from a black or covered camera", "an image of the scene"
        raise InputError(where=where, found=problem, needed=needed)
