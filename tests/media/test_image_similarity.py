"""Image similarity equals recorded values of torchmetrics, is differentiable, and uses only the mask."""

import math

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.media.image_similarity import masked_mean, moving_region, ms_ssim, psnr, ssim, ssim_map

# Size, case of `make_pair`, PSNR, SSIM, and MS-SSIM by number of scales, from torchmetrics 1.9.0 on torch 2.13.0 with
# data_range 1. `betas` were the first default weights divided by their sum.
RECORDED = [
    ((176, 192), 0, 24.952917, 0.9587704539, {1: 0.9587704539, 2: 0.9648514390, 3: 0.9745008349, 5: 0.9764264226}),
    ((176, 192), 1, 19.958574, 0.7451646328, {1: 0.7451646328, 2: 0.8670520186, 3: 0.9164192677, 5: 0.9396925569}),
    ((176, 192), 2, 7.416971, 0.0071898736, {1: 0.0071898736, 2: 0.0104463147, 3: 0.0143351527, 5: 0.0151620889}),
    ((176, 192), 3, 4.948193, -0.4814432263, {1: 0.0, 2: 0.0, 3: 0.0, 5: 0.0}),
    ((97, 64), 0, 24.929602, 0.9578150511, {1: 0.9578150511, 2: 0.9639894962, 3: 0.9740152955}),
    ((97, 64), 1, 20.423635, 0.7375175953, {1: 0.7375175953, 2: 0.8657351732, 3: 0.9162175655}),
]


def make_pair(
    case: int, size: tuple[int, int]
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "3 height width"]]:
    """Return a predicted and a true image; the predicted image is paler, shifted, unrelated, or the negative."""
    rows = torch.arange(size[0], dtype=torch.float64)[:, None]
    columns = torch.arange(size[1], dtype=torch.float64)[None]
    waves = [rows * (0.11 + 0.03 * c) + columns * (0.07 + 0.02 * case) + c for c in range(3)]
    true = torch.stack([0.5 + 0.4 * torch.sin(wave) for wave in waves])
    predictions = [
        true * 0.8 + 0.1,
        torch.roll(true, 3, -1) + 0.05 * torch.cos(rows * columns * 0.37),
        0.5 + 0.45 * torch.cos(rows * 0.9 + columns * 1.3 + torch.arange(3)[:, None, None]),
        1 - true,
    ]
    return predictions[case].clamp(0, 1).float(), true.clamp(0, 1).float()


@pytest.mark.parametrize(("size", "case", "psnr_db", "similarity", "ms_ssim_by_scales"), RECORDED)
def test_values_equal_torchmetrics(
    size: tuple[int, int], case: int, psnr_db: float, similarity: float, ms_ssim_by_scales: dict[int, float]
) -> None:
    predicted, true = make_pair(case, size)
    assert float(psnr(predicted, true)) == pytest.approx(psnr_db, abs=1e-5)
    assert float(ssim(predicted, true)) == pytest.approx(similarity, abs=1e-5)
    for scales, expected in ms_ssim_by_scales.items():
        assert float(ms_ssim(predicted, true, scales)) == pytest.approx(expected, abs=1e-5)


def test_metrics_return_one_value_per_image() -> None:
    pairs = [make_pair(case, (97, 64)) for case in range(4)]
    predicted, true = (torch.stack(images).reshape(2, 2, 3, 97, 64) for images in zip(*pairs, strict=True))
    for measure in (psnr, ssim, ms_ssim_of_3):
        values = measure(predicted, true)
        assert values.shape == (2, 2)
        torch.testing.assert_close(values.flatten(), torch.stack([measure(*pair) for pair in pairs]))


def test_identical_images_have_infinite_psnr_and_similarity_1() -> None:
    image, _ = make_pair(2, (97, 64))
    assert float(psnr(image, image)) == math.inf
    assert float(ssim(image, image)) == pytest.approx(1, abs=1e-6)
    assert float(ms_ssim_of_3(image, image)) == pytest.approx(1, abs=1e-6)


def ms_ssim_of_3(predicted: Tensor, true: Tensor) -> Tensor:
    return ms_ssim(predicted, true, 3)


def test_gradients_are_finite_where_a_factor_is_zero() -> None:
    predicted, true = make_pair(3, (48, 48))
    predicted.requires_grad_()
    (gradient,) = torch.autograd.grad(ms_ssim(predicted, true, 3), predicted)
    assert torch.isfinite(gradient).all()


def test_metrics_are_unchanged_under_autocast() -> None:
    predicted, true = make_pair(1, (48, 48))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        values = [measure(predicted, true) for measure in (psnr, ssim, ms_ssim_of_3)]
    assert values == [measure(predicted, true) for measure in (psnr, ssim, ms_ssim_of_3)]
    assert all(value.dtype == torch.float32 for value in values)


def test_masked_metrics_use_only_pixels_of_the_mask() -> None:
    predicted, true = make_pair(1, (97, 64))
    mask = torch.zeros(97, 64, dtype=torch.bool)
    mask[30:60, 20:40] = True
    expected = psnr(predicted[:, 30:60, 20:40], true[:, 30:60, 20:40])
    torch.testing.assert_close(psnr(predicted, true, mask), expected)
    changed_outside = predicted.clone()
    changed_outside[:, 75:] = 0
    similarities = [masked_mean(ssim_map(image, true), mask) for image in (predicted, changed_outside)]
    torch.testing.assert_close(*similarities)
    assert torch.isnan(psnr(predicted, true, torch.zeros_like(mask)))


def test_moving_region_is_dilated_by_eight_pixels() -> None:
    true = torch.full((3, 3, 40, 40), 100 / 255)
    true[1, 1, 20, 12] += 9 / 255  # a change of one channel is sufficient
    true[1, 2, 20, 30] -= 8 / 255  # a change of exactly 8 levels is not sufficient
    expected = torch.zeros(2, 40, 40, dtype=torch.bool)
    expected[0, 12:29, 4:21] = True
    assert torch.equal(moving_region(true), expected)
    assert torch.equal(moving_region(true.expand(2, 3, 3, 40, 40)), expected.expand(2, 2, 40, 40))
