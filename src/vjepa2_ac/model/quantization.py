"""8-bit predictor for inference: a copy whose blocks have 8-bit weights and quantize their inputs.

The only module that uses torchao. Weights have one scale per output, a layer's input one per token, computed each time.
Heads, norms and attention are not quantized, and compute in bfloat16: torchao's fp8 accepts no other weights, and a
model that may be rounded to 8 bits does not need float32 around them.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import nn

from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.model.adapter.merging import base_dtype, unadapted_copy
from vjepa2_ac.model.network.world_model import WorldModel

Kind = Literal["int8", "fp8"]

_FP8_FROM = (8, 9)  # compute capability


def quantized_copy(world_model: WorldModel, kind: Kind, *, where: str) -> WorldModel:
    """Return a model for inference that shares the encoder; with the adapter merged. The given one is not changed.

    Args:
        world_model: On the device on which it will compute.
        kind: int8, or fp8 (e4m3).
        where: The setting that requests it.

    Raises:
        InputError: torchao is not installed, the device does not support it, the weights are not bfloat16, or a layer
            cannot be quantized.
    """
    require_8_bits(kind, base_dtype(world_model), world_model.device, where=where)
    quantize, config = _torchao(kind, where)
    smaller = unadapted_copy(world_model)
    quantize(smaller.base_predictor.blocks, config)
    _require_everywhere(smaller.base_predictor.blocks, kind, where)
    return smaller


def require_8_bits(kind: Kind, dtype: torch.dtype, device: torch.device, *, where: str) -> None:
    """Refuse to compute in 8 bits where that is impossible; needs no weights.

    Args:
        kind: int8 or fp8.
        dtype: Of the weights that would be quantized.
        device: The device.
        where: The setting that requests it.

    Raises:
        InputError: Names the unsupported part, and what to set.
    """
    if dtype != torch.bfloat16:
        raise InputError(
            where=where,
            found=f"{kind}, with weights in {str(dtype).removeprefix('torch.')}",
            needed="bfloat16, in which everything computes that is not in 8 bits",
            fix=f"Set model.dtype=bfloat16, or {where}=off",
        )
    _torchao(kind, where)
    if kind == "fp8" and not _has_fp8(device):
        needed = "a CUDA device of compute capability 8.9 or more (Ada, Hopper or later)"
        raise InputError(where=where, found=f"fp8, on {device.type}", needed=needed, fix=f"Set {where}=int8 or off")
    if kind == "int8" and device.type == "cpu" and not has_int8():
        found = "int8, on a CPU without instructions for it (VNNI), where PyTorch's sums overflow"
        raise InputError(where=where, found=found, fix=f"Set {where}=off")


def has_int8() -> bool:
    """Return whether products of 8-bit matrices are right on this CPU."""
    ones = torch.full((32, 32), 127, dtype=torch.int8)
    return int(torch._int_mm(ones, ones)[0, 0]) == 32 * 127**2


def _torchao(kind: Kind, where: str) -> tuple[Any, Any]:
    """Return torchao's quantizer, and its configuration."""
    try:
        from torchao.quantization import (
            Float8DynamicActivationFloat8WeightConfig,
            Int8DynamicActivationInt8WeightConfig,
            PerRow,
            quantize_,
        )
    except ImportError:
        fix = f"Run {pip_install('quantize')}, or set {where}=off"
        raise InputError(where=where, found=f"{kind}, but torchao is not installed", fix=fix) from None
    if kind == "int8":
        return quantize_, Int8DynamicActivationInt8WeightConfig()
    return quantize_, Float8DynamicActivationFloat8WeightConfig(granularity=PerRow())


def _require_everywhere(blocks: nn.Module, kind: Kind, where: str) -> None:
    """Refuse layers that torchao skips silently: fp8 supports multiples of 16 only."""
    for name, layer in blocks.named_modules():
        if isinstance(layer, nn.Linear) and type(layer.weight.data) is torch.Tensor:
            found = f"{kind}, and layer {name} from {layer.in_features} to {layer.out_features}"
            raise InputError(where=where, found=found, needed="multiples of 16", fix=f"Set {where}=off")


def _has_fp8(device: torch.device) -> bool:
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= _FP8_FROM
