"""Storage types of latents and their precision: bfloat16, float32, or int8 with scales."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.episode import StoredLatents

CacheType = Literal["bf16", "fp32", "int8"]

DTYPES: dict[CacheType, torch.dtype] = {"bf16": torch.bfloat16, "fp32": torch.float32, "int8": torch.int8}
_LARGEST = 127


def pack_latents(latents: Float[Tensor, "*batch tokens dim"], kind: CacheType) -> StoredLatents:
    """Return latents in their storage type.

    bf16 rounds to nearest: the error is at most 2**-8 of the value. int8 divides each token by its largest value over
    127, its scale: the error is at most half a scale. fp32 is exact.
    """
    if kind != "int8":
        return StoredLatents(latents.to(DTYPES[kind]))
    latents = latents.float()
    scales = latents.abs().amax(dim=-1) / _LARGEST
    divisor = torch.where(scales > 0, scales, torch.ones_like(scales))  # a token of zeros stays one
    values = (latents / divisor[..., None]).round().clamp(-_LARGEST, _LARGEST)
    return StoredLatents(values.to(torch.int8), scales)


def unpack_latents(stored: StoredLatents) -> Float[Tensor, "*batch tokens dim"]:
    """Return stored latents as float32: the encoder's output up to the rounding of `pack_latents`."""
    values = stored.values.float()
    return values if stored.scales is None else values * stored.scales[..., None]


def bytes_per_frame(tokens: int, dim: int, kind: CacheType) -> int:
    """Return the size of a frame's latents."""
    return tokens * dim * DTYPES[kind].itemsize + (tokens * 4 if kind == "int8" else 0)
