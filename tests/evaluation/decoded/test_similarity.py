"""Similarities: which there are, of which images, and how the cycle error is averaged."""

import numpy as np
import pytest
import torch

from vjepa2_ac.evaluation.decoded.record import REGIONS, SIMILARITIES
from vjepa2_ac.evaluation.decoded.similarity import cycle_error, scales_for, similarities


@pytest.mark.parametrize(("side", "scales"), [(256, 5), (176, 5), (96, 3), (44, 3), (32, 2), (11, 1), (10, 0)])
def test_small_images_have_fewer_scales(side: int, scales: int) -> None:
    assert scales_for(side) == scales


METRICS = [metric for metric in SIMILARITIES if metric != "ms_ssim"]


def test_every_similarity_is_of_both_regions_and_a_change_elsewhere_does_not_count() -> None:
    true = torch.rand(2, 3, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    moving = torch.zeros(2, 3, 48, 48, dtype=torch.bool)
    moving[..., 10:20, 10:20] = True
    shown = true.clone()
    shown[..., 40:, 40:] = 0.0
    found = similarities(shown, true, moving)
    assert set(found) == {(region, metric) for region in REGIONS for metric in METRICS}
    assert np.isinf(found["moving", "psnr_db"]).all()
    np.testing.assert_allclose(found["moving", "ssim"], 1.0, atol=1e-6)
    assert (found["whole", "ssim"] < 0.99).all()
    assert set(similarities(shown, true, None)) == {("whole", metric) for metric in METRICS}
    assert set(similarities(shown[..., :8, :8], true[..., :8, :8], None)) == {("whole", "psnr_db")}


def test_a_cycle_error_is_the_mean_over_tokens_and_numbers() -> None:
    latents = torch.zeros(2, 3, 4, 5)
    again = latents.clone()
    again[1, 2, 0] = 2.0
    expected = np.zeros((2, 3))
    expected[1, 2] = 0.5
    np.testing.assert_allclose(cycle_error(again, latents), expected)
