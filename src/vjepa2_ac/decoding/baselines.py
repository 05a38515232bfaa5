"""What a decoder is compared with, the linear decoder and the mean image, and how well each shows held-out frames."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.windows import spread
from vjepa2_ac.decoding.frame_pairs import FramePairs
from vjepa2_ac.decoding.network import Decoder, DecoderShape, as_images
from vjepa2_ac.episode import Progress
from vjepa2_ac.intervals import mean_of
from vjepa2_ac.media.image_similarity import psnr, ssim

_FRAMES = 4_000  # at most, of the linear fit: a matrix of 1,408 x 768 numbers needs no more
_FRAMES_OF_MEAN = 1_000
_FITTED_AT_ONCE, _MEASURED_AT_ONCE = 64, 32
_RIDGE = 1e-4  # of the mean variance of a latent's numbers


@torch.no_grad()
def fit_linear(pairs: FramePairs, shape: DecoderShape, device: torch.device, progress: Progress) -> Decoder:
    """Return the linear decoder with the least squared error on the pairs, up to a small ridge.

    What it shows is there for the taking: the image patch of each token is linear in it.

    Args:
        pairs: Frames and their latents.
        shape: Of the decoder beside it; its size is not used.
        device: Where products are computed.
        progress: Called with (done, total) in frames.
    """
    decoder = Decoder(DecoderShape("linear", shape.dim, shape.grid, shape.patch_size))
    numbers = spread(len(pairs), _FRAMES)
    inner: Float[Tensor, "dim+1 dim+1"] = torch.zeros(shape.dim + 1, shape.dim + 1, dtype=torch.float64)
    outer: Float[Tensor, "dim+1 pixels"] = torch.zeros(shape.dim + 1, 3 * shape.patch_size**2, dtype=torch.float64)
    for first in range(0, len(numbers), _FITTED_AT_ONCE):
        some = pairs.read(numbers[first : first + _FITTED_AT_ONCE])
        tokens = some.latents.to(device).flatten(0, 1)
        tokens = torch.cat([tokens, torch.ones_like(tokens[:, :1])], dim=1)
        wanted = decoder.as_numbers(as_images(some.images.to(device)))
        patches = rearrange(
            wanted, "n c (rows p) (columns q) -> (n rows columns) (c p q)", p=shape.patch_size, q=shape.patch_size
        )
        inner += (tokens.T @ tokens).cpu()
        outer += (tokens.T @ patches).cpu()
        progress(min(len(numbers), first + _FITTED_AT_ONCE), len(numbers))
    ridge = _RIDGE * inner.diagonal()[:-1].mean()
    inner.diagonal()[:-1] += ridge
    solved = torch.linalg.solve(inner, outer).float()
    weight, bias = solved[:-1].T.contiguous(), solved[-1].contiguous()
    decoder.linear.load_state_dict({"weight": weight, "bias": bias})
    return decoder.eval().requires_grad_(False)


@torch.no_grad()
def mean_image(pairs: FramePairs) -> Float[Tensor, "3 size size"]:
    """Return the mean of some images, spread over the pairs: what a decoder shows that has learned nothing else."""
    numbers = spread(len(pairs), _FRAMES_OF_MEAN)
    total = sum(
        as_images(pairs.read(numbers[first : first + _MEASURED_AT_ONCE]).images).sum(dim=0)
        for first in range(0, len(numbers), _MEASURED_AT_ONCE)
    )
    return torch.as_tensor(total / len(numbers))


@torch.no_grad()
def measure_decoders(
    pairs: FramePairs, decoders: dict[str, Decoder], mean: Float[Tensor, "3 size size"], progress: Progress
) -> dict[str, Any]:
    """Return PSNR (dB) and SSIM of each decoder and of the mean image, with intervals over episodes, for JSON.

    The PSNR of a frame that is shown exactly is infinite: such frames are no part of its mean, but are counted.

    Args:
        pairs: Held-out frames.
        decoders: By name; on one device.
        mean: Of training frames.
        progress: Called with (done, total) in frames.
    """
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
    ids: list[str] = []
    device = next(next(iter(decoders.values())).parameters()).device
    for first in range(0, len(pairs), _MEASURED_AT_ONCE):
        some = pairs.read(range(first, min(len(pairs), first + _MEASURED_AT_ONCE)))
        latents, true = some.latents.to(device), as_images(some.images.to(device))
        shown = {name: decoder.decode(latents) for name, decoder in decoders.items()}
        shown["mean_image"] = mean.to(device).expand_as(true)
        for name, images in shown.items():
            decibels, similar = (of(images, true).double().cpu().numpy() for of in (psnr, ssim))
            found[name].append((decibels, similar))
        ids += some.episode_ids
        progress(len(ids), len(pairs))
    means: dict[str, Any] = {"frames": len(ids), "episodes": len(set(ids))}
    for name, parts in found.items():
        decibels, similar = np.concatenate(parts, axis=1)
        finite = np.isfinite(decibels)
        means[name] = {
            "psnr_db": mean_of(decibels[finite], np.array(ids)[finite].tolist()).as_dict(),
            "ssim": mean_of(similar, ids).as_dict(),
            "exact_frames": int((~finite).sum()),
        }
    return means
