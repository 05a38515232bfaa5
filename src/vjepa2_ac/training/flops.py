"""Model FLOPs of one clip or one frame, by formula.

PyTorch's counter returns the same numbers on fake tensors, but takes seconds at the start of every run. Only operations
that the mathematics requires are counted, each once. A matrix product has two operations per multiplied pair of
numbers. Counted are the forward pass, the backward pass with respect to inputs where a gradient has to pass, and the
backward pass with respect to trained weights. Not counted are recomputation (gradient checkpointing, the scores in the
backward pass of fused attention), operations other than matrix products (norms, activations, rotations), and the norms
of weights that DoRA needs. Attention is block-causal: a token of step t attends to the tokens of steps up to t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int64
from torch import nn

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.model.predictor import new_predictor
from vjepa2_ac.training.cost import meta_predictor


@dataclass(frozen=True)
class ClipFlops:
    """Floating-point operations of training on one clip."""

    encoder: int  # forward pass of the frozen encoder on all frames
    forward: int  # forward passes of the predictor: teacher forcing, and the further predictions of the rollout
    backward: int  # backward passes of the predictor

    @property
    def predictor(self) -> int:
        """The operations without the encoder, which is not needed with cached latents."""
        return self.forward + self.backward

    @property
    def total(self) -> int:
        """The operations of encoder and predictor."""
        return self.encoder + self.predictor


def clip_flops(config: Config, sizes: ModelSizes) -> ClipFlops:
    """Return the operations of training on one clip.

    Args:
        config: The config of the run; used are the adapter, the frames per clip and the rollout steps.
        sizes: The sizes of the model, for example from `model.checkpoints.base_sizes`.
    """
    passes, frames = _Passes(sizes, config), config.data.frames
    total = passes.over(frames - 1, keys=range(1, frames), fed_back=False)
    for step in range(2, 1 + config.training.rollout_steps):  # earlier keys and values are cached
        total += passes.over(1, keys=range(step, step + 1), fed_back=True)
    return ClipFlops(frames * frame_flops(sizes), *total.tolist())


def frame_flops(sizes: ModelSizes) -> int:
    """Return the operations of encoding one frame."""
    encoder = sizes.encoder
    tokens, width, hidden = sizes.tokens_per_frame, encoder.width, int(encoder.width * encoder.mlp_ratio)
    embedding = 2 * tokens * 3 * sizes.patch_size**2 * width  # one frame: the two of a tubelet are the same image
    linear = 2 * tokens * (4 * width**2 + 2 * width * hidden)
    return embedding + encoder.depth * (linear + 4 * tokens**2 * width)


_Work = Int64[np.ndarray, "2"]  # forward and backward operations


class _Passes:
    """A counter of the operations of passes of one clip through the predictor.

    Args:
        sizes: The sizes of the model.
        config: The config of the run, whose adapter determines the trained layers.
    """

    def __init__(self, sizes: ModelSizes, config: Config) -> None:
        with torch.device("meta"):
            network = new_predictor(sizes)
        self._sizes, self._ranks, self._whole = sizes, dict[str, int](), set(config.adapter.modules_to_save)
        self._layers = {name: layer for name, layer in network.named_modules() if isinstance(layer, nn.Linear)}
        if config.adapter.kind == "none":
            self._whole = set(self._layers)
        else:
            self._ranks = _ranks(config, sizes)
        conditions = ("action_encoder", "state_encoder", "extrinsics_encoder")
        self._conditions = [name for name in conditions if name in self._layers and name not in network.unused_layers]

    def over(self, steps: int, *, keys: range, fed_back: bool) -> _Work:
        """Return the operations of a pass.

        Args:
            steps: Number of steps whose tokens are computed.
            keys: For each of these steps, the number of steps that its tokens attend to.
            fed_back: Whether the input latents are predictions, through which gradients flow.
        """
        patches = steps * self._sizes.tokens_per_frame
        work = self._linear("predictor_embed", patches, into=fed_back)
        for name in self._conditions:
            work += self._linear(name, steps, into=False)
        flowing = fed_back or any(self._changes(name) for name in ("predictor_embed", *self._conditions))
        per_step = self._sizes.tokens_per_frame + len(self._conditions)
        product = 2 * per_step**2 * sum(keys) * self._sizes.predictor.width  # queries by keys, or weights by values
        for block in (f"blocks.{index}" for index in range(self._sizes.predictor.depth)):
            projections = [f"{block}.attn.{name}" for name in ("q", "k", "v")]
            for name in projections:
                work += self._linear(name, steps * per_step, into=flowing)
            query, key, value = (flowing or self._changes(name) for name in projections)
            # Forward: scores, weighted values. Backward: gradients of values and weights, then of queries and keys.
            work += [2 * product, (value + (query or key) + query + key) * product]
            flowing = query or key or value
            for name in (f"{block}.attn.o", f"{block}.mlp.fc1", f"{block}.mlp.fc2"):
                work += self._linear(name, steps * per_step, into=flowing)
                flowing = flowing or self._changes(name)
        work += self._linear("predictor_proj", patches, into=flowing)
        return work

    def _linear(self, name: str, tokens: int, *, into: bool) -> _Work:
        """Return the operations of a linear layer and its adapter; `into` is whether the input needs a gradient."""
        layer = self._layers[name]
        product = 2 * tokens * layer.in_features * layer.out_features
        work = np.array([product, product * (into + (name in self._whole))])
        if name in self._ranks:
            first, second = (2 * tokens * self._ranks[name] * side for side in (layer.in_features, layer.out_features))
            work += [first + second, first * (into + 1) + 2 * second]
        return work

    def _changes(self, name: str) -> bool:
        return name in self._whole or name in self._ranks


def _ranks(config: Config, sizes: ModelSizes) -> dict[str, int]:
    """Return the rank of each layer that has an adapter."""
    named = meta_predictor(config, sizes).named_parameters()
    first = ((name.removeprefix("base_model.model.").partition(".lora_A"), value) for name, value in named)
    return {layer: value.shape[0] for (layer, is_first, _), value in first if is_first}
