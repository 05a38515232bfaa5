"""How does a predictor compute in 8 bits? A copy whose blocks have 8-bit weights and round what they are given.

torchao's home. For inference only: weights have one scale an output, what goes into a layer one a token, found anew
each time. Heads, norms and attention stay as they are.
"""

from __future__ import annotations

import copy
from typing import Any, Literal

import torch

from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_end import merge_adapter
from vjepa2_ac.model.world_model import WorldModel

Kind = Literal["int8", "fp8"]

_FP8_FROM = (8, 9)  # compute capability


def quantized_copy(world_model: WorldModel, kind: Kind, *, where: str) -> WorldModel:
    """Return a model for inference that shares the encoder; an adapter is merged into it. The given one stays as it is.

    Args:
        world_model: On the device that it is to compute on.
        kind: int8, or fp8 (e4m3).
        where: The setting that asks for it.

    Raises:
        InputError: torchao is not installed, or the device does not compute so.
    """
    quantize, config = _torchao(kind, where)
    if kind == "fp8" and not _has_fp8(world_model.device):
        raise InputError(
            where=where,
            found=f"fp8, on {world_model.device.type}",
            needed="a CUDA device of compute capability 8.9 or more (Ada, Hopper or later)",
            fix=f"Set {where}=int8 or off",
        )
    smaller = WorldModel.empty(world_model.sizes)
    smaller.encoder, smaller.predictor = world_model.encoder, copy.deepcopy(world_model.predictor)
    smaller.adaptation, smaller.fresh_heads = world_model.adaptation, world_model.fresh_heads
    if smaller.adaptation is not None:
        merge_adapter(smaller)
    quantize(smaller.base_predictor.blocks, config)
    return smaller.eval()


def _torchao(kind: Kind, where: str) -> tuple[Any, Any]:
    """Return what quantizes, and the way asked for."""
    try:
        from torchao.quantization import (
            Float8DynamicActivationFloat8WeightConfig,
            Int8DynamicActivationInt8WeightConfig,
            PerRow,
            quantize_,
        )
    except ImportError:
        raise InputError(
            where=where,
            found=f"{kind}, but torchao is not installed",
            fix=f'Run pip install -c constraints.txt -e ".[quantize]", or set {where}=off',
        ) from None
    if kind == "int8":
        return quantize_, Int8DynamicActivationInt8WeightConfig()
    return quantize_, Float8DynamicActivationFloat8WeightConfig(granularity=PerRow())


def _has_fp8(device: torch.device) -> bool:
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= _FP8_FROM
