"""Loading the world model of `model.base`: the official checkpoint, a folder, or one that ships with the package."""

from __future__ import annotations

import torch

from vjepa2_ac.config import ModelConfig
from vjepa2_ac.model.base_model import find_base
from vjepa2_ac.model.checkpoints.official import load_official
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.model.sizes import check_sizes, read_sizes


def load_base(config: ModelConfig, *, seed: int) -> WorldModel:
    """Return the world model to start from, on the CPU: `model.base`, or a fresh one of the sizes `model.random`.

    Raises:
        InputError: There is no such model, it cannot be read, or contradicts `model.sizes`.
    """
    dtype = torch.bfloat16 if config.dtype == "bfloat16" else torch.float32
    if config.random is not None:
        at_persistence = config.random_start == "persistence"
        return WorldModel.random(config.random, seed, dtype, at_persistence=at_persistence)
    if config.base is None:
        raise ValueError("a ModelConfig has a base or random sizes")
    path = find_base(config.base)
    if path.is_dir():
        check_sizes(read_sizes(path), config.sizes, where=f"model.base: {config.base}")
        return WorldModel.from_pretrained(path, dtype=dtype)
    return load_official(path, config.sizes, dtype=dtype)
