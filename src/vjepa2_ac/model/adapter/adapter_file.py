"""Validation of adapter_config.json: only what this program writes is accepted; PEFT itself would accept far more.

The file is read here, strictly, and becomes the config knobs for it, with their types and ranges. PEFT never sees the
file: no regular expression that runs for ever, no layer outside the predictor, no other method.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.targets import PEFT_NAMES
from vjepa2_ac.storage.structured import message_of, read_json_object, shown

ADAPTER_FILE = "adapter_config.json"  # PEFT's name

_NEEDED = "a LoRA adapter of V-JEPA 2-AC's predictor, as this program writes it in PEFT's format"
_FIX = "Copy the adapter again, or train it again: other kinds of PEFT's are not read"

_FIXED = {"peft_type": "LORA", "bias": "none"}
_INFORMATIONAL = frozenset({  # origin and purpose
    "auto_mapping", "base_model_name_or_path", "inference_mode", "megatron_core", "peft_version", "revision",
    "task_type",
})  # fmt: skip


def read_adapter_file(folder: Path, defaults: Mapping[str, Any]) -> AdapterConfig:
    """Return the knobs of a saved adapter.

    Args:
        folder: Its folder.
        defaults: PEFT's values of settings that were not chosen.

    Raises:
        InputError: The file is missing or damaged, or of an unsupported adapter.
    """
    path = folder / ADAPTER_FILE
    try:
        values = read_json_object(path, needed=_NEEDED, fix=_FIX)
    except OSError as error:
        raise _refused(path, f"cannot be read ({error.strerror or error})") from None
    _require_plain_lora(values, defaults, path)
    try:
        config = AdapterConfig.model_validate_json(json.dumps({"kind": "lora", **_as_knobs(values)}))
    except ValidationError as error:
        problems = [f"{_peft_name(detail['loc'])}: {message_of(detail)}" for detail in error.errors()[:4]]
        raise _refused(path, "; ".join(problems)) from None
    return config


def _require_plain_lora(values: Mapping[str, Any], defaults: Mapping[str, Any], path: Path) -> None:
    """Refuse settings that change an adapter's effect, and for which this program has no knob."""
    for name, needed in _FIXED.items():
        if values.get(name) != needed:
            raise _refused(path, f"an adapter with {name} {shown(values.get(name))}", f"{name} {needed}")
    for name in ("r", "lora_alpha", "target_modules"):
        if name not in values:
            raise _refused(path, f"no {name}")
    for name, value in values.items():
        is_known = name in PEFT_NAMES or name in _FIXED or name in _INFORMATIONAL
        is_off = value is None or value is False or value in ([], {})
        if not is_known and not is_off and (name not in defaults or value != defaults[name]):
            raise _refused(path, f"an adapter with {shown(name)} {shown(value)}, which is not read here")


def _refused(path: Path, found: str, needed: str = _NEEDED) -> InputError:
    return InputError(where=str(path), found=found, needed=needed, fix=_FIX)


def _as_knobs(values: Mapping[str, Any]) -> dict[str, Any]:
    knobs = {ours: values[peft] for peft, ours in PEFT_NAMES.items() if peft in values}
    if "rslora" not in knobs:
        knobs["rslora"] = False  # PEFT's default
    if knobs.get("init") is True or "init" not in knobs:
        knobs["init"] = "default"
    if knobs.get("modules_to_save") is None:
        knobs.pop("modules_to_save", None)
    return knobs


def _peft_name(location: tuple[Any, ...]) -> str:
    first = {ours: peft for peft, ours in PEFT_NAMES.items()}.get(str(location[0]), str(location[0]))
    return ".".join([first, *map(str, location[1:])])
