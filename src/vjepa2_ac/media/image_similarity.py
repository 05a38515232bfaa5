"""Pixel-wise image similarity: PSNR, SSIM and MS-SSIM of whole images or of the moving region.

Images are RGB in 0 .. 1 (data range 1), channels first. The metrics return one value per image, are computed in float32
without autocast, and are differentiable. All these metrics reward blur: an object that is blurred over all its possible
positions scores better than a sharp object that is 12 pixels off. Report the metrics together with the spread of the
predictions, and for the moving region.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Images = Float[Tensor, "*batch 3 height width"]
Pixels = Float[Tensor, "*batch height width"]  # one number per pixel
Mask = Bool[Tensor, "*batch height width"]
PerImage = Float[Tensor, "*batch"]  # one number per image
Channels = Float[Tensor, "*batch channel height width"]

MOVING_THRESHOLD = 8 / 255  # a pixel moves if any channel changes by more than this
DILATION_PX = 8  # dilation of the moving region on each side, in pixels
_SIGMA, _RADIUS = 1.5, 5  # standard deviation and radius of the Gaussian window (11 x 11 pixels)
_C1, _C2 = 0.01**2, 0.03**2  # the constants of luminance and contrast for a data range of 1
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_ROUNDING = 1e-5  # excludes a difference of exactly 8 levels of 255 despite rounding to float32


def psnr(predicted: Images, true: Images, mask: Mask | None = None) -> PerImage:
    """Return the peak signal-to-noise ratio of each image in dB: 10 log10(1 / mean squared error).

    Identical images have infinite PSNR: exclude them from a mean and report their number.

    Args:
        predicted: Images in 0 .. 1.
        true: Images in 0 .. 1.
        mask: The pixels to average over; None: all pixels. The result is NaN for an image with an empty mask.
    """
    squared = (predicted.float() - true.float()).square().mean(dim=-3)
    return -10 * torch.log10(masked_mean(squared, mask))


def ssim(predicted: Images, true: Images) -> PerImage:
    """Return the structural similarity of each image: the mean of `ssim_map`; 1 is identical."""
    return ssim_map(predicted, true).mean(dim=(-2, -1))


def ssim_map(predicted: Images, true: Images) -> Pixels:
    """Return the structural similarity at each pixel, as the mean over R, G and B.

    Average it over a region with `masked_mean`.

    Raises:
        ValueError: A side of the images has fewer than 6 pixels, which is too small for the reflected borders.

    Source: Wang, Bovik, Sheikh, Simoncelli (2004), Image Quality Assessment, equation 13; borders are reflected as in
    torchmetrics 1.9.0, whose values agree to 1e-5.
    """
    return _compute_terms(predicted, true)[0].mean(dim=-3)


def ms_ssim(predicted: Images, true: Images, scales: int) -> PerImage:
    """Return the multi-scale structural similarity of each image, for a loss.

    The result is a product over scales. Each factor is the mean contrast (at the coarsest scale the mean similarity),
    clamped to at least 0 and raised to a weight. The weights are the first `scales` weights of the paper, divided by
    their sum. If a factor is 0, the gradient of the product is 0, so the loss needs another term.

    Args:
        predicted: Images in 0 .. 1, at least 11 pixels high and wide at the coarsest scale.
        true: Images in 0 .. 1 of the same shape.
        scales: Number of scales, 1 to 5; each further scale halves the image.

    Source: Wang, Simoncelli, Bovik (2003), Multiscale structural similarity, equation 7.
    """
    product: Tensor | float = 1.0
    for scale, weight in enumerate(_SCALE_WEIGHTS[:scales]):
        if scale:
            predicted, true = _halve(predicted), _halve(true)
        similarity, contrast = _compute_terms(predicted, true)
        inside = contrast[..., _RADIUS:-_RADIUS, _RADIUS:-_RADIUS]  # pixels whose window has no reflected pixels
        factor = (similarity if scale == scales - 1 else inside).mean(dim=-3).mean(dim=(-2, -1))
        product = product * _power(factor, weight / sum(_SCALE_WEIGHTS[:scales]))
    return torch.as_tensor(product)


def moving_region(true: Float[Tensor, "*batch time 3 height width"]) -> Bool[Tensor, "*batch time-1 height width"]:
    """Return a mask of the pixels that differ from frame 0 by more than 8 levels of 255 in any channel.

    The mask is dilated by 8 pixels in all directions. It depends on the true frames alone.
    """
    later, first = true[..., 1:, :, :, :].float(), true[..., :1, :, :, :].float()
    moved = ((later - first).abs() > MOVING_THRESHOLD + _ROUNDING).any(dim=-3)
    flat = moved.reshape(-1, 1, *moved.shape[-2:]).float()
    dilated = torch.nn.functional.max_pool2d(flat, 2 * DILATION_PX + 1, stride=1, padding=DILATION_PX)
    return (dilated > 0).reshape(moved.shape)


def masked_mean(values: Pixels, mask: Mask | None) -> PerImage:
    """Return the mean over the pixels of a mask, or over all pixels if `mask` is None; NaN for an empty mask."""
    if mask is None:
        return values.mean(dim=(-2, -1))
    return torch.where(mask, values, 0).sum(dim=(-2, -1)) / mask.sum(dim=(-2, -1))


def _compute_terms(predicted: Channels, true: Channels) -> tuple[Channels, Channels]:
    """Return (similarity, contrast) at each pixel of each channel."""
    height, width = predicted.shape[-2:]
    with torch.autocast(predicted.device.type, enabled=False):
        x, y = predicted.float(), true.float()
        rows, columns = (_make_window_matrix(side, predicted.device) for side in (height, width))
        moments = torch.stack([x, y, x * x, y * y, x * y])
        mean_x, mean_y, square_x, square_y, product = rows @ moments @ columns.T
        variances = (square_x - mean_x**2).clamp(min=0) + (square_y - mean_y**2).clamp(min=0)
        covariance = product - mean_x * mean_y
        contrast = (2 * covariance + _C2) / (variances + _C2)
        luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
        return luminance * contrast, contrast


@lru_cache(maxsize=16)
def _make_window_matrix(side: int, device: torch.device) -> Float[Tensor, "side side"]:
    """Return the matrix that smooths a line of pixels with the Gaussian window, reflected at both ends.

    A matrix product is computed in full float32, but a convolution may use TF32, which is too inaccurate for the
    variances. On a CPU the matrix product is also twenty times faster than a convolution of one channel.
    """
    if side <= _RADIUS:
        raise ValueError(f"an image side of {side} px; the window needs more than {_RADIUS}")
    weights = [math.exp(-0.5 * (shift / _SIGMA) ** 2) for shift in range(-_RADIUS, _RADIUS + 1)]
    with torch.inference_mode(False), torch.no_grad():
        matrix = torch.zeros(side, side, dtype=torch.float64)
        for row in range(side):
            for shift, weight in zip(range(-_RADIUS, _RADIUS + 1), weights, strict=True):
                column = abs(row + shift)
                matrix[row, min(column, 2 * (side - 1) - column)] += weight / sum(weights)
        return matrix.to(device, torch.float32)


def _halve(images: Channels) -> Float[Tensor, "*batch channel rows columns"]:
    flat = images.float().reshape(-1, *images.shape[-3:])
    halved = torch.nn.functional.avg_pool2d(flat, 2)
    return halved.reshape(*images.shape[:-2], *halved.shape[-2:])


def _power(factor: PerImage, weight: float) -> PerImage:
    """Return `factor ** weight` for positive factors and 0 for other factors, with finite gradients; NaN stays NaN."""
    is_positive = ~(factor <= 0)
    return torch.where(is_positive, torch.where(is_positive, factor, 1) ** weight, 0)
