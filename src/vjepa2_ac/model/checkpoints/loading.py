"""Loading the world model that a config starts from: one that is there, or a fresh predictor on an encoder."""

from __future__ import annotations

from pathlib import Path

import torch

from vjepa2_ac.config import ModelConfig, ModelSizes
from vjepa2_ac.model.base_model import find_base
from vjepa2_ac.model.checkpoints.encoder_file import FoundEncoder
from vjepa2_ac.model.checkpoints.find_encoder import expected_sizes, find_encoder, sizes_with
from vjepa2_ac.model.checkpoints.official import load_official, load_predictor, own_encoder
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.model.sizes import check_sizes, read_sizes
from vjepa2_ac.places import BUILTIN


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
    if found is not None:
        return load_predictor(path, found, config.sizes, dtype)
    return load_official(path, config.sizes, dtype)


def base_sizes(config: ModelConfig) -> ModelSizes:
    """Return the sizes of the model that `load_base` would give, without reading a weight.

    Of an official `.pt`, or where nothing is there yet, they are those of `model.sizes`.

    Raises:
        InputError: There is a folder, but it is not a world model; or `model.encoder` names none.
    """
    given = config.random or config.sizes
    if config.encoder is not None:
        return expected_sizes(config.encoder, given)
    if config.random is not None or config.base is None:
        return given
    is_there = config.base.startswith(BUILTIN) or Path(config.base).exists()
    path = find_base(config.base) if is_there else Path(config.base)
    return read_sizes(path) if path.is_dir() else config.sizes


def _on_encoder(found: FoundEncoder, given: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Return a model with this encoder, and a predictor without weights."""
    model = WorldModel.empty(sizes_with(found, given))
    found.fill(model.present_encoder, dtype)
    model.encoder_origin = found.origin
    return model
