"""Where a model is, and its sizes as its folder says them; no weight is read, and PyTorch is not imported."""

from __future__ import annotations

import importlib.resources
from pathlib import Path
from typing import Any

from vjepa2_ac.config import ModelConfig, ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.places import BUILTIN, HUB
from vjepa2_ac.storage import unreadable
from vjepa2_ac.storage.structured import read_json_object, record_of

ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets"
FORMAT = "vjepa2-ac world model 1"
CONFIG = "config.json"
ENCODER_NEEDED = "an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project"

_TINY = f"{BUILTIN}sim-tiny"
_NEEDED = "a folder written by `vjepa2-ac export` or WorldModel.save_pretrained"
_FIX = "Of a run, `vjepa2-ac export RUN FOLDER` makes one"


def find_base(name: str) -> Path:
    """Return the file or folder that `model.base` names.

    Raises:
        InputError: There is none.
    """
    needed = f"the official .pt, a folder written by `vjepa2-ac export`, or {_TINY}"
    fix = "`vjepa2-ac download` fetches the official checkpoint to checkpoints/vjepa2-ac-vitg.pt"
    return _find(name, f"model.base: {name}", needed, fix)


def find_encoder_path(name: str) -> Path | None:
    """Return the file or folder that `model.encoder.path` names; None: it is on the Hub.

    Raises:
        InputError: There is none.
    """
    if name.startswith(HUB):
        return None
    fix = "`vjepa2-ac download --list` shows those that are published"
    return _find(name, f"model.encoder.path: {name}", ENCODER_NEEDED, fix)


def require_model(config: ModelConfig) -> None:
    """Refuse a model or an encoder of this machine that is not there.

    Raises:
        InputError: It is not.
    """
    if config.base is not None:
        find_base(config.base)
    if config.encoder is not None:
        find_encoder_path(config.encoder.path)


def _find(name: str, where: str, needed: str, fix: str) -> Path:
    path = ASSETS / name.removeprefix(BUILTIN) if name.startswith(BUILTIN) else Path(name)
    if name.startswith(BUILTIN) and not (path / CONFIG).is_file():
        there = ", ".join(sorted(f"{BUILTIN}{config.parent.name}" for config in ASSETS.glob(f"*/{CONFIG}")))
        found = f"no model of that name in the package; it has {there or 'none: install it again, or run `make base`'}"
        raise InputError(where=where, found=found, needed=_TINY)
    if not path.exists():
        raise InputError(where=where, found="no such file or folder", needed=needed, fix=fix)
    return path


def read_model_json(path: Path, *, needed: str = _NEEDED, fix: str = _FIX) -> dict[str, Any]:
    """Return the JSON object beside a model's weights.

    Raises:
        InputError: There is none, or it is no JSON object.
        UnreachableError: The system refuses to read it.
    """
    try:
        return read_json_object(path, needed=needed, fix=fix)
    except OSError as error:
        raise unreadable(str(path), error, needed=needed, fix=fix) from None


def read_sizes(folder: Path) -> ModelSizes:
    """Read the sizes of the model in a folder.

    Raises:
        InputError: The folder is not a world model.
    """
    where, card = str(folder / CONFIG), read_model_json(folder / CONFIG)
    if card.get("format") != FORMAT:
        raise InputError(where=where, found="not the config of a world model", needed=_NEEDED, fix=_FIX)
    return record_of(ModelSizes, card.get("sizes"), where=f"{where}: sizes", needed=_NEEDED, fix=_FIX)


def check_sizes(found: ModelSizes, given: ModelSizes, *, where: str) -> None:
    """Refuse sizes that were given, and are not those of the model.

    Only those other than the default count as given: a run's own config spells out every default.

    Raises:
        InputError: Names what differs.
    """
    actual, wanted, standard = _flat(found), _flat(given), _flat(ModelSizes())
    wrong = [key for key in actual if wanted[key] not in (actual[key], standard[key])]
    if wrong:
        raise InputError(
            where=where,
            found=", ".join(f"{key} {actual[key]}" for key in wrong),
            needed=", ".join(f"{key} {wanted[key]}" for key in wrong) + ", as model.sizes says",
            fix="Leave them out of model.sizes: the model tells",
        )


def _flat(sizes: ModelSizes) -> dict[str, Any]:
    nested = sizes.model_dump()
    flat = {f"{part}.{key}": value for part in ("encoder", "predictor") for key, value in nested.pop(part).items()}
    return nested | flat
