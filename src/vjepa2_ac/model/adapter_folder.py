"""Save and load trained weights: an adapter or a predictor, with a card that identifies the base model.

The files may be untrusted: every value is checked, and no code is executed.
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
from vjepa2_ac.model.world_model import WorldModel, replace_input_projections
from vjepa2_ac.storage.structured import parse_record, read_json_object
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

with quiet_imports():
    from peft import set_peft_model_state_dict

CARD = "vjepa2_ac.json"
ADAPTER_FILE = "adapter_config.json"  # PEFT's name
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"


@dataclass(frozen=True)
class ProjectionCard:
    """New input projections: the widths of actions and states, and the seed of the initial weights."""

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
    fresh_heads: ProjectionCard | None = None  # new input projections; None if they are the base model's


def save_trained(model: WorldModel, folder: str | Path) -> None:
    """Save the trained weights (an adapter in PEFT's format or the whole predictor) and the base model's identity.

    Args:
        model: The adapted model.
        folder: The folder to write into.

    Raises:
        OSError: The disk is full, or another system error.
        ValueError: The model is not adapted.
    """
    folder, adaptation, sizes, projections = Path(folder), require_adaptation(model), model.sizes.predictor, None
    if model.new_input_projections is not None:
        projections = ProjectionCard(sizes.action_dim, sizes.state_dim, model.new_input_projections.seed)
    card = Card(adaptation.kind, adaptation.base, adaptation.encoder, model.encoder_description, projections)
    folder.mkdir(parents=True, exist_ok=True)
    if card.kind == "lora":
        save_tensors(lora_weights(model), folder / LORA_WEIGHTS)
        lora_config(model).save_pretrained(str(folder))
    else:
        save_tensors(model.predictor.state_dict(), folder / FULL_WEIGHTS)
    fields = {name: value for name, value in asdict(card).items() if value is not None}
    (folder / CARD).write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def load_trained(model: WorldModel, folder: str | Path, trainable: bool | None = None) -> None:
    """Load weights that `save_trained` wrote into a base model, or into a model that already has an adapter.

    Args:
        model: The base model, which gets a new adapter; or a model whose adapter has the same config.
        folder: The folder with the weights.
        trainable: Whether the weights can be trained. None: an existing adapter keeps its state, a new adapter is
            frozen.

    Raises:
        InputError: The folder contains no trained weights or is damaged; or the weights were trained on another base
            model, or their config differs from that of the existing adapter.
    """
    folder = Path(folder)
    is_new, card = model.adaptation is None, read_card(folder, model)
    projections = card.fresh_heads
    if projections is not None and is_new and model.new_input_projections is None:
        replace_input_projections(model, Widths(projections.state_dim, projections.action_dim), projections.seed)
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
    for part, model_hash, card_hash, model_details, card_details in (
        ("predictor", predictor, card.base_predictor, "", ""),
        ("encoder", encoder, card.encoder, f": {model.encoder_description}", f": {card.encoder_in_words}"),
    ):
        if model_hash != card_hash:
            trained_on, loaded = f"{card_hash[:12]}{card_details}", f"{model_hash[:12]}{model_details}"
            description = f"an adapter trained on another {part} ({trained_on}) than this model's ({loaded})"
            fix = "Set model.base (or model.encoder) to the model on which it was trained"
            raise InputError(where=str(path), found=description, fix=fix)
    if model.adaptation is not None and model.adaptation.kind != card.kind:
        description = f"weights of adapter.kind {card.kind}, but the model has adapter.kind {model.adaptation.kind}"
        raise InputError(where=str(folder), found=description, fix=f"Set adapter.kind: {card.kind}")
    return card


def _read_weights(path: Path, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    fix = "Use an older checkpoint, or train it again"
    return read_tensors(path, expected, needed="the weights of an adapter", fix=fix)
