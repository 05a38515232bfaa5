"""A probe finds a blob where it is, on images it has not seen."""

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.hand import fit_hand_probe

SIZE = 48


def blobs(count: int, seed: int) -> tuple[Tensor, np.ndarray, list[str]]:
    """Return images of a soft red blob, its position, and ten frames to an episode."""
    drawn = np.random.default_rng(seed)
    positions = drawn.uniform(12, SIZE - 12, size=(count, 2))
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    distance = np.hypot(x - positions[:, 0, None, None], y - positions[:, 1, None, None])
    images = np.full((count, 3, SIZE, SIZE), 0.4)
    images[:, 0] += 0.6 * np.exp(-((distance / 5) ** 2))
    images += drawn.normal(0, 0.02, images.shape)
    return torch.from_numpy(images).float(), positions, [f"episode {frame // 10}" for frame in range(count)]


def test_a_probe_reads_positions_of_images_it_has_not_seen() -> None:
    probe = fit_hand_probe(*blobs(300, 0))
    images, positions, _ = blobs(50, 1)
    off = np.linalg.norm(probe.read(images) - positions, axis=1)
    by_mean = np.linalg.norm(probe.offset.numpy() - positions, axis=1)
    assert off.mean() < 1.5 < by_mean.mean() / 4
    assert probe.fitted_on == (300, 30)
    read = probe.read(images.unflatten(0, (5, 10)))
    assert read.shape == (5, 10, 2)
    np.testing.assert_allclose(read.reshape(-1, 2), probe.read(images))


def test_frames_without_a_hand_do_not_count() -> None:
    images, positions, ids = blobs(120, 2)
    hidden = positions.copy()
    hidden[::3] = np.nan
    some = [place for place in range(120) if place % 3]
    expected = fit_hand_probe(images[some], positions[some], [ids[place] for place in some])
    found = fit_hand_probe(images, hidden, ids)
    np.testing.assert_array_equal(found.read(images), expected.read(images))
    with pytest.raises(InputError, match="needed: two"):
        fit_hand_probe(images, positions, ["one"] * 120)
