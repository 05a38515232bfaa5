"""Models with random weights, initialised on the device, for measurements that need no trained weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch

from vjepa2_ac.config import AdapterConfig, ModelSizes
from vjepa2_ac.model.lora import add_adapter, lora_layers
from vjepa2_ac.model.world_model import WorldModel

_ADAPTER_STD = 0.01  # standard deviation of the second matrices of an adapter


def random_model(sizes: ModelSizes, dtype: torch.dtype, device: torch.device | str) -> WorldModel:
    """Return a float32 model on a device whose weights have values that `dtype` can represent, so casting is exact.

    The same sizes and kind of device give the same weights.
    """
    return WorldModel.random(sizes, seed=0, dtype=dtype, device=device).float()


def add_random_adapter(model: WorldModel) -> None:
    """Add a LoRA adapter with nonzero second matrices; otherwise the first matrices would have no gradient."""
    with no_fingerprints():
        add_adapter(model, AdapterConfig(), seed=0)
    generator = torch.Generator(model.device).manual_seed(1)
    for layer in lora_layers(model).values():
        layer.lora_B["default"].weight.data.normal_(std=_ADAPTER_STD, generator=generator)


@contextmanager
def no_fingerprints() -> Iterator[None]:
    """Within the context, skip the SHA-256 of weights, which would take seconds when models are adapted or merged."""
    with mock.patch("vjepa2_ac.model.world_model.fingerprint", return_value="of a benchmark"):
        yield
