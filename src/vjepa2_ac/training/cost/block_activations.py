"""Activation memory of one layer or block of the predictor, counted operation by operation, in bytes.

Only what a gradient needs is saved. A frozen linear layer saves nothing of its input; its adapter, or a weight that is
trained whole, saves it, in the arithmetic's type, and an adapter its own two matrices, cast. A norm saves its input and
two statistics a token, attention saves query, key, value, output and a log-sum-exp a head, GELU its input, dropout its
mask. DoRA, as PEFT computes it, saves two outputs of each layer, and with dropout a copy of the weights.

Devices differ in two of these. Where weights have another type than the arithmetic, CUDA's autocast computes norms from
a float32 copy and saves that, while the CPU's leaves the input unchanged; and CUDA saves a mask of one byte, the CPU
one of the masked tensor's type.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.training.cost.parameters import CONDITIONS, Layer, adapter_ranks, linear_layers

Kind = Literal["cpu", "cuda"]

FLOAT32 = 4
HALF = 2  # bfloat16 and float16

_QKV = ("attn.q", "attn.k", "attn.v")


@dataclass(frozen=True)
class Setting:
    """The sizes of a run's tensors, their types, and the trained layers."""

    config: Config
    sizes: ModelSizes
    device: Kind

    @property
    def number(self) -> int:
        """Bytes of a number in the networks' arithmetic."""
        return FLOAT32 if self.config.training.precision == "fp32" else HALF

    @property
    def norm_number(self) -> int:
        """Bytes of a number that a norm saves."""
        return FLOAT32 if self.copies_for_norms else self.number

    @property
    def copies_for_norms(self) -> bool:
        """Whether autocast has norms computed from a copy of their input."""
        other = self.casts_frozen_weights or self.trains_everything
        return self.device == "cuda" and self.number != FLOAT32 and other

    @property
    def mask(self) -> int:
        """Bytes of an element of a dropout mask."""
        if not self.config.adapter.dropout:
            return 0
        if self.device == "cuda":
            return 1
        return self.number if self.is_plain else FLOAT32

    @property
    def trains_everything(self) -> bool:
        """Whether there is no adapter."""
        return self.config.adapter.kind == "none"

    @property
    def is_plain(self) -> bool:
        """Whether adapters compute in the arithmetic's type (`adapter.lora_linear`); else PEFT casts to float32."""
        return not self.config.adapter.dora

    def trains_whole(self, name: str) -> bool:
        """Return whether a layer's own weight is trained."""
        return self.trains_everything or name in self.config.adapter.modules_to_save

    @property
    def casts_frozen_weights(self) -> bool:
        """Whether autocast makes a copy of a frozen weight in every pass."""
        same = self.config.training.precision == "bf16" and self.config.model.dtype == "bfloat16"
        return not self.trains_everything and self.number != FLOAT32 and not same

    @property
    def shares_inputs(self) -> bool:
        """Whether layers that read one tensor save it once: nothing is masked, and nothing is cast for each."""
        if self.trains_everything:
            return True
        return not self.config.adapter.dropout and (self.is_plain or self.number == FLOAT32)

    @cached_property
    def ranks(self) -> dict[str, int]:
        """Layers with an adapter, and its rank."""
        return adapter_ranks(self.config, self.sizes)

    @cached_property
    def layers(self) -> dict[str, Layer]:
        """All linear layers."""
        return linear_layers(self.sizes)

    @property
    def width(self) -> int:
        """Width of a token."""
        return self.sizes.predictor.width

    def patches(self, steps: int) -> int:
        """Return the patches of so many steps of a micro-batch."""
        return self.config.training.batch_size * steps * (self.sizes.image_size // self.sizes.patch_size) ** 2

    def tokens(self, steps: int) -> int:
        """Return the tokens of so many steps of a micro-batch."""
        conditions = CONDITIONS + self.sizes.predictor.use_extrinsics
        return self.patches(steps) + self.config.training.batch_size * steps * conditions


def block_bytes(setting: Setting, index: int, steps: int, past: int = 0, *, reached: bool = True) -> int:
    """Return what one block saves, without its weights.

    Args:
        setting: The run.
        index: Which block, from 0.
        steps: Steps that it computes.
        past: Earlier steps whose keys and values it receives.
        reached: Whether gradients flow further back than this block.
    """
    tokens, width, number = setting.tokens(steps), setting.width, setting.number
    trained = {name for name in (*_QKV, "attn.o", "mlp.fc1") if _is_trained(setting, f"blocks.{index}.{name}")}
    attends = reached or bool(trained & set(_QKV))  # gradients are needed from here on
    adds = attends or "attn.o" in trained
    activates = adds or "mlp.fc1" in trained
    norm = tokens * (width * setting.norm_number + 2 * setting.norm_number)
    kept = reached * norm + adds * norm
    if attends:
        kept += tokens * (2 * width * number + setting.sizes.predictor.heads * FLOAT32)  # query, output, log-sum-exp
        kept += 2 * setting.tokens(past + steps) * width * number
    kept += activates * tokens * setting.layers[f"blocks.{index}.mlp.fc1"].outputs * number
    for name, needed in [*((name, reached) for name in _QKV), ("attn.o", attends), ("mlp.fc1", adds)]:
        kept += layer_bytes(setting, f"blocks.{index}.{name}", tokens, reached=needed)
    kept += layer_bytes(setting, f"blocks.{index}.mlp.fc2", tokens, reached=activates)
    return kept - _shared(setting, tokens, steps, trained)


def layer_bytes(setting: Setting, name: str, tokens: int, *, reached: bool) -> int:
    """Return what a linear layer and its adapter save for so many tokens: input, mask, the tensor between A and B.

    Args:
        setting: The run.
        name: The layer.
        tokens: The number of tokens.
        reached: Whether gradients flow further back than this layer.
    """
    layer, number = setting.layers[name], setting.number
    if setting.trains_whole(name):
        return tokens * layer.inputs * number
    kept = layer.weight * number if reached and setting.casts_frozen_weights else 0
    rank = setting.ranks.get(name)
    if rank is None:
        return kept
    kept += tokens * (layer.inputs * (number + reached * setting.mask) + rank * number)
    if setting.is_plain:
        kept += _casts(setting, layer, rank)
    return kept + (_dora(setting, layer, tokens, reached=reached) if setting.config.adapter.dora else 0)


def adapter_casts(setting: Setting, name: str) -> int:
    """Return the bytes of a layer's trained matrices that autocast casts: once for all passes."""
    layer = setting.layers[name]
    if setting.trains_whole(name):
        return 0 if setting.number == FLOAT32 else layer.weight * setting.number
    return 0 if setting.is_plain else _casts(setting, layer, setting.ranks.get(name, 0))


def _casts(setting: Setting, layer: Layer, rank: int) -> int:
    return 0 if setting.number == FLOAT32 else rank * (layer.inputs + layer.outputs) * setting.number


def _dora(setting: Setting, layer: Layer, tokens: int, *, reached: bool) -> int:
    """Return what DoRA costs beside LoRA: two outputs, three vectors, and weights where the input is masked."""
    dropout = bool(setting.config.adapter.dropout)
    base_number = setting.number if dropout or setting.config.model.dtype == "bfloat16" else FLOAT32  # minus the bias
    kept = tokens * layer.outputs * (base_number + setting.number) + 3 * layer.outputs * FLOAT32
    copied = dropout and reached and setting.number != FLOAT32
    return kept + (layer.weight * setting.number if copied else 0)


def _shared(setting: Setting, tokens: int, steps: int, trained: set[str]) -> int:
    """Return what was counted more than once: tensors that several operations save."""
    if not setting.shares_inputs:
        return 0
    twice = max(0, len(trained & set(_QKV)) - 1)  # they read one tensor
    if steps == 1 and "attn.o" in trained:  # of a single step, attention's output is what o reads
        twice += 1
    return twice * tokens * setting.width * setting.number


def _is_trained(setting: Setting, name: str) -> bool:
    return setting.trains_everything or name in setting.ranks
