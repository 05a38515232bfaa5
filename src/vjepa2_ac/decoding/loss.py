"""The decoder's loss: absolute difference, structure at three scales, and edges. It needs no other network."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.media.image_similarity import ms_ssim

STRUCTURE, EDGES = 0.2, 0.1  # weights of the second and the third part
SMALLEST = 11  # pixels of an image's side: a window has to fit
_SCALES = 3


def decoder_loss(
    images: Float[Tensor, "frames 3 size size"], targets: Float[Tensor, "frames 3 size size"]
) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """Return L1 + 0.2 (1 - MS-SSIM) + 0.1 L1 of the gradients along both axes; and the parts.

    Args:
        images: What the decoder gives, not clipped.
        targets: What the encoder saw, between 0 and 1.
    """
    scales = sum(images.shape[-1] >= SMALLEST << scale for scale in range(_SCALES))
    absolute = (images - targets).abs().mean()
    structure = 1.0 - ms_ssim(images, targets, scales=scales).mean()
    rows, columns = ((images.diff(dim=axis) - targets.diff(dim=axis)).abs().mean() for axis in (-2, -1))
    edges = rows + columns
    parts = {"l1": absolute, "structure": structure, "edges": edges}
    return absolute + STRUCTURE * structure + EDGES * edges, parts
