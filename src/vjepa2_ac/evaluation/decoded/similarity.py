"""How alike decoded images are to the truth and to the decoded truth: a number per clip, horizon, metric and region.

Two references: the *truth* is what a user sees, the *decoded truth* (the same decoder on the true latents) tells what
the model did. PSNR, SSIM and MS-SSIM all reward blur: an object that is smeared over every place where it may be scores
better than a sharp one in the wrong place. They are therefore given inside the moving region, too, and beside `spread`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vjepa2_ac.evaluation.decoded.record import Region, Similarity
from vjepa2_ac.media.image_similarity import mean_where, psnr, ssim_map

_WINDOW = 11  # pixels, which fit into the coarsest scale
_SCALES_OF_LARGE, _SCALES_OF_SMALL, _LARGE = 5, 3, 176


def scales_for(side: int) -> int:
    """Return the scales of MS-SSIM for images of this side: 5, of small ones 3 or what fits; 0: none does."""
    most = _SCALES_OF_LARGE if side >= _LARGE else _SCALES_OF_SMALL
    return sum(side >> scale >= _WINDOW for scale in range(most))


def similarities(
    shown: Float[Tensor, "batch horizon 3 size size"],
    true: Float[Tensor, "batch horizon 3 size size"],
    moving: Bool[Tensor, "batch horizon size size"] | None,
) -> dict[tuple[Region, Similarity], Float[np.ndarray, "batch horizon"]]:
    """Return every similarity, of whole images and of the moving region.

    PSNR of identical images is infinite; where nothing moves, the region's values are NaN. Images of fewer
    than 11 pixels a side have PSNR alone.

    Args:
        shown: Images in 0 .. 1.
        true: Likewise.
        moving: The region; None: it is not known.
    """
    regions: dict[Region, Tensor | None] = {"whole": None}
    if moving is not None:
        regions["moving"] = moving
    found: dict[tuple[Region, Similarity], Tensor] = {
        (region, "psnr_db"): psnr(shown, true, where) for region, where in regions.items()
    }
    scales = scales_for(shown.shape[-1])
    if scales:
        similar = ssim_map(shown, true)
        found |= {(region, "ssim"): mean_where(similar, where) for region, where in regions.items()}
    return {key: one.double().cpu().numpy() for key, one in found.items()}


def cycle_error(
    again: Float[Tensor, "batch horizon tokens dim"], latents: Float[Tensor, "batch horizon tokens dim"]
) -> Float[np.ndarray, "batch horizon"]:
    """Return the L1 distance of the latents of decoded images to the latents that they were decoded from.

    Far larger than that of true latents: the image does not show what the prediction holds.
    """
    with torch.autocast(latents.device.type, enabled=False):
        error = (again.float() - latents.float()).abs().mean(dim=(-2, -1))
    return np.asarray(error.double().cpu().numpy())
