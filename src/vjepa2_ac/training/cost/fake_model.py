"""Fake models: the predictor of a run with what it trains, without numbers, memory or weights.

The layers are those that train. Plain LoRA is built here from the product that it trains with, because PEFT and
transformers take several seconds to import; DoRA and heads that are trained whole are PEFT's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.functional import layer_norm, scaled_dot_product_attention

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.adapter.low_rank import LowRankLayer, low_rank_linear
from vjepa2_ac.model.adapter.targets import adapter_ranks
from vjepa2_ac.model.network.dynamics import LatentDynamics
from vjepa2_ac.model.network.predictor_network import PredictorNetwork, predictor_fields
from vjepa2_ac.model.network.rotary import rotary_tables

Kind = Literal["cpu", "cuda"]


class FakeModel(LatentDynamics):
    """The predictor of a run on fake tensors, in training mode; only within `fake_tensors`.

    For CUDA three things are taken as they are there: autocast computes norms from a float32 copy where weights have
    another type than the arithmetic, a dropout mask takes one byte, and `auto` attention is one operation
    (FlexAttention) that keeps no scores.

    Args:
        config: The run.
        sizes: Of its model.
        predictor: What `meta_predictor` returned for both, outside of `fake_tensors`; its weights are replaced.
        device: The device type whose rules for saved tensors apply.
    """

    def __init__(self, config: Config, sizes: ModelSizes, predictor: nn.Module, device: Kind) -> None:
        super().__init__()
        self.sizes, self.predictor = sizes, predictor
        frozen = torch.bfloat16 if config.model.dtype == "bfloat16" else torch.float32
        for part in self.predictor.modules():
            for name, old in part.named_parameters(recurse=False):
                is_float = old.requires_grad or config.adapter.kind == "none"
                new = torch.empty(old.shape, dtype=torch.float32 if is_float else frozen, device="cpu")
                part.register_parameter(name, nn.Parameter(new, old.requires_grad))
            if device == "cuda":
                part.__class__ = _ON_CUDA.get(type(part), type(part))
        kind = config.training.attention
        self.set_attention(_flash if device == "cuda" and kind in {"auto", "flex"} else kind)
        self.after_prediction: Callable[[Tensor], None] | None = None

    def predict(self, *given: Any, **named: Any) -> Tensor:
        """Predict, and tell who watches of the result."""
        predicted = super().predict(*given, **named)
        if self.after_prediction:
            self.after_prediction(predicted)
        return predicted

    def batch(self, clips: int, frames: int) -> LatentBatch:
        """Return so many clips of latents."""
        sizes = self.sizes
        latents = torch.empty(clips, frames, sizes.tokens_per_frame, sizes.encoder.width)
        states = torch.empty(clips, frames, sizes.predictor.state_dim)
        actions = torch.empty(clips, frames - 1, sizes.predictor.action_dim)
        extrinsics = torch.empty(clips, frames, 6) if sizes.predictor.use_extrinsics else None
        return LatentBatch(latents, states, actions, extrinsics, ("",) * clips, (0,) * clips)


@contextmanager
def fake_tensors() -> Iterator[None]:
    """Let tensors have shapes and types only; tables that are cached between calls do not get in or out."""
    rotary_tables.cache_clear()
    try:
        with FakeTensorMode():
            yield
    finally:
        rotary_tables.cache_clear()


def meta_network(sizes: ModelSizes) -> PredictorNetwork:
    """Return the network of a predictor on the meta device, in float32."""
    network = PredictorNetwork()
    network.config = SimpleNamespace(**predictor_fields(sizes))
    with torch.device("meta"):
        network.add_layers(network.config)
    return network


def meta_predictor(config: Config, sizes: ModelSizes) -> nn.Module:
    """Return the predictor with what a run trains, on the meta device, in float32; the rest is frozen.

    Raises:
        InputError: A knob of the adapter does not fit the predictor.
    """
    predictor, adapter = meta_network(sizes), config.adapter
    if adapter.kind == "none":
        for name in predictor.unused_layers:
            predictor.get_submodule(name).requires_grad_(False)
        return predictor
    predictor.requires_grad_(False)
    with torch.device("meta"):
        if adapter.dora or adapter.modules_to_save or adapter.peft:
            from vjepa2_ac.model.adapter.lora import with_adapter

            return with_adapter(predictor, adapter)
        for name, rank in adapter_ranks(predictor, adapter).items():
            layer: Any = predictor.get_submodule(name)
            predictor.set_submodule(name, _PlainLora(layer, rank, adapter.dropout))
    return predictor


class _PlainLora(LowRankLayer, nn.Module):
    """What `LoraLinear` computes of plain LoRA, without PEFT."""

    def __init__(self, layer: nn.Linear, rank: int, dropout: float) -> None:
        super().__init__()
        self.layer, self.dropout = layer, nn.Dropout(dropout) if dropout else None
        self.first = nn.Parameter(torch.empty(rank, layer.in_features))
        self.second = nn.Parameter(torch.empty(layer.out_features, rank))

    def forward(self, tokens: Float[Tensor, "*batch inputs"]) -> Tensor:
        """Return the output of the layer and its adapter for each token."""
        under_autocast = torch.is_autocast_enabled("cpu")
        dtype = torch.get_autocast_dtype("cpu") if under_autocast else tokens.dtype
        return low_rank_linear(tokens.to(dtype), self.layer, self, self.dropout, scale=1.0)

    @property
    def weight(self) -> Tensor:
        """The frozen layer's."""
        return self.layer.weight

    def matrices(self) -> tuple[Tensor, ...]:
        """Return the two matrices."""
        return self.first, self.second


class _CudaNorm(nn.LayerNorm):
    def forward(self, tokens: Tensor) -> Tensor:
        if not torch.is_autocast_enabled("cpu"):
            return super().forward(tokens)
        return layer_norm(tokens.float(), self.normalized_shape, self.weight.float(), self.bias.float(), self.eps)


class _CudaDropout(nn.Dropout):
    def forward(self, tokens: Tensor) -> Tensor:
        return torch.native_dropout(tokens, self.p, self.training)[0]


_ON_CUDA: dict[type[nn.Module], type[nn.Module]] = {nn.LayerNorm: _CudaNorm, nn.Dropout: _CudaDropout}


def _flash(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:  # noqa: ARG001
    return scaled_dot_product_attention(query, key, value)
