"""Crop, scaling and colours are those of the released recipe (golden/DATA_ORIGIN.md); augmentation is pure."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from paths import GOLDEN
from vjepa2_ac.config import AugmentConfig
from vjepa2_ac.data import transforms
from vjepa2_ac.data.transforms import (
    CropBox,
    crop_box,
    draw,
    frame_of_seen,
    frames_as_seen,
    input_to_pixels,
    jittered,
    per_channel,
    pixels_to_input,
    view,
)
from vjepa2_ac.episode import Augmentation
from vjepa2_ac.errors import InputError

FLOAT16_ROUNDING = 2.0**-10  # half a step between 2 and 4


def test_crops_equal_all_that_the_official_code_took() -> None:
    rows = json.loads((GOLDEN / "crops.json").read_text())
    assert len(rows) == 6
    for row in rows:
        found = crop_box(row["height"], row["width"])
        assert [CropBox(*seen) for seen in row["train_crops_seen"]] == [found]


def test_the_square_is_what_the_official_code_evaluates_on() -> None:
    rows = json.loads((GOLDEN / "crops.json").read_text())
    for row in rows:
        assert crop_box(row["height"], row["width"], "square") == CropBox(*row["eval_crop"])


@pytest.mark.parametrize(("height", "width"), [(18, 32), (32, 18), (17, 32), (20, 20)])
def test_a_letterbox_shows_every_pixel_between_black_bars(height: int, width: int) -> None:
    frames = np.random.default_rng(0).integers(1, 256, (2, height, width, 3), dtype=np.uint8)
    seen = view(frames, "letterbox")
    side = max(height, width)
    assert seen.shape == (2, side, side, 3)
    top, left = (side - height) // 2, (side - width) // 2
    assert np.array_equal(seen[:, top : top + height, left : left + width], frames)
    assert int((seen == 0).sum()) == 2 * 3 * side * (side - min(height, width))
    assert crop_box(height, width, "letterbox") == CropBox(0, 0, height, width)


@pytest.mark.parametrize("size", [(16, 20_000), (20_000, 16)])
def test_a_letterbox_that_would_take_gigabytes_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=r"data\.crop: letterbox: 1 images of 20000 x 20000 pixels"):
        view(np.zeros((1, *size, 3), np.uint8), "letterbox")


@pytest.mark.parametrize(("height", "width", "expected"), [(200, 100, (33, 0, 133, 100)), (180, 243, (0, 0, 180, 243))])
def test_tall_frames_are_cut_too_and_cropped_ones_are_left(height: int, width: int, expected: tuple[int, ...]) -> None:
    assert crop_box(height, width) == CropBox(*expected)


def test_the_transform_equals_the_official_one_on_a_frame() -> None:
    with np.load(GOLDEN / "transform_frame.npz") as golden:
        frame, expected = golden["frame"], golden["clip"].astype(np.float32)
    found = pixels_to_input(torch.from_numpy(view(frame[None]))[None], 256)[0, 0]
    assert abs(found.numpy()[:, ::8, ::8] - expected).max() <= FLOAT16_ROUNDING


def test_what_inference_has_kept_can_be_trained_with() -> None:
    per_channel.cache_clear()
    with torch.inference_mode():
        pixels_to_input(torch.zeros(1, 1, 8, 8, 3, dtype=torch.uint8), 8)
    assert not any(
        per_channel(kept, torch.device("cpu")).is_inference() for kept in (transforms._MEAN, transforms._STD)
    )


def test_input_goes_back_to_the_image_that_it_is() -> None:
    frames = torch.randint(0, 256, (2, 3, 8, 8, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    assert torch.equal(input_to_pixels(pixels_to_input(frames, 8)).permute(0, 1, 3, 4, 2), frames)


@pytest.mark.parametrize("kind", ["released", "square", "letterbox"])
@pytest.mark.parametrize("size", [(40, 100), (100, 40), (60, 60)])
def test_what_is_seen_goes_back_to_its_place_in_the_frame(kind: transforms.Crop, size: tuple[int, int]) -> None:
    rows, columns = np.linspace(0, 200, size[0]), np.linspace(0, 50, size[1])
    frame = (rows[:, None, None] + columns[None, :, None] + np.zeros(3)).astype(np.uint8)
    back = frame_of_seen(frames_as_seen(view(frame[None], kind), 96)[0], *size, kind)
    box = CropBox(0, 0, *size) if kind == "letterbox" else crop_box(*size, kind)
    inner = (slice(box.top + 2, box.top + box.height - 2), slice(box.left + 2, box.left + box.width - 2))
    assert abs(back[inner].astype(int) - frame[inner]).max() <= 8
    back[box.top : box.top + box.height, box.left : box.left + box.width] = 255
    assert back.shape == frame.shape
    assert (back == 255).all()


ALL = AugmentConfig(crop_scale=(0.3, 0.9), brightness=0.3, contrast=0.3, saturation=0.3)


def clip(seed: int = 0, *, batch: int = 2, time: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (batch, time, 18, 24, 3), dtype=torch.uint8, generator=generator)


def test_a_draw_follows_from_seed_and_position_alone() -> None:
    drawn = [draw(ALL, 180, 243, seed=3, position=position) for position in range(50)]
    assert drawn == [draw(ALL, 180, 243, seed=3, position=position) for position in range(50)]
    assert len(set(drawn)) == 50
    assert drawn != [draw(ALL, 180, 243, seed=4, position=position) for position in range(50)]


def pairs(low: float, high: float) -> st.SearchStrategy[list[float]]:
    return st.tuples(st.floats(low, high), st.floats(low, high)).map(sorted)


@settings(max_examples=150)
@given(st.integers(1, 400), st.integers(1, 400), pairs(0.01, 1.0), pairs(0.1, 9.0), st.integers(0, 2**40))
def test_the_box_lies_inside_the_frame(
    height: int, width: int, scale: list[float], aspect: list[float], position: int
) -> None:
    config = AugmentConfig(crop_scale=tuple(scale), crop_aspect=tuple(aspect))
    drawn = draw(config, height, width, seed=0, position=position)
    assert drawn is not None
    top, left, box_height, box_width = drawn.box
    assert min(top, left) >= 0
    assert min(box_height, box_width) >= 1
    assert top + box_height <= height
    assert left + box_width <= width


def test_boxes_have_the_areas_and_aspects_that_were_asked_for_and_lie_everywhere() -> None:
    boxes = np.array([draw(ALL, 1800, 2430, seed=0, position=position).box for position in range(2000)])  # type: ignore[union-attr]
    top, left, height, width = boxes.T
    share, aspect = height * width / (1800 * 2430), width / height
    assert share.min() == pytest.approx(0.3, abs=0.01)
    assert share.max() == pytest.approx(0.9, abs=0.01)
    assert share.mean() == pytest.approx(0.6, abs=0.02)
    assert aspect.min() == pytest.approx(0.75, abs=0.02)
    assert aspect.max() == pytest.approx(1.35, abs=0.02)
    for start, room in ((top, 1800 - height), (left, 2430 - width)):
        place = start[room > 10] / room[room > 10]
        assert place.mean() == pytest.approx(0.5, abs=0.03)
        assert (place.min(), place.max()) == (pytest.approx(0, abs=0.01), pytest.approx(1, abs=0.01))


def test_an_aspect_that_never_fits_gives_the_nearest_one_with_the_right_area() -> None:
    config = AugmentConfig(crop_scale=(0.64, 0.64), crop_aspect=(1.0, 1.0))
    drawn = draw(config, 100, 400, seed=0, position=0)
    assert drawn is not None
    assert drawn.box[2:] == (100, 256)


def test_factors_fill_their_range_and_are_one_where_it_is_empty() -> None:
    drawn = [draw(AugmentConfig(brightness=0.4), 18, 24, seed=0, position=position) for position in range(500)]
    factors = np.array([[one.brightness, one.contrast, one.saturation] for one in drawn if one is not None])
    assert factors[:, 0].min() == pytest.approx(0.6, abs=0.01)
    assert factors[:, 0].max() == pytest.approx(1.4, abs=0.01)
    assert np.all(factors[:, 1:] == 1.0)
    assert {one.box for one in drawn if one is not None} == {(0, 0, 18, 24)}


def test_a_box_gives_what_the_sliced_pixels_give_and_leaves_the_other_clip_alone() -> None:
    frames = clip()
    found = pixels_to_input(frames, 16, [Augmentation((2, 4, 12, 16)), Augmentation((0, 0, 18, 24))])
    assert torch.equal(found[:1], pixels_to_input(frames[:1, :, 2:14, 4:20], 16))
    assert torch.equal(found[1:], pixels_to_input(frames[1:], 16))


def test_a_colour_becomes_the_same_colour_in_a_bright_frame_and_in_a_dark_one() -> None:
    frames = torch.zeros((1, 2, 16, 16, 3), dtype=torch.uint8)
    frames[0, 0] = 200
    frames[0, :, :, :8] = torch.tensor([100, 80, 60], dtype=torch.uint8)
    found = pixels_to_input(frames, 16, [Augmentation((0, 0, 16, 16), 1.2, 0.7, 1.3)])
    assert torch.equal(found[0, 0, :, :, :8], found[0, 1, :, :, :8])
    assert not torch.equal(found[0, 0], found[0, 1])


def test_a_number_of_augmentations_that_is_not_that_of_the_clips_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="1 augmentations for 2 clips"):
        pixels_to_input(clip(), 16, [Augmentation((0, 0, 18, 24))])


def jitter(value: tuple[float, float, float], **factors: float) -> list[float]:
    pixels = torch.tensor(value).view(1, 3, 1, 1).expand(2, 3, 4, 4)
    found = jittered(pixels, Augmentation((0, 0, 4, 4), **factors))
    assert found.std(dim=(0, 2, 3), unbiased=False).max() == 0
    return [round(float(x), 3) for x in found[0, :, 0, 0]]


GREY = 0.299 * 100 + 0.587 * 200 + 0.114 * 10


@pytest.mark.parametrize(
    ("factors", "expected"),
    [
        ({"brightness": 1.5}, [150, 255, 15]),
        ({"brightness": 0.5}, [50, 100, 5]),
        ({"contrast": 0.0}, [GREY] * 3),  # the mean grey of the clip
        ({"saturation": 0.0}, [GREY] * 3),
    ],
)
def test_each_factor_blends_with_a_plainer_frame_and_clamps(factors: dict[str, float], expected: list[float]) -> None:
    assert jitter((100.0, 200.0, 10.0), **factors) == pytest.approx(expected, abs=1e-3)
