"""Save and load trained weights: an adapter or a predictor, with a card that identifies the base model.

The files are not trusted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from torch import Tensor

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.model import VectorWidth
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError, quiet_imports
from vjepa2_ac.model.lora import (
    FIX,
    NEEDED,
    lora_config,
    lora_weights,
    parse_adapter_config,
    require_adaptation,
    set_trainable,
    train_all_weights,
    wrap_predictor,
)
from vjepa2_ac.model.world_model import WorldModel, fit_heads
from vjepa2_ac.storage.structured import parse_record, read_json_object
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

with quiet_imports():
    from peft import set_peft_model_state_dict

CARD = "vjepa2_ac.json"
ADAPTER_FILE = "adapter_config.json"  # PEFT's name
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"


@dataclass(frozen=True)
class Heads:
    """New input layers: the widths of actions and states, and the seed of their initial weights."""

    action_dim: VectorWidth
    state_dim: VectorWidth
    seed: Annotated[int, Field(ge=0, lt=2**63)]


@dataclass(frozen=True)
class Card:
    """The card of trained weights: their kind, and the base model on which they were trained."""

    kind: Literal["lora", "none"]
    base_predictor: str
    encoder: str
    encoder_in_words: str  # description for messages; only the fingerprint is compared
    fresh_heads: Heads | None = None  # None: the input layers are those of the base model


def save_trained(model: WorldModel, folder: str | Path) -> None:
    """Save the trained weights (an adapter in PEFT's format or the whole predictor) and the base model's identity.

    Args:
        model: The adapted model.
        folder: The folder to write into.

    Raises:
        OSError: The disk is full, or another system error.
        ValueError: The model is not adapted.
    """
    folder, adaptation, sizes, heads = Path(folder), require_adaptation(model), model.sizes.predictor, None
    if model.new_input_heads is not None:
        heads = Heads(sizes.action_dim, sizes.state_dim, model.new_input_heads.seed)
    card = Card(adaptation.kind, adaptation.base, adaptation.encoder, model.encoder_description, heads)
    folder.mkdir(parents=True, exist_ok=True)
    if card.kind == "lora":
        save_tensors(lora_weights(model), folder / LORA_WEIGHTS)
        lora_config(model).save_pretrained(str(folder))
    else:
        save_tensors(model.predictor.state_dict(), folder / FULL_WEIGHTS)
    fields = {name: value for name, value in asdict(card).items() if value is not None}
    (folder / CARD).write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def load_trained(model: WorldModel, folder: str | Path, trainable: bool | None = None) -> None:
    """Load weights from `save_trained` into a base model, or into a model that already has an adapter.

    Args:
        model: The base model, or a model with an adapter of the same config, which is not wrapped again.
        folder: The folder with the weights.
        trainable: Whether the weights can be trained; None keeps the state of an existing adapter and freezes a new
            one.

    Raises:
        InputError: The folder contains no trained weights or is damaged; or the weights were trained on another base
            model, or differ in config from the existing adapter.
    """
    folder = Path(folder)
    is_new, card = model.adaptation is None, read_card(folder, model)
    heads = card.fresh_heads
    if heads is not None and is_new and model.new_input_heads is None:
        fit_heads(model, Widths(heads.state_dim, heads.action_dim), heads.seed)
    if card.kind == "lora":
        _load_lora(model, folder)
    else:
        weights = _read_weights(folder / FULL_WEIGHTS, model.predictor.state_dict())
        if is_new:
            train_all_weights(model)
        model.predictor.load_state_dict(weights)
    if is_new or trainable is not None:
        set_trainable(model, bool(trainable))


def _load_lora(model: WorldModel, folder: Path) -> None:
    path = folder / ADAPTER_FILE
    config = parse_adapter_config(read_json_object(path, needed=NEEDED, fix=FIX), where=str(path))
    if model.adaptation is None:
        try:
            wrap_predictor(model, config)
        except InputError as error:
            where = f"{path}: {error.where}"
            raise InputError(where=where, found=error.found, needed=error.needed, fix=error.fix) from None
    else:
        existing = parse_adapter_config(lora_config(model).to_dict(), where=str(folder))
        for name in AdapterConfig.model_fields.keys() - {"dropout"}:
            value, expected = getattr(config, name), getattr(existing, name)
            if value != expected:
                problem = f"an adapter with {name} {value}"
                raise InputError(where=str(folder), found=problem, needed=f"{expected}, as in the model")
    set_peft_model_state_dict(model.predictor, _read_weights(folder / LORA_WEIGHTS, lora_weights(model)))


def read_card(folder: Path, model: WorldModel) -> Card:
    """Read the card of trained weights, and check that they were trained on the base model of `model`.

    Raises:
        InputError: The folder contains no trained weights or is damaged, or they were trained on another base model.
    """
    path, needed = folder / CARD, "the card of an adapter, as save_trained writes it"
    card = parse_record(Card, read_json_object(path, needed=needed), where=str(path), needed=needed)
    predictor = model.adaptation.base if model.adaptation else model.predictor_fingerprint()
    encoder = model.adaptation.encoder if model.adaptation else model.encoder_fingerprint()
    for part, in_model, in_card, model_details, card_details in (
        ("predictor", predictor, card.base_predictor, "", ""),
        ("encoder", encoder, card.encoder, f": {model.encoder_description}", f": {card.encoder_in_words}"),
    ):
        if in_model != in_card:
            trained_on, loaded = f"{in_card[:12]}{card_details}", f"{in_model[:12]}{model_details}"
            description = f"an adapter trained on another {part} ({trained_on}) than this model's ({loaded})"
            fix = "Set model.base (or model.encoder) to the model on which it was trained"
            raise InputError(where=str(path), found=description, fix=fix)
    if model.adaptation is not None and model.adaptation.kind != card.kind:
        description = f"an adapter of kind {card.kind}, and the model has one of kind {model.adaptation.kind}"
        raise InputError(where=str(folder), found=description, fix="Set adapter.kind to the one it was trained with")
    return card


def _read_weights(path: Path, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    fix = "Use an older checkpoint, or train it again"
    return read_tensors(path, expected, needed="the weights of an adapter", fix=fix)
