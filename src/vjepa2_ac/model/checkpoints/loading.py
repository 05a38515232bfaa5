"""Loading the world model of `model.base`: the official checkpoint, a folder, or one that ships with the package."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

import torch

from vjepa2_ac.config import ModelConfig, ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.official import load_official
from vjepa2_ac.model.network.pretrained_folder import CONFIG, check_sizes, read_sizes
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.places import BUILTIN

ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets"

_TINY = f"{BUILTIN}sim-tiny"


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
    path = _builtin(config.base) if config.base.startswith(BUILTIN) else Path(config.base)
    if path.is_dir():
        check_sizes(read_sizes(path), config.sizes, where=f"model.base: {config.base}")
        return WorldModel.from_pretrained(path, dtype=dtype)
    if not path.exists():
        raise InputError(
            where=f"model.base: {config.base}",
            found="no such file or folder",
            needed=f"the official .pt, a folder written by `vjepa2-ac export`, or {_TINY}",
            fix="`vjepa2-ac download` fetches the official checkpoint to checkpoints/vjepa2-ac-vitg.pt",
        )
    return load_official(path, config.sizes, dtype=dtype)


def base_sizes(config: ModelConfig) -> ModelSizes:
    """Return the sizes of the model that `load_base` would return, without reading a weight.

    Of an official `.pt`, or a file that does not exist yet, they are those of `model.sizes`.

    Raises:
        InputError: There is a folder, but it is not a world model.
    """
    if config.random is not None or config.base is None:
        return config.random or config.sizes
    path = _builtin(config.base) if config.base.startswith(BUILTIN) else Path(config.base)
    return read_sizes(path) if path.is_dir() else config.sizes


def _builtin(name: str) -> Path:
    path = ASSETS / name.removeprefix(BUILTIN)
    if not (path / CONFIG).is_file():
        there = sorted(f"{BUILTIN}{config.parent.name}" for config in ASSETS.glob(f"*/{CONFIG}"))
        raise InputError(
            where=f"model.base: {name}",
            found=f"no model of that name in the package; it has {', '.join(there) or 'none'}",
            needed=_TINY,
            fix="" if _TINY in there else f"Install the package again, or make {_TINY} with `make base`",
        )
    return path
