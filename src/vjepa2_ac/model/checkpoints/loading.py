"""Loading the world model that a config starts from: one that is there, or a fresh predictor on an encoder."""

from __future__ import annotations

import torch

from vjepa2_ac.config import ModelConfig, ModelSizes
from vjepa2_ac.model.base_model import find_base
from vjepa2_ac.model.checkpoints.encoder_file import FoundEncoder
from vjepa2_ac.model.checkpoints.find_encoder import find_encoder, sizes_with
from vjepa2_ac.model.checkpoints.official import load_official, load_predictor, own_encoder
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.model.sizes import check_sizes, read_sizes


def load_base(config: ModelConfig, *, seed: int) -> WorldModel:
    """Return the world model to start from, on the CPU.

    It is `model.base`; or a fresh predictor of the sizes `model.random`, on `model.encoder` or on a random encoder.

    Raises:
        InputError: There is no such model or encoder, it cannot be read, or contradicts the config.
    """
    dtype = torch.bfloat16 if config.dtype == "bfloat16" else torch.float32
    found = None if config.encoder is None else find_encoder(config.encoder)
    if config.random is not None:
        at_persistence = config.random_start == "persistence"
        if found is None:
            return WorldModel.random(config.random, seed, dtype, at_persistence=at_persistence)
        model = _on_encoder(found, config.random, dtype)
        model.draw_predictor(seed, dtype, at_persistence=at_persistence)
        return model
    if config.base is None:
        raise ValueError("a ModelConfig has a base or random sizes")
    path = find_base(config.base)
    if path.is_dir():
        if found is not None:
            raise own_encoder(config.base, found)
        check_sizes(read_sizes(path), config.sizes, where=f"model.base: {config.base}")
        return WorldModel.from_pretrained(path, dtype=dtype)
    return (
        load_official(path, config.sizes, dtype) if found is None else load_predictor(path, found, config.sizes, dtype)
    )


def _on_encoder(found: FoundEncoder, given: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Return a model with this encoder, and a predictor without weights."""
    model = WorldModel.empty(sizes_with(found, given))
    found.fill(model.present_encoder, dtype)
    model.encoder_origin = found.origin
    return model
