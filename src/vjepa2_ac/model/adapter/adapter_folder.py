"""The folder of trained weights: an adapter or a predictor, with a card that names its base; it is not trusted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from torch import Tensor

from vjepa2_ac.config.model import VectorWidth
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.base_model import read_model_json
from vjepa2_ac.model.network.pretrained_folder import read_tensors, save_tensors
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.storage.structured import record_of

CARD = "vjepa2_ac.json"
ADAPTER_FILE = "adapter_config.json"  # PEFT's name
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"


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
    save_tensors(weights, folder / (LORA_WEIGHTS if card.kind == "lora" else FULL_WEIGHTS))
    fields = {name: value for name, value in asdict(card).items() if value is not None}
    (folder / CARD).write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def read_card(folder: Path, model: WorldModel) -> Card:
    """Return the card of trained weights, after checking that they belong to this model.

    Raises:
        InputError: The folder is of another kind or damaged, or its weights belong to another base.
    """
    path, needed = folder / CARD, "the card of an adapter, as save_trained writes it"
    card = record_of(Card, read_model_json(path, needed=needed, fix=""), where=str(path), needed=needed)
    own = model.adaptation.base if model.adaptation else model.predictor_fingerprint()
    encoder = model.adaptation.encoder if model.adaptation else model.encoder_fingerprint()
    for part, found, needed, trained_on, this in (
        ("predictor", own, card.base_predictor, "", ""),
        ("encoder", encoder, card.encoder, f": {card.encoder_in_words}", f": {model.encoder_in_words}"),
    ):
        if found != needed:
            raise InputError(
                where=str(path),
                found=f"an adapter trained on another {part} ({needed[:12]}{trained_on})",
                needed=f"one trained on this model's {part} ({found[:12]}{this})",
                fix="Set model.base (or model.encoder) to what it was trained on",
            )
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
