"""How alike are two images, pixel by pixel: PSNR and SSIM, of whole images or of where something moves.

Images are RGB in 0 .. 1 (data range 1), channels first; every function returns one value per image, in float32 and
without autocast, and can be differentiated. All reward blur: an object smeared over every place where it may be scores
better than a sharp one 12 pixels off. State them together with the spread of the predictions, and inside the moving
region.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Images = Float[Tensor, "*batch 3 height width"]
Pixels = Float[Tensor, "*batch height width"]  # a number for each
Where = Bool[Tensor, "*batch height width"]
OfEach = Float[Tensor, "*batch"]  # a number for each image
Channels = Float[Tensor, "*batch channel height width"]

MOVES_BY = 8 / 255  # in any channel
DILATED_BY = 8  # pixels
_SIGMA, _RADIUS = 1.5, 5  # of the Gaussian window, 11 x 11
_OF_LUMINANCE, _OF_CONTRAST = 0.01**2, 0.03**2  # the constants C1 and C2 for a data range of 1
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_ROUNDING = 1e-5  # so that a difference of exactly 8 levels of 255 does not count, whatever float32 makes of it


def psnr(predicted: Images, true: Images, where: Where | None = None) -> OfEach:
    """Return the peak signal-to-noise ratio of each image in dB: 10 log10(1 / mean squared error).

    Identical images have infinity: leave them out of a mean and say how many there were.

    Args:
        predicted: Images in 0 .. 1.
        true: Likewise.
        where: The pixels that count; None: all. An image without any has NaN.
    """
    squared = (predicted.float() - true.float()).square().mean(dim=-3)
    return -10 * torch.log10(mean_where(squared, where))


def ssim(predicted: Images, true: Images) -> OfEach:
    """Return the structural similarity of each image: the mean of `ssim_map`; 1 is identical."""
    return ssim_map(predicted, true).mean(dim=(-2, -1))


def ssim_map(predicted: Images, true: Images) -> Pixels:
    """Return the structural similarity at each pixel, as the mean over R, G and B.

    Average it over a region with `mean_where`.

    Raises:
        ValueError: Images of fewer than 6 pixels a side cannot be reflected at their borders.

    Source: Wang, Bovik, Sheikh, Simoncelli (2004), Image Quality Assessment, equation 13; borders are reflected, as in
    torchmetrics 1.9.0, whose values it equals to 1e-5.
    """
    return _terms(predicted, true)[0].mean(dim=-3)


def ms_ssim(predicted: Images, true: Images, scales: int) -> OfEach:
    """Return the multi-scale structural similarity of each image, for a loss.

    It is the product over scales of mean contrast (of the coarsest one: of mean similarity) to the power of a weight,
    each at least 0. The weights are the first `scales` of the paper's five, divided by their sum. Where a factor is 0,
    the gradient of the whole is 0: put a pixel loss beside it.

    Args:
        predicted: Images in 0 .. 1, of at least 11 pixels a side at the coarsest scale.
        true: Likewise.
        scales: 1 to 5; each halves the image.

    Source: Wang, Simoncelli, Bovik (2003), Multiscale structural similarity, equation 7.
    """
    product: Tensor | float = 1.0
    for scale, weight in enumerate(_SCALE_WEIGHTS[:scales]):
        if scale:
            predicted, true = _halved(predicted), _halved(true)
        similarity, contrast = _terms(predicted, true)
        inside = contrast[..., _RADIUS:-_RADIUS, _RADIUS:-_RADIUS]  # where the window sees no reflection
        factor = (similarity if scale == scales - 1 else inside).mean(dim=-3).mean(dim=(-2, -1))
        product = product * _power(factor, weight / sum(_SCALE_WEIGHTS[:scales]))
    return torch.as_tensor(product)


def moving_region(true: Float[Tensor, "*batch time 3 height width"]) -> Bool[Tensor, "*batch time-1 height width"]:
    """Return where each later frame differs from frame 0 by more than 8 levels of 255 in any channel.

    Every such pixel is dilated to the square of 8 pixels around it. It depends on the true frames alone; its mean is
    its share of the pixels.
    """
    later, first = true[..., 1:, :, :, :].float(), true[..., :1, :, :, :].float()
    moved = ((later - first).abs() > MOVES_BY + _ROUNDING).any(dim=-3)
    flat = moved.reshape(-1, 1, *moved.shape[-2:]).float()
    dilated = torch.nn.functional.max_pool2d(flat, 2 * DILATED_BY + 1, stride=1, padding=DILATED_BY)
    return (dilated > 0).reshape(moved.shape)


def mean_where(values: Pixels, where: Where | None) -> OfEach:
    """Return the mean over the pixels that count, all of them if `where` is None; NaN where none does."""
    if where is None:
        return values.mean(dim=(-2, -1))
    return torch.where(where, values, 0).sum(dim=(-2, -1)) / where.sum(dim=(-2, -1))


def _terms(predicted: Channels, true: Channels) -> tuple[Channels, Channels]:
    """Return similarity and contrast at each pixel, for each channel."""
    height, width = predicted.shape[-2:]
    with torch.autocast(predicted.device.type, enabled=False):
        one, other = predicted.float(), true.float()
        down, across = (_window(side, predicted.device) for side in (height, width))
        parts = torch.stack([one, other, one * one, other * other, one * other])
        mean, other_mean, square, other_square, product = down @ parts @ across.T
        variances = (square - mean**2).clamp(min=0) + (other_square - other_mean**2).clamp(min=0)
        covariance = product - mean * other_mean
        contrast = (2 * covariance + _OF_CONTRAST) / (variances + _OF_CONTRAST)
        luminance = (2 * mean * other_mean + _OF_LUMINANCE) / (mean**2 + other_mean**2 + _OF_LUMINANCE)
        return luminance * contrast, contrast


@lru_cache(maxsize=16)
def _window(side: int, device: torch.device) -> Float[Tensor, "side side"]:
    """Return the matrix that smooths a line of pixels with the Gaussian window, reflected at both ends.

    A product with it is exact (a convolution may compute in TF32, in which variances are differences of rounded
    numbers) and on a CPU twenty times faster than a convolution of one channel.
    """
    if side <= _RADIUS:
        raise ValueError(f"an image side of {side} px; the window needs more than {_RADIUS}")
    weights = [math.exp(-0.5 * (shift / _SIGMA) ** 2) for shift in range(-_RADIUS, _RADIUS + 1)]
    with torch.inference_mode(False), torch.no_grad():
        matrix = torch.zeros(side, side, dtype=torch.float64)
        for place in range(side):
            for shift, weight in zip(range(-_RADIUS, _RADIUS + 1), weights, strict=True):
                seen = abs(place + shift)
                matrix[place, min(seen, 2 * (side - 1) - seen)] += weight / sum(weights)
        return matrix.to(device, torch.float32)


def _halved(images: Channels) -> Float[Tensor, "*batch channel rows columns"]:
    flat = images.float().reshape(-1, *images.shape[-3:])
    halved = torch.nn.functional.avg_pool2d(flat, 2)
    return halved.reshape(*images.shape[:-2], *halved.shape[-2:])


def _power(factor: OfEach, weight: float) -> OfEach:
    """Return the power of what is above 0, else 0, with a finite gradient in either case; of NaN NaN."""
    positive = ~(factor <= 0)
    return torch.where(positive, torch.where(positive, factor, 1) ** weight, 0)
