"""The folder of trained weights: an adapter or a predictor, with a card that names its base."""

from __future__ import annotations

import errno
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from vjepa2_ac.config.model import VectorWidth
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.pretrained_folder import read_tensors
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.storage.structured import read_json_object, record_of

CARD = "vjepa2_ac.json"
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"
PRINCIPAL_PARTS = "pissa_start.safetensors"  # the initial values of an adapter of init pissa, which the base then lacks


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
    fresh_heads: Heads | None = None  # None: the base's own heads are used
    encoder_in_words: str | None = None  # for people; the fingerprint decides. None: of a card from before


def write_trained(
    folder: Path, card: Card, weights: Mapping[str, Tensor], principal: dict[str, Tensor] | None = None
) -> None:
    """Write weights, the parts of PiSSA that they started from, and their card.

    Raises:
        OSError: The disk is full, or another system error.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = {key: value.detach().to("cpu").contiguous() for key, value in weights.items()}
    _save(whole, folder / (LORA_WEIGHTS if card.kind == "lora" else FULL_WEIGHTS))
    if principal is not None:
        _save(principal, folder / PRINCIPAL_PARTS)
    fields = {name: value for name, value in asdict(card).items() if value is not None}
    (folder / CARD).write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def read_card(folder: Path, model: WorldModel) -> Card:
    """Return the card of trained weights, after checking that they belong to this model.

    Raises:
        InputError: The folder is of another kind or damaged, or its weights belong to another base.
    """
    path, needed = folder / CARD, "the card of an adapter, as save_trained writes it"
    try:
        values = read_json_object(path, needed=needed)
    except OSError as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        raise InputError(where=str(path), found=found, needed=needed) from None
    card = record_of(Card, values, where=str(path), needed=needed)
    _check_base(model, card, where=str(path))
    if model.adaptation is not None and model.adaptation.kind != card.kind:
        raise InputError(
            where=str(folder),
            found=f"an adapter of kind {card.kind}",
            needed=f"one of kind {model.adaptation.kind}, as the model has",
            fix="Set adapter.kind to the one it was trained with",
        )
    return card


def read_weights(path: Path, like: dict[str, Tensor]) -> dict[str, Tensor]:
    """Read weights that must have the names and shapes of given ones.

    Raises:
        InputError: The file is missing or damaged, or holds other tensors, or NaN or infinity.
    """
    fix = "Use an older checkpoint, or train it again"
    return read_tensors(path, like, needed="the weights of an adapter", fix=fix)


def _save(weights: dict[str, Tensor], path: Path) -> None:
    try:
        save_file(weights, path, metadata={"format": "pt"})
    except SafetensorError as error:  # the system's reason is in its text only
        raise OSError(errno.EIO, str(error), str(path)) from None


def _check_base(model: WorldModel, card: Card, *, where: str) -> None:
    own = model.adaptation.base if model.adaptation else model.predictor_fingerprint()
    encoder = model.adaptation.encoder if model.adaptation else model.encoder_fingerprint()
    words = "" if card.encoder_in_words is None else f": {card.encoder_in_words}"
    ours = "" if card.encoder_in_words is None else f": {model.encoder_in_words}"
    parts = (("predictor", own, card.base_predictor, "", ""), ("encoder", encoder, card.encoder, words, ours))
    for part, found, needed, trained_on, this in parts:
        if found != needed:
            raise InputError(
                where=where,
                found=f"an adapter trained on another {part} ({needed[:12]}{trained_on})",
                needed=f"one trained on this model's {part} ({found[:12]}{this})",
                fix="Set model.base (or model.encoder) to what it was trained on",
            )
