"""Where a model is: the file or folder that a knob names. PyTorch is not imported."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from vjepa2_ac.config import ModelConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.sizes import CONFIG
from vjepa2_ac.places import BUILTIN, HUB

ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets"

_TINY = f"{BUILTIN}sim-tiny"


def find_base(name: str) -> Path:
    """Return the file or folder that `model.base` names.

    Raises:
        InputError: There is none.
    """
    return find_model(
        name,
        knob="model.base",
        needed=f"the official .pt, a folder written by `vjepa2-ac export`, or {_TINY}",
        fix="`vjepa2-ac download` fetches the official checkpoint to checkpoints/vjepa2-ac-vitg.pt",
    )


def require_model(config: ModelConfig) -> None:
    """Refuse a model or an encoder of this machine that is not there.

    Raises:
        InputError: It is not.
    """
    if config.base is not None:
        find_base(config.base)
    if config.encoder is not None:
        find_encoder_path(config.encoder.path)


def find_encoder_path(name: str) -> Path | None:
    """Return the file or folder that `model.encoder.path` names; None: it is on the Hub.

    Raises:
        InputError: There is none.
    """
    if name.startswith(HUB):
        return None
    return find_model(
        name,
        knob="model.encoder.path",
        needed="an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project",
        fix="`vjepa2-ac download --list` shows those that are published",
    )


def find_model(name: str, *, knob: str, needed: str, fix: str) -> Path:
    """Return the file or folder of a model.

    Args:
        name: As the user says it.
        knob: That says it.
        needed: What it should be.
        fix: How to get one.

    Raises:
        InputError: There is none.
    """
    path = _builtin(name, knob) if name.startswith(BUILTIN) else Path(name)
    if not path.exists():
        raise InputError(where=f"{knob}: {name}", found="no such file or folder", needed=needed, fix=fix)
    return path


def _builtin(name: str, knob: str = "model.base") -> Path:
    path = ASSETS / name.removeprefix(BUILTIN)
    if not (path / CONFIG).is_file():
        there = sorted(f"{BUILTIN}{config.parent.name}" for config in ASSETS.glob(f"*/{CONFIG}"))
        found = f"no model of that name in the package; it has {', '.join(there) or 'none'}"
        fix = "" if _TINY in there else f"Install the package again, or make {_TINY} with `make base`"
        raise InputError(where=f"{knob}: {name}", found=found, needed=_TINY, fix=fix)
    return path
