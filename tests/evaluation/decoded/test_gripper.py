"""A probe reads how far two fingers are apart, wherever they are, on images it has not seen."""

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.gripper import fit_gripper_probe

SIZE = 96


def fingers(count: int, seed: int, scale: int = 1) -> tuple[Tensor, np.ndarray, np.ndarray, list[str]]:
    """Return images of two soft red fingers, their middle, their closedness, and ten frames to an episode."""
    drawn = np.random.default_rng(seed)
    centres, closedness = drawn.uniform(20, SIZE - 20, size=(count, 2)), drawn.uniform(0, 1, size=count)
    y, x = np.mgrid[: SIZE * scale, : SIZE * scale] / scale + 0.5 / scale
    images = np.full((count, 3, SIZE * scale, SIZE * scale), 0.4)
    for side in (-1, 1):
        across = x - (centres[:, 0] + side * (1.5 + 3 * (1 - closedness)))[:, None, None]
        images[:, 0] += 0.5 * np.exp(-((across / 1.2) ** 2) - ((y - centres[:, 1, None, None]) / 4) ** 2)
    images += drawn.normal(0, 0.02, images.shape)
    ids = [f"episode {frame // 10}" for frame in range(count)]
    return torch.from_numpy(images).float(), centres * scale, closedness, ids


def test_closedness_is_read_where_the_fingers_are() -> None:
    probe = fit_gripper_probe(*fingers(300, 0))
    images, centres, closedness, _ = fingers(60, 1)
    assert np.abs(probe.read(images, centres) - closedness).mean() < 0.06
    elsewhere = probe.read(images, SIZE - centres)
    assert np.abs(elsewhere - closedness).mean() > 0.15, "there is nothing to be read"
    assert probe.fitted_on == (300, 30)


def test_centres_are_in_pixels_of_the_images_that_are_given() -> None:
    images, centres, closedness, ids = fingers(200, 0, scale=2)
    probe = fit_gripper_probe(images[:150], centres[:150], closedness[:150], ids[:150])
    assert np.abs(probe.read(images[150:], centres[150:]) - closedness[150:]).mean() < 0.08


def test_frames_where_the_fingers_are_behind_the_camera_do_not_count() -> None:
    images, centres, closedness, ids = fingers(120, 2)
    hidden = centres.copy()
    hidden[::3] = np.nan
    some = [place for place in range(120) if place % 3]
    expected = fit_gripper_probe(images[some], centres[some], closedness[some], [ids[place] for place in some])
    found = fit_gripper_probe(images, hidden, closedness, ids)
    np.testing.assert_array_equal(found.read(images, centres), expected.read(images, centres))
    with pytest.raises(InputError, match="needed: two"):
        fit_gripper_probe(images, centres, closedness, ["one"] * 120)
