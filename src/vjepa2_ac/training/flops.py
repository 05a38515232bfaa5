"""Model FLOPs of one clip or one frame, by formula.

PyTorch's counter returns the same numbers on fake tensors, but takes seconds at the start of every run. Only matrix
products are counted, each once, with two operations per multiplied pair of numbers: those of the forward pass, of the
backward pass with respect to inputs that need a gradient, and of the backward pass with respect to trained weights.
Recomputation (gradient checkpointing, the scores in the backward pass of fused attention), other operations (norms,
activations, rotations) and the norms of weights that DoRA needs are not counted. Attention is block-causal: a token of
step t attends to the tokens of steps up to t.
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
        config: The config of the run. Only the adapter, the frames per clip and the rollout steps are used.
        sizes: The sizes of the model, for example from `model.checkpoints.base_sizes`.
    """
    passes, frames = _Passes(sizes, config), config.data.frames
    total = passes.count(frames - 1, keys=range(1, frames), fed_back=False)
    for step in range(2, 1 + config.training.rollout_steps):  # earlier keys and values are cached
        total += passes.count(1, keys=range(step, step + 1), fed_back=True)
    return ClipFlops(frames * frame_flops(sizes), *total.tolist())


def frame_flops(sizes: ModelSizes) -> int:
    """Return the operations of encoding one frame."""
    encoder = sizes.encoder
    tokens, width, hidden = sizes.tokens_per_frame, encoder.width, int(encoder.width * encoder.mlp_ratio)
    embedding = 2 * tokens * 3 * sizes.patch_size**2 * width  # of one frame, because both frames of a tubelet are equal
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
        self._sizes, self._ranks, self._fully_trained = sizes, dict[str, int](), set(config.adapter.modules_to_save)
        self._layers = {name: layer for name, layer in network.named_modules() if isinstance(layer, nn.Linear)}
        if config.adapter.kind == "none":
            self._fully_trained = set(self._layers)
        else:
            self._ranks = _find_ranks(config, sizes)
        conditions = ("action_encoder", "state_encoder", "extrinsics_encoder")
        self._conditions = [name for name in conditions if name in self._layers and name not in network.unused_layers]

    def count(self, steps: int, *, keys: range, fed_back: bool) -> _Work:
        """Return the operations of a pass.

        Args:
            steps: Number of steps whose tokens are computed.
            keys: For each of these steps, the number of steps that its tokens attend to.
            fed_back: Whether the input latents are predictions, through which gradients flow.
        """
        patches = steps * self._sizes.tokens_per_frame
        work = self._linear("predictor_embed", patches, input_needs_gradient=fed_back)
        for name in self._conditions:
            work += self._linear(name, steps, input_needs_gradient=False)
        needs_gradient = fed_back or any(self._is_trained(name) for name in ("predictor_embed", *self._conditions))
        per_step = self._sizes.tokens_per_frame + len(self._conditions)
        product = 2 * per_step**2 * sum(keys) * self._sizes.predictor.width  # queries by keys, or weights by values
        for block in (f"blocks.{index}" for index in range(self._sizes.predictor.depth)):
            projections = [f"{block}.attn.{name}" for name in ("q", "k", "v")]
            for name in projections:
                work += self._linear(name, steps * per_step, input_needs_gradient=needs_gradient)
            query, key, value = (needs_gradient or self._is_trained(name) for name in projections)
            # Forward: scores, weighted values. Backward: gradients of values and weights, then of queries and keys.
            work += [2 * product, (value + (query or key) + query + key) * product]
            needs_gradient = query or key or value
            for name in (f"{block}.attn.o", f"{block}.mlp.fc1", f"{block}.mlp.fc2"):
                work += self._linear(name, steps * per_step, input_needs_gradient=needs_gradient)
                needs_gradient = needs_gradient or self._is_trained(name)
        work += self._linear("predictor_proj", patches, input_needs_gradient=needs_gradient)
        return work

    def _linear(self, name: str, tokens: int, *, input_needs_gradient: bool) -> _Work:
        """Return the operations of a linear layer and its adapter."""
        layer = self._layers[name]
        product = 2 * tokens * layer.in_features * layer.out_features
        work = np.array([product, product * (input_needs_gradient + (name in self._fully_trained))])
        if name in self._ranks:
            first, second = (2 * tokens * self._ranks[name] * side for side in (layer.in_features, layer.out_features))
            work += [first + second, first * (input_needs_gradient + 1) + 2 * second]
        return work

    def _is_trained(self, name: str) -> bool:
        return name in self._fully_trained or name in self._ranks


def _find_ranks(config: Config, sizes: ModelSizes) -> dict[str, int]:
    """Return the rank of each layer that has an adapter."""
    parameters = meta_predictor(config, sizes).named_parameters()
    split_names = ((name.removeprefix("base_model.model.").partition(".lora_A"), value) for name, value in parameters)
    return {layer: value.shape[0] for (layer, lora_a, _), value in split_names if lora_a}
