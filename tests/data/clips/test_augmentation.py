"""Augmentation: a pure function, inside the frame, and the same for all frames of a clip."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vjepa2_ac.config import AugmentConfig
from vjepa2_ac.data.clips.augmentation import draw, jittered
from vjepa2_ac.data.clips.transforms import pixels_to_input
from vjepa2_ac.episode import Augmentation

ALL = AugmentConfig(crop_scale=(0.3, 0.9), brightness=0.3, contrast=0.3, saturation=0.3)


def clip(seed: int = 0, *, batch: int = 2, time: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (batch, time, 18, 24, 3), dtype=torch.uint8, generator=generator)


def test_nothing_is_drawn_where_nothing_may_change() -> None:
    assert draw(AugmentConfig(), 18, 24, seed=0, position=0) is None


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


def test_an_identity_changes_no_bit() -> None:
    frames = clip()
    whole = Augmentation((0, 0, 18, 24))
    assert torch.equal(pixels_to_input(frames, 16, [whole, whole]), pixels_to_input(frames, 16))


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


def test_brightness_multiplies_and_clamps() -> None:
    assert jitter((100.0, 200.0, 10.0), brightness=1.5) == [150.0, 255.0, 15.0]
    assert jitter((100.0, 200.0, 10.0), brightness=0.5) == [50.0, 100.0, 5.0]


def test_without_contrast_all_is_the_mean_grey_of_the_clip() -> None:
    grey = 0.299 * 100 + 0.587 * 200 + 0.114 * 10
    assert jitter((100.0, 200.0, 10.0), contrast=0.0) == [pytest.approx(grey, abs=1e-3)] * 3


def test_without_saturation_every_pixel_is_grey_and_a_grey_one_never_changes() -> None:
    grey = 0.299 * 100 + 0.587 * 200 + 0.114 * 10
    assert jitter((100.0, 200.0, 10.0), saturation=0.0) == [pytest.approx(grey, abs=1e-3)] * 3
    assert jitter((90.0, 90.0, 90.0), saturation=1.9) == [pytest.approx(90.0, abs=1e-3)] * 3


def test_contrast_spreads_around_the_mean() -> None:
    pixels = torch.tensor([50.0, 150.0]).view(1, 1, 1, 2).expand(1, 3, 1, 2)
    found = jittered(pixels, Augmentation((0, 0, 1, 2), contrast=1.5))
    torch.testing.assert_close(found[0, 0, 0], torch.tensor([25.0, 175.0]))
