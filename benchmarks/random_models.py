"""Models with random weights, initialised on the device, for measurements that need no trained weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch

from vjepa2_ac.config import AdapterConfig, ModelSizes
from vjepa2_ac.model.lora import add_adapter, lora_layers
from vjepa2_ac.model.world_model import WorldModel

_OF_AN_ADAPTER = 0.01  # standard deviation of its second matrices


def random_model(sizes: ModelSizes, dtype: torch.dtype, device: torch.device | str) -> WorldModel:
    """Return a float32 model on a device; its weights have values that `dtype` can hold, too, so casting changes none.

    The same for the same sizes and kind of device.
    """
    return WorldModel.random(sizes, seed=0, dtype=dtype, device=device).float()


def add_random_adapter(model: WorldModel) -> None:
    """Adapt a model by a LoRA that is not zero: at zero its first matrices have no gradient."""
    with no_fingerprints():
        add_adapter(model, AdapterConfig(), seed=0)
    generator = torch.Generator(model.device).manual_seed(1)
    for layer in lora_layers(model).values():
        layer.lora_B["default"].weight.data.normal_(std=_OF_AN_ADAPTER, generator=generator)


@contextmanager
def no_fingerprints() -> Iterator[None]:
    """Let models be adapted, merged and cached without the SHA-256 of their weights: seconds that nobody asked for."""
    with mock.patch("vjepa2_ac.model.world_model.fingerprint", return_value="of a benchmark"):
        yield
