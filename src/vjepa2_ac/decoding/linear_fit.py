"""The linear decoder: the image patch of each token by least squares. What it shows is there for the taking."""

from __future__ import annotations

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.windows import spread
from vjepa2_ac.decoding.frame_pairs import FramePairs, as_images
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.episode import Progress

_FRAMES = 4_000  # at most: a matrix of 1,408 x 768 numbers needs no more
_AT_ONCE = 64
_RIDGE = 1e-4  # of the mean variance of a latent's numbers


@torch.no_grad()
def fit_linear(pairs: FramePairs, shape: DecoderShape, device: torch.device, progress: Progress) -> Decoder:
    """Return the linear decoder with the least squared error on the pairs, up to a small ridge.

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
    for first in range(0, len(numbers), _AT_ONCE):
        some = pairs.read(numbers[first : first + _AT_ONCE])
        tokens = some.latents.to(device).flatten(0, 1)
        tokens = torch.cat([tokens, torch.ones_like(tokens[:, :1])], dim=1)
        wanted = decoder.as_numbers(as_images(some.images.to(device)))
        patches = rearrange(
            wanted, "n c (rows p) (columns q) -> (n rows columns) (c p q)", p=shape.patch_size, q=shape.patch_size
        )
        inner += (tokens.T @ tokens).cpu()
        outer += (tokens.T @ patches).cpu()
        progress(min(len(numbers), first + _AT_ONCE), len(numbers))
    ridge = _RIDGE * inner.diagonal()[:-1].mean()
    inner.diagonal()[:-1] += ridge
    solved = torch.linalg.solve(inner, outer).float()
    weight, bias = solved[:-1].T.contiguous(), solved[-1].contiguous()
    decoder.linear.load_state_dict({"weight": weight, "bias": bias})
    return decoder.eval().requires_grad_(False)
