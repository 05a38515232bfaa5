"""How well a decoder shows true frames that it has not seen, beside the linear one and the mean image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.windows import spread
from vjepa2_ac.decoding.frame_pairs import FramePairs, as_images
from vjepa2_ac.decoding.network import Decoder
from vjepa2_ac.episode import Progress
from vjepa2_ac.intervals import mean_of
from vjepa2_ac.media.image_similarity import psnr, ssim

_AT_ONCE = 32
_FRAMES_OF_MEAN = 1_000


@torch.no_grad()
def mean_image(pairs: FramePairs) -> Float[Tensor, "3 size size"]:
    """Return the mean of some images, spread over the pairs: what a decoder shows that has learned nothing else."""
    numbers = spread(len(pairs), _FRAMES_OF_MEAN)
    total = sum(
        as_images(pairs.read(numbers[first : first + _AT_ONCE]).images).sum(dim=0)
        for first in range(0, len(numbers), _AT_ONCE)
    )
    return torch.as_tensor(total / len(numbers))


@torch.no_grad()
def measure_decoders(
    pairs: FramePairs, decoders: dict[str, Decoder], mean: Float[Tensor, "3 size size"], progress: Progress
) -> dict[str, Any]:
    """Return PSNR (dB) and SSIM of each decoder and of the mean image, with intervals over episodes, for JSON.

    Args:
        pairs: Held-out frames.
        decoders: By name; on one device.
        mean: Of training frames.
        progress: Called with (done, total) in frames.
    """
    metrics: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"psnr_db": psnr, "ssim": ssim}
    found: dict[str, dict[str, list[np.ndarray]]] = {
        name: {metric: [] for metric in metrics} for name in (*decoders, "mean_image")
    }
    ids: list[str] = []
    device = next(next(iter(decoders.values())).parameters()).device
    for first in range(0, len(pairs), _AT_ONCE):
        some = pairs.read(range(first, min(len(pairs), first + _AT_ONCE)))
        latents, true = some.latents.to(device), as_images(some.images.to(device))
        shown = {name: decoder.decode(latents) for name, decoder in decoders.items()}
        shown["mean_image"] = mean.to(device).expand_as(true)
        for name, images in shown.items():
            for metric, of in metrics.items():
                found[name][metric].append(of(images, true).double().cpu().numpy())
        ids += some.episode_ids
        progress(len(ids), len(pairs))
    return {
        "frames": len(ids),
        "episodes": len(set(ids)),
        **{
            name: {metric: mean_of(np.concatenate(values), ids).as_dict() for metric, values in ofs.items()}
            for name, ofs in found.items()
        },
    }
