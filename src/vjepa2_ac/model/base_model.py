"""The base model: which path and sizes does `model.base` name? No weight is read, and PyTorch is not imported."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from vjepa2_ac.config import ModelConfig, ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.sizes import CONFIG, read_sizes
from vjepa2_ac.places import BUILTIN

ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets"

_TINY = f"{BUILTIN}sim-tiny"


def find_base(name: str) -> Path:
    """Return the file or folder that `model.base` names.

    Raises:
        InputError: There is none.
    """
    path = _builtin(name) if name.startswith(BUILTIN) else Path(name)
    if not path.exists():
        raise InputError(
            where=f"model.base: {name}",
            found="no such file or folder",
            needed=f"the official .pt, a folder written by `vjepa2-ac export`, or {_TINY}",
            fix="`vjepa2-ac download` fetches the official checkpoint to checkpoints/vjepa2-ac-vitg.pt",
        )
    return path


def base_sizes(config: ModelConfig) -> ModelSizes:
    """Return the sizes of the model that `load_base` would give, without reading a weight.

    Of an official `.pt`, or where nothing is there yet, they are those of `model.sizes`.

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
        found = f"no model of that name in the package; it has {', '.join(there) or 'none'}"
        fix = "" if _TINY in there else f"Install the package again, or make {_TINY} with `make base`"
        raise InputError(where=f"model.base: {name}", found=found, needed=_TINY, fix=fix)
    return path
