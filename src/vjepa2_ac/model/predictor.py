"""The action-conditioned predictor as a transformers model, its key-value cache, one-step prediction and rollout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.nn.functional import layer_norm
from torch.utils.checkpoint import checkpoint

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.episode import EXTRINSICS_DIM
from vjepa2_ac.errors import quiet_imports
from vjepa2_ac.model.attention import Attend, AttentionKind, TokenLayout, rotary_tables
from vjepa2_ac.model.blocks import NORM_EPSILON, Block, apply_norm, hidden_width, initialise
from vjepa2_ac.model.compilation import When

with quiet_imports():
    from transformers import PreTrainedConfig, PreTrainedModel


class KeyValueCache:
    """The rotated keys and the values of earlier steps in all layers of a predictor. A new cache is empty.

    Gradients flow through the cache into the forward passes that filled it. Each call of `append` stores one piece per
    layer. Blocks concatenate the pieces during computation, so gradient checkpointing stores no step twice.
    """

    def __init__(self, pieces: tuple[tuple[Tensor, ...], ...] = ()) -> None:
        self._pieces = pieces  # one tuple per layer

    @property
    def tokens(self) -> int:
        """The number of tokens in the cache."""
        return sum(piece.shape[3] for piece in self._pieces[0]) if self._pieces else 0

    def layer(self, index: int) -> tuple[Float[Tensor, "2 batch heads _ head_dim"], ...]:
        """Return the pieces of a layer, each with keys and values."""
        return self._pieces[index] if self._pieces else ()

    def append(self, added: Sequence[Float[Tensor, "2 batch heads tokens head_dim"]]) -> None:
        """Add keys and values of further tokens, one piece for every layer."""
        pieces_by_layer = self._pieces or ((),) * len(added)
        self._pieces = tuple((*pieces, piece) for pieces, piece in zip(pieces_by_layer, added, strict=True))

    def copy(self) -> KeyValueCache:
        """Return a cache with the same tensors, to which steps can be added independently."""
        return KeyValueCache(self._pieces)


class PredictorConfig(PreTrainedConfig):  # type: ignore[misc]  # transformers has no types
    """The sizes of a predictor as a config of transformers; `new_predictor` creates it."""

    model_type = "vjepa2_ac_predictor"


class ActionConditionedPredictor(PreTrainedModel):  # type: ignore[misc]  # transformers has no types
    """A transformer that predicts the latents of each next step from the latents, states and actions up to this step.

    The tokens of a step are, in order: action, (state), (extrinsics), patches. The output has only the patches, which
    are not normalised.

    Source: facebookresearch/vjepa2 @ c2963a4, src/models/ac_predictor.py, VisionTransformerPredictorAC.
    """

    config_class = PredictorConfig
    base_model_prefix = "predictor"
    main_input_name = "latents"
    supports_gradient_checkpointing = True
    _no_split_modules = ["Block"]  # noqa: RUF012  # transformers reads a list

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__(config)
        width = config.hidden_size
        hidden = hidden_width(width, config.mlp_ratio)
        self.predictor_embed = nn.Linear(config.latent_dim, width)
        self.action_encoder = nn.Linear(config.action_dim, width)
        if config.use_states:
            self.state_encoder = nn.Linear(config.state_dim, width)
        # The official checkpoint has this layer although the model does not use extrinsics.
        if config.use_states or config.use_extrinsics:
            self.extrinsics_encoder = nn.Linear(EXTRINSICS_DIM, width)
        self.blocks = nn.ModuleList(
            Block(width, config.num_attention_heads, hidden, layer=index + 1)
            for index in range(config.num_hidden_layers)
        )
        self.predictor_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.predictor_proj = nn.Linear(width, config.latent_dim)
        self.attention: AttentionKind | Attend = "auto"
        self.gradient_checkpointing = False  # transformers sets the attribute of this name
        self.has_dropout = False  # whether recomputed blocks must draw the same dropout masks
        self.post_init()

    @property
    def grid(self) -> int:
        """The number of patches along one side of a frame."""
        return int(self.config.image_size // self.config.patch_size)

    @property
    def unused_layers(self) -> tuple[str, ...]:
        """The names of layers that have no input."""
        return ("extrinsics_encoder",) if self.config.use_states and not self.config.use_extrinsics else ()

    def forward(
        self,
        latents: Float[Tensor, "batch time tokens dim"],
        actions: Float[Tensor, "batch time action_dim"],
        states: Float[Tensor, "batch time state_dim"],
        extrinsics: Float[Tensor, "batch time 6"] | None = None,
        cache: KeyValueCache | None = None,
        keep: int | None = None,
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return for each step the predicted latents of the next step, not yet normalised.

        Inputs may have any float type.

        Args:
            latents: The latents of consecutive steps.
            actions: The action of each step.
            states: The state of each step; ignored, and of any width, if the model has no states.
            extrinsics: The camera pose of each step, if the model uses it.
            cache: Earlier steps, to which these steps attend. These steps are then added to the cache.
            keep: The number of these steps, counted from the first, that are added to the cache; None for all.

        Raises:
            ValueError: Extrinsics are missing or unexpected.
        """
        tokens, layout = self._assemble(latents, actions, states, extrinsics, cache)
        tokens = self._run_blocks(tokens, layout, cache, keep)
        patches = rearrange(tokens, "batch (time token) width -> batch time token width", time=layout.steps)[
            :, :, layout.conditioning :
        ]
        return _apply_in_weight_dtype(self.predictor_proj, apply_norm(self.predictor_norm, patches), self._dtype)

    def _assemble(
        self,
        latents: Tensor,
        actions: Tensor,
        states: Tensor,
        extrinsics: Tensor | None,
        cache: KeyValueCache | None = None,
    ) -> tuple[Tensor, TokenLayout]:
        """Return the sequence of tokens, ordered by step, and its layout."""
        if self.config.use_extrinsics != (extrinsics is not None):
            raise ValueError(
                f"the predictor has use_extrinsics: {self.config.use_extrinsics}, but extrinsics are"
                f" {'missing' if extrinsics is None else 'passed'}"
            )
        inputs = [(self.action_encoder, actions)]
        inputs += [(self.state_encoder, states)] if self.config.use_states else []
        inputs += [] if extrinsics is None else [(self.extrinsics_encoder, extrinsics)]
        conditions = [_apply_in_weight_dtype(layer, values, self._dtype) for layer, values in inputs]
        patches = _apply_in_weight_dtype(self.predictor_embed, latents, self._dtype)
        tokens = torch.cat([torch.stack(conditions, dim=2), patches], dim=2)
        start = 0 if cache is None else cache.tokens // tokens.shape[2]
        return tokens.flatten(1, 2), TokenLayout(latents.shape[1], self.grid, len(conditions), start)

    def _run_blocks(self, tokens: Tensor, layout: TokenLayout, cache: KeyValueCache | None, keep: int | None) -> Tensor:
        """Return the output tokens of all blocks, which attend to the cache; add new keys and values to the cache."""
        tables = rotary_tables(layout, tokens.shape[-1] // self.config.num_attention_heads, tokens.device)
        settings = (tables, layout.tokens_per_step, self.attention)
        steps = layout.steps if keep is None else min(keep, layout.steps)
        num_saved_tokens = 0 if cache is None else steps * layout.tokens_per_step
        added: list[Tensor] = []
        for index, block in enumerate(self.blocks):
            past = () if cache is None else cache.layer(index)
            if self.gradient_checkpointing and torch.is_grad_enabled():
                arguments = (tokens, *settings, num_saved_tokens, *past)
                tokens, saved = checkpoint(block, *arguments, use_reentrant=False, preserve_rng_state=self.has_dropout)
            else:
                tokens, saved = block(tokens, *settings, num_saved_tokens, *past)
            if saved is not None:
                added.append(saved)
        if cache is not None and added:
            cache.append(added)
        return tokens

    @property
    def _dtype(self) -> torch.dtype:
        """The data type of the frozen weights; directly trained projections may have another data type."""
        return self.predictor_norm.weight.dtype

    def initialise(self, generator: Generator) -> None:
        """Initialise every weight; the generator determines the values."""
        for module in self.modules():
            initialise(module, generator)

    def initialise_near_persistence(self, generator: Generator) -> None:
        """Initialise the predictor close to persistence: `predictor_embed` is a rotation, `predictor_proj` its inverse.

        Without this initialisation a tiny predictor spends most of its training on learning to copy. A predictor
        narrower than the latents can copy only a random part of them (`ModelSizes.narrow_predictor_warning`).
        """
        shape = self.predictor_embed.weight.shape
        gaussian = torch.randn(max(shape), min(shape), generator=generator, device=generator.device)
        gaussian = gaussian.double()  # in float32 the last bits of the QR would depend on the number of threads
        rotation, triangle = torch.linalg.qr(gaussian)
        rotation = rotation * triangle.diagonal().sign()
        with torch.no_grad():
            self.predictor_embed.weight.copy_(rotation if shape[0] >= shape[1] else rotation.T)
            self.predictor_proj.weight.copy_(self.predictor_embed.weight.T)

    def _init_weights(self, module: nn.Module) -> None:
        """Initialise one module; transformers calls this for weights that a checkpoint does not contain."""
        initialise(module)

    @property
    def is_gradient_checkpointing(self) -> bool:
        """Whether blocks are recomputed in the backward pass. PEFT reads this; transformers' property would warn."""
        return self.gradient_checkpointing


def new_predictor(sizes: ModelSizes) -> ActionConditionedPredictor:
    """Return a predictor of these sizes, not yet initialised."""
    values = sizes.predictor.model_dump()
    renamed = {"width": "hidden_size", "depth": "num_hidden_layers", "heads": "num_attention_heads"}
    fields = {renamed.get(name, name): value for name, value in values.items()}
    config = PredictorConfig(
        image_size=sizes.image_size, patch_size=sizes.patch_size, latent_dim=sizes.encoder.width, **fields
    )
    return ActionConditionedPredictor(config)


def _apply_in_weight_dtype(layer: Any, values: Tensor, dtype: torch.dtype) -> Tensor:
    """Apply a layer in the data type of its weights and cast the result to `dtype`; with autocast, only apply it.

    A directly trained layer is float32, even in a predictor of another data type.
    """
    if torch.is_autocast_enabled(values.device.type):
        return layer(values)  # type: ignore[no-any-return]  # PEFT's wrapper has no types
    return layer(values.to(layer.weight.dtype)).to(dtype)  # type: ignore[no-any-return]  # PEFT's wrapper has no types


class LatentDynamics(nn.Module):
    """A predictor of latents, with or without an adapter; predictions are layer-normalised, in float32."""

    predictor: nn.Module

    @property
    def device(self) -> torch.device:
        """The device of the predictor's weights."""
        return next(self.predictor.parameters()).device

    @property
    def base_predictor(self) -> Any:
        """The predictor without PEFT's wrapper."""
        get_base_model = getattr(self.predictor, "get_base_model", None)  # a method of PEFT's wrapper
        return get_base_model() if get_base_model else self.predictor

    def predict(
        self,
        latents: Float[Tensor, "batch time tokens dim"],
        actions: Float[Tensor, "batch time action_dim"],
        states: Float[Tensor, "batch time state_dim"],
        extrinsics: Float[Tensor, "batch time 6"] | None = None,
        cache: KeyValueCache | None = None,
        keep: int | None = None,
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return for each step the predicted latents of the next step, given the true latents (teacher forcing).

        The arguments are those of `ActionConditionedPredictor.forward`.
        """
        return normalise_latents(self.predictor(latents, actions, states, extrinsics, cache=cache, keep=keep))

    def rollout(
        self,
        context: Float[Tensor, "batch context tokens dim"],
        actions: Float[Tensor, "batch time action_dim"],
        states: Float[Tensor, "batch time state_dim"],
        extrinsics: Float[Tensor, "batch time 6"] | None = None,
        cache: KeyValueCache | None = None,
    ) -> Float[Tensor, "batch steps tokens dim"]:
        """Return a rollout: predictions of the steps after the context, each used as input for the next prediction.

        With frames counted from 0, the context contains frames 0 .. context-1, and the result contains the
        time - context + 1 frames context .. time. The first prediction is made from the context alone, so index h - 1
        of the result is horizon h. The context may end with a prediction, to continue an earlier rollout.

        The context is computed in one pass. Each later step is one pass with cached keys and values. With `cache`,
        context, actions and states follow the steps in the cache. The cache is not changed, so many rollouts can start
        from the same cache.

        Raises:
            ValueError: There are fewer actions than context latents.
        """
        first, last = context.shape[1], actions.shape[1]
        if last < first:
            raise ValueError(f"{last} actions for a context of {first} latents; expected at least {first}")
        cache = KeyValueCache() if cache is None else cache.copy()
        latents, start = context, 0
        predicted = []
        for end in range(first, last + 1):
            camera = None if extrinsics is None else extrinsics[:, start:end]
            keep = None if end < last else 0  # the last step is not added, because no step follows it
            following = self.predict(latents, actions[:, start:end], states[:, start:end], camera, cache, keep)
            latents, start = following[:, -1:], end
            predicted.append(latents)
        return torch.cat(predicted, dim=1)

    def set_gradient_checkpointing(self, enabled: bool) -> None:
        """Choose whether predictor blocks are recomputed in the backward pass instead of storing their activations."""
        predictor = self.base_predictor
        predictor.gradient_checkpointing = enabled
        dropouts = (module for module in predictor.blocks.modules() if isinstance(module, nn.Dropout))
        predictor.has_dropout = any(dropout.p > 0 for dropout in dropouts)

    def set_compiled(self, when: When) -> None:
        """Choose when predictor blocks are compiled (see `model.compilation`)."""
        for block in self.base_predictor.blocks:
            block.compiled = when

    def set_attention(self, kind: AttentionKind | Attend) -> None:
        """Choose how the predictor computes block-causal attention (see `model.attention`)."""
        self.base_predictor.attention = kind


def normalise_latents(features: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
    """Return features layer-normalised over `dim`, without affine parameters, in float32."""
    return layer_norm(features.float(), features.shape[-1:])
