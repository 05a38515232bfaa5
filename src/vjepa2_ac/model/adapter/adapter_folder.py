"""The folder of trained weights: an adapter or a predictor, with a card that names its base; it is not trusted."""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.model import PEFT_NAMES, VectorWidth
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.pretrained_folder import read_tensors
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.storage.structured import message_of, read_json_object, record_of, shown

CARD = "vjepa2_ac.json"
ADAPTER_FILE = "adapter_config.json"  # PEFT's name
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"

_NEEDED = "a LoRA adapter of V-JEPA 2-AC's predictor, as this program writes it in PEFT's format"
_FIX = "Copy the adapter again, or train it again: other kinds of PEFT's are not read"
_INFORMATIONAL = frozenset({  # origin and purpose
    "auto_mapping", "base_model_name_or_path", "inference_mode", "megatron_core", "peft_type", "peft_version",
    "revision", "task_type",
})  # fmt: skip
_LITERAL = re.compile(r"[\w.]+")  # names of layers, which as regular expressions cannot take long
_MOST_RANK, _MOST_ALPHA = 1024, 1e6


@dataclass(frozen=True)
class Heads:
    """Fresh heads: the widths of actions and states, and their seed."""

    action_dim: VectorWidth
    state_dim: VectorWidth
    seed: Annotated[int, Field(ge=0, lt=2**63)]


@dataclass(frozen=True)
class Card:
    """The trained weights' kind and base."""

    kind: Literal["lora", "none"]
    base_predictor: str
    encoder: str
    encoder_in_words: str  # for people; the fingerprint decides
    fresh_heads: Heads | None = None  # None: the base's own heads are used


def write_trained(folder: Path, card: Card, weights: Mapping[str, Tensor]) -> None:
    """Write weights and their card.

    Raises:
        OSError: The disk is full, or another system error.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = {key: value.detach().to("cpu").contiguous() for key, value in weights.items()}
    path = folder / (LORA_WEIGHTS if card.kind == "lora" else FULL_WEIGHTS)
    try:
        save_file(whole, path, metadata={"format": "pt"})
    except SafetensorError as error:  # the system's reason is in its text only
        raise OSError(errno.EIO, str(error), str(path)) from None
    fields = {name: value for name, value in asdict(card).items() if value is not None}
    (folder / CARD).write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def read_card(folder: Path, model: WorldModel) -> Card:
    """Return the card of trained weights, after checking that they belong to this model.

    Raises:
        InputError: The folder is of another kind or damaged, or its weights belong to another base.
    """
    path, needed = folder / CARD, "the card of an adapter, as save_trained writes it"
    card = record_of(Card, _object_in(path, needed), where=str(path), needed=needed)
    _check_base(model, card, where=str(path))
    if model.adaptation is not None and model.adaptation.kind != card.kind:
        raise InputError(
            where=str(folder),
            found=f"an adapter of kind {card.kind}",
            needed=f"one of kind {model.adaptation.kind}, as the model has",
            fix="Set adapter.kind to the one it was trained with",
        )
    return card


def read_adapter_file(folder: Path, defaults: Mapping[str, Any]) -> AdapterConfig:
    """Return the knobs of a saved adapter, which may be a stranger's: PEFT never sees the file.

    Layers are named, never matched by a regular expression, and options have plain values: none of them runs code,
    takes long, or takes more memory than an adapter of rank 1,024.

    Args:
        folder: Its folder.
        defaults: PEFT's values of options that were not chosen.

    Raises:
        InputError: The file is missing or damaged, or of an unsupported adapter.
    """
    path = folder / ADAPTER_FILE
    return adapter_of(_object_in(path, _NEEDED), defaults, where=str(path))


def adapter_of(values: Mapping[str, Any], defaults: Mapping[str, Any], *, where: str) -> AdapterConfig:
    """Return the knobs of an adapter from the options of PEFT's LoraConfig.

    Raises:
        InputError: An option is none that can be read.
    """
    if values.get("peft_type") != "LORA":
        raise _refused(where, f"an adapter with peft_type {shown(values.get('peft_type'))}", "peft_type LORA")
    knobs = {ours: values[peft] for peft, ours in PEFT_NAMES.items() if values.get(peft) is not None}
    missing = {"rank", "alpha", "targets"} - knobs.keys()
    if missing:
        raise _refused(where, f"no {' and no '.join(sorted(missing))}")
    options = {
        name: value
        for name, value in values.items()
        if name not in PEFT_NAMES and name not in _INFORMATIONAL and not _is_off(value, defaults.get(name))
    }
    for name, value in options.items():
        if not _can_be_read(name, value, defaults.get(name)):
            raise _refused(where, f"an adapter with {shown(name)} {shown(value)}, which is not read here")
    try:
        given = {"kind": "lora", "rslora": False, **knobs, "peft": options}  # not rsLoRA: PEFT's default
        return AdapterConfig.model_validate_json(json.dumps(given))
    except ValidationError as error:
        raise _refused(where, "; ".join(map(_problem, error.errors()[:4]))) from None


def read_weights(path: Path, like: dict[str, Tensor]) -> dict[str, Tensor]:
    """Read weights that must have the names and shapes of given ones.

    Raises:
        InputError: The file is missing or damaged, or holds other tensors, or NaN or infinity.
    """
    fix = "Use an older checkpoint, or train it again"
    return read_tensors(path, like, needed="the weights of an adapter", fix=fix)


def _object_in(path: Path, needed: str) -> dict[str, Any]:
    try:
        return read_json_object(path, needed=needed)
    except OSError as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        raise InputError(where=str(path), found=found, needed=needed) from None


def _is_off(value: object, default: object) -> bool:
    return value is None or value is False or value in ([], {}) or value == default


def _can_be_read(name: str, value: object, default: object) -> bool:
    """Return whether an option is a pattern of whole names, a start (a knob says which), or a number as PEFT has it."""
    if name in {"rank_pattern", "alpha_pattern"}:
        kinds, most = ((int,), _MOST_RANK) if name == "rank_pattern" else ((int, float), _MOST_ALPHA)
        return isinstance(value, dict) and all(
            _LITERAL.fullmatch(key) and type(one) in kinds and 0 < one <= most for key, one in value.items()
        )
    return name == "init_lora_weights" or (isinstance(value, bool | int | float) and type(value) is type(default))


def _problem(detail: Any) -> str:
    first, *rest = map(str, detail["loc"] or ("peft",))
    peft = next((peft for peft, ours in PEFT_NAMES.items() if ours == first), first)
    return f"{'.'.join([peft, *rest])}: {message_of(detail)}"


def _refused(where: str, found: str, needed: str = _NEEDED) -> InputError:
    return InputError(where=where, found=found, needed=needed, fix=_FIX)


def _check_base(model: WorldModel, card: Card, *, where: str) -> None:
    own = model.adaptation.base if model.adaptation else model.predictor_fingerprint()
    encoder = model.adaptation.encoder if model.adaptation else model.encoder_fingerprint()
    parts = (
        ("predictor", own, card.base_predictor, "", ""),
        ("encoder", encoder, card.encoder, f": {card.encoder_in_words}", f": {model.encoder_in_words}"),
    )
    for part, found, needed, trained_on, this in parts:
        if found != needed:
            raise InputError(
                where=where,
                found=f"an adapter trained on another {part} ({needed[:12]}{trained_on})",
                needed=f"one trained on this model's {part} ({found[:12]}{this})",
                fix="Set model.base (or model.encoder) to what it was trained on",
            )
