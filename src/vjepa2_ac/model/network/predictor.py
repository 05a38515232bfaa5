"""The action-conditioned predictor of V-JEPA 2-AC as transformers stores and loads it, and its initial weights."""

from __future__ import annotations

import torch
from torch import Generator, nn
from transformers import PreTrainedConfig, PreTrainedModel

from vjepa2_ac.model.network.blocks import initialise
from vjepa2_ac.model.network.predictor_network import PredictorNetwork


class PredictorConfig(PreTrainedConfig):  # type: ignore[misc]  # transformers has no types
    """Sizes of the predictor in the form transformers stores them: those of `predictor_fields`."""

    model_type = "vjepa2_ac_predictor"


class ActionConditionedPredictor(PredictorNetwork, PreTrainedModel):  # type: ignore[misc]  # transformers has no types
    """The predictor in the form that transformers stores and loads; its pass is the network's."""

    config_class = PredictorConfig
    base_model_prefix = "predictor"
    main_input_name = "latents"
    supports_gradient_checkpointing = True
    _no_split_modules = ["Block"]  # noqa: RUF012  # transformers reads a list

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__(config)
        self.add_layers(config)
        self.post_init()  # type: ignore[operator]  # transformers has no types

    def initialise(self, generator: Generator) -> None:
        """Initialise every weight; the generator determines the values."""
        for module in self.modules():
            initialise(module, generator)

    def start_at_persistence(self, generator: Generator) -> None:
        """Initialise a predictor close to copying: it reads latents through a rotation, and writes through its inverse.

        These two layers are the network's only path from input to output; a tiny one that starts at random
        spends most of its training on learning to copy. Close where the predictor is at least as wide as a latent; a
        narrower one passes on a random part of it (`ModelSizes.too_narrow_to_copy`).
        """
        shape = self.predictor_embed.weight.shape
        drawn = torch.randn(max(shape), min(shape), generator=generator, device=generator.device)
        drawn = drawn.double()  # threads would change the last bits
        rotation, triangle = torch.linalg.qr(drawn)
        rotation = rotation * triangle.diagonal().sign()
        with torch.no_grad():
            self.predictor_embed.weight.copy_(rotation if shape[0] >= shape[1] else rotation.T)
            self.predictor_proj.weight.copy_(self.predictor_embed.weight.T)

    def _init_weights(self, module: nn.Module) -> None:
        """Initialise one module: called by transformers for weights that a checkpoint lacks."""
        initialise(module)

    @property
    def is_gradient_checkpointing(self) -> bool:
        """Whether blocks are recomputed in the backward pass; PEFT reads this, and transformers' own property warns."""
        return self.gradient_checkpointing
