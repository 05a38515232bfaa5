"""Crop, scaling and normalisation equal the released recipe (golden/DATA_ORIGIN.md)."""

import json

import numpy as np
import pytest
import torch

from paths import GOLDEN
from vjepa2_ac.data import transforms
from vjepa2_ac.data.transforms import (
    CropBox,
    channel_constants,
    crop_box,
    crop_frames,
    input_to_pixels,
    pixels_to_input,
)
from vjepa2_ac.errors import InputError

FLOAT16_ROUNDING = 2.0**-10  # largest rounding error of a float16 between 2 and 4


def test_crops_equal_those_of_the_official_code() -> None:
    rows = json.loads((GOLDEN / "crops.json").read_text())
    assert len(rows) == 6
    for row in rows:
        expected = [CropBox(*crop) for crop in row["train_crops_seen"]]
        assert [crop_box(row["height"], row["width"])] == expected


def test_square_crop_equals_the_official_evaluation_crop() -> None:
    rows = json.loads((GOLDEN / "crops.json").read_text())
    for row in rows:
        assert crop_box(row["height"], row["width"], "square") == CropBox(*row["eval_crop"])


@pytest.mark.parametrize(("height", "width"), [(18, 32), (32, 18), (17, 32), (20, 20)])
def test_letterbox_keeps_all_pixels_between_black_bars(height: int, width: int) -> None:
    frames = np.random.default_rng(0).integers(1, 256, (2, height, width, 3), dtype=np.uint8)
    cropped = crop_frames(frames, "letterbox")
    side = max(height, width)
    assert cropped.shape == (2, side, side, 3)
    top, left = (side - height) // 2, (side - width) // 2
    assert np.array_equal(cropped[:, top : top + height, left : left + width], frames)
    assert int((cropped == 0).sum()) == 2 * 3 * side * (side - min(height, width))
    assert crop_box(height, width, "letterbox") == CropBox(0, 0, height, width)


@pytest.mark.parametrize("size", [(16, 20_000), (20_000, 16)])
def test_letterbox_that_needs_gigabytes_raises(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=r"data\.crop: letterbox: 1 image of 20000 x 20000 pixels"):
        crop_frames(np.zeros((1, *size, 3), np.uint8), "letterbox")


@pytest.mark.parametrize(("height", "width", "expected"), [(200, 100, (33, 0, 133, 100)), (180, 243, (0, 0, 180, 243))])
def test_tall_frames_are_cropped_and_cropped_frames_unchanged(
    height: int, width: int, expected: tuple[int, ...]
) -> None:
    assert crop_box(height, width) == CropBox(*expected)


def test_encoder_input_equals_the_official_transform() -> None:
    with np.load(GOLDEN / "transform_frame.npz") as golden:
        frame, expected = golden["frame"], golden["clip"].astype(np.float32)
    encoder_input = pixels_to_input(torch.from_numpy(crop_frames(frame[None]))[None], 256)[0, 0]
    assert abs(encoder_input.numpy()[:, ::8, ::8] - expected).max() <= FLOAT16_ROUNDING


def test_constants_cached_in_inference_mode_work_in_training() -> None:
    channel_constants.cache_clear()
    with torch.inference_mode():
        pixels_to_input(torch.zeros(1, 1, 8, 8, 3, dtype=torch.uint8), 8)
    assert not any(
        channel_constants(values, torch.device("cpu")).is_inference() for values in (transforms._MEAN, transforms._STD)
    )


def test_encoder_input_converts_back_to_the_image() -> None:
    frames = torch.randint(0, 256, (2, 3, 8, 8, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    assert torch.equal(input_to_pixels(pixels_to_input(frames, 8)).permute(0, 1, 3, 4, 2), frames)
