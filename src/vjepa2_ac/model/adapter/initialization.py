"""Initial values of an adapter: drawn from a seed, or computed from the weights that it adapts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Generator, Tensor, nn

# Layers are PEFT's LoraLayer, which is untyped, by their name in the predictor.


def draw_first_matrices(layers: Mapping[str, Any], init: object, generator: Generator) -> None:
    """Draw the first matrix of each layer; the second one is zero, so the output does not change.

    Source: the two distributions are those of PEFT's `init_lora_weights` True and "gaussian".
    """
    for layer in layers.values():
        first = layer.lora_A["default"].weight
        fresh = torch.empty(first.shape)
        if init == "gaussian":
            nn.init.normal_(fresh, std=1 / layer.r["default"], generator=generator)
        else:
            nn.init.kaiming_uniform_(fresh, a=math.sqrt(5), generator=generator)
        first.data.copy_(fresh)


def original_weights(layers: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return copies of the weights of the layers themselves, on the CPU."""
    return {name: layer.get_base_layer().weight.detach().to("cpu", copy=True) for name, layer in layers.items()}


def set_original_weights(layers: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Set the layers' own weights."""
    for name, layer in layers.items():
        layer.get_base_layer().weight.data.copy_(weights[name])


def principal_parts(layers: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return, for each layer, the two matrices of its largest singular values: PiSSA's initial values.

    Source: arXiv 2404.02948, equations 2 and 3.
    """
    parts: dict[str, Tensor] = {}
    for name, layer in layers.items():
        rank, scale = layer.r["default"], layer.scaling["default"]
        weight = layer.get_base_layer().weight.detach().to("cpu", torch.float32)
        left, values, right = torch.linalg.svd(weight, full_matrices=False)
        root = (values[:rank] / scale).sqrt()
        parts[f"{name}.lora_A"] = (root[:, None] * right[:rank]).contiguous()
        parts[f"{name}.lora_B"] = (left[:, :rank] * root).contiguous()
    return parts


def start_from(layers: Mapping[str, Any], original: Mapping[str, Tensor], parts: Mapping[str, Tensor]) -> None:
    """Give each adapter its principal part, and subtract it from the layer's own weight: their sum is the original.

    It is computed on the CPU in float32 on any device: bit-identical wherever a run is resumed. The rest of a bfloat16
    weight is rounded to bfloat16.
    """
    for name, layer in layers.items():
        first, second = parts[f"{name}.lora_A"], parts[f"{name}.lora_B"]
        layer.lora_A["default"].weight.data.copy_(first)
        layer.lora_B["default"].weight.data.copy_(second)
        rest = original[name].float() - layer.scaling["default"] * (second @ first)
        layer.get_base_layer().weight.data.copy_(rest)


def measure_magnitudes(layers: Mapping[str, Any]) -> None:
    """Set DoRA's magnitudes to the current norms of the rows, in float32, as PEFT computes them in each step."""
    for layer in layers.values():
        if "default" in layer.lora_magnitude_vector:
            update = layer.lora_B["default"].weight @ layer.lora_A["default"].weight
            weight = layer.get_base_layer().weight.float() + layer.scaling["default"] * update
            layer.lora_magnitude_vector["default"].weight.data.copy_(torch.linalg.norm(weight.detach(), dim=1))
