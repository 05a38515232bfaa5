"""The dynamics of latents: predict the next step, roll out many; needs PyTorch alone."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import layer_norm

from vjepa2_ac.model.network.attention import Attend, AttentionKind
from vjepa2_ac.model.network.compilation import When
from vjepa2_ac.model.network.predictor_network import KeyValueCache


class LatentDynamics(nn.Module):
    """A predictor of latents, with or without an adapter around it; predictions are layer-normalised, in float32."""

    predictor: nn.Module

    @property
    def device(self) -> torch.device:
        """The device of the predictor's weights."""
        return next(self.predictor.parameters()).device

    @property
    def base_predictor(self) -> Any:
        """The predictor itself, without a surrounding adapter."""
        wrapped = getattr(self.predictor, "get_base_model", None)  # PEFT's
        return wrapped() if wrapped else self.predictor

    def predict(
        self,
        latents: Float[Tensor, "batch time tokens dim"],
        actions: Float[Tensor, "batch time action_dim"],
        states: Float[Tensor, "batch time state_dim"],
        extrinsics: Float[Tensor, "batch time 6"] | None = None,
        cache: KeyValueCache | None = None,
        keep: int | None = None,
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return, at each step, the prediction of the next step's latents from the given ones (teacher forcing).

        With a cache the steps come after those in it; the first `keep` of them are added to it (None: all).
        """
        if cache is None:
            return normalise_latents(self.predictor(latents, actions, states, extrinsics))
        return normalise_latents(self.predictor(latents, actions, states, extrinsics, cache=cache, keep=keep))

    def rollout(
        self,
        context: Float[Tensor, "batch context tokens dim"],
        actions: Float[Tensor, "batch time action_dim"],
        states: Float[Tensor, "batch time state_dim"],
        extrinsics: Float[Tensor, "batch time 6"] | None = None,
        cache: KeyValueCache | None = None,
    ) -> Float[Tensor, "batch steps tokens dim"]:
        """Return predictions of the steps after the context, each fed back to predict the next.

        With frames counted from 0, the context holds frames 0 .. context-1 and the result frames context .. time: the
        first is predicted from the context alone, so index h - 1 is horizon h, and there are time - context + 1 of
        them. Actions and states are the true ones throughout. A context need not be true: to continue from a
        known prediction, append it to the context.

        The context is computed at once, then one step at a time: keys and values are cached. With a cache, context,
        actions and states come after the steps in it; it is not changed, so that many rollouts can start from it.

        Raises:
            ValueError: There are fewer actions than context latents.
        """
        first, last = context.shape[1], actions.shape[1]
        if last < first:
            raise ValueError(f"{last} actions do not reach the end of a context of {first} latents")
        cache = KeyValueCache() if cache is None else cache.copy()
        latents, start = context, 0
        predicted = []
        for end in range(first, last + 1):
            camera = None if extrinsics is None else extrinsics[:, start:end]
            keep = None if end < last else 0  # nothing comes after the last
            following = self.predict(latents, actions[:, start:end], states[:, start:end], camera, cache, keep)
            latents, start = following[:, -1:], end
            predicted.append(latents)
        return torch.cat(predicted, dim=1)

    def set_gradient_checkpointing(self, enabled: bool) -> None:
        """Choose whether predictor blocks are recomputed in the backward pass instead of storing their activations."""
        predictor = self.base_predictor
        predictor.gradient_checkpointing = enabled
        predictor.has_dropout = any(isinstance(one, nn.Dropout) and one.p > 0 for one in predictor.blocks.modules())

    def set_compiled(self, when: When) -> None:
        """Choose when predictor blocks are compiled (see `model.network.compilation`)."""
        for block in self.base_predictor.blocks:
            block.compiled = when

    def set_attention(self, kind: AttentionKind | Attend) -> None:
        """Choose how the predictor computes block-causal attention (see `model.network.attention`)."""
        self.base_predictor.attention = kind


def normalise_latents(features: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
    """Return features layer-normalised over `dim` without affine, in float32."""
    return layer_norm(features.float(), features.shape[-1:])
