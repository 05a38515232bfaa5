"""The folder of trained weights: an adapter or a predictor, with a card that names its base."""

from __future__ import annotations

import errno
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from vjepa2_ac.config.model import VectorWidth
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.model.network.pretrained_folder import check_tensors, opened_safetensors, shapes_of
from vjepa2_ac.model.network.world_model import Adaptation, WorldModel
from vjepa2_ac.storage.structured import read_json_object, record_of

CARD = "vjepa2_ac.json"
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"
PRINCIPAL_PARTS = "pissa_start.safetensors"  # the initial values of an adapter of init pissa, which the base then lacks


@dataclass(frozen=True)
class _Heads:
    """Fresh heads: the widths of states and actions, and their seed."""

    state_dim: VectorWidth
    action_dim: VectorWidth
    seed: Annotated[int, Field(ge=0, lt=2**63)]


@dataclass(frozen=True)
class _Card:
    """The trained weights' kind and base."""

    kind: Literal["lora", "none"]
    base_predictor: str
    encoder: str
    fresh_heads: _Heads | None = None


def write_trained(
    folder: Path, adaptation: Adaptation, weights: dict[str, Tensor], fresh_heads: dict[str, int] | None = None
) -> None:
    """Write weights and their card: kind, base, and fresh heads.

    Raises:
        OSError: The disk is full, or another system error.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = {key: value.detach().to("cpu").contiguous() for key, value in weights.items()}
    name = LORA_WEIGHTS if adaptation.kind == "lora" else FULL_WEIGHTS
    _save(whole, folder / name)
    if adaptation.principal is not None:
        _save(adaptation.principal, folder / PRINCIPAL_PARTS)
    card: dict[str, Any] = {
        "kind": adaptation.kind,
        "base_predictor": adaptation.base,
        "encoder": adaptation.encoder,
    }
    if fresh_heads is not None:
        card["fresh_heads"] = fresh_heads
    (folder / CARD).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def read_kind(folder: Path, model: WorldModel) -> str:
    """Return the kind of the trained weights, lora or none, after checking that they belong to this model.

    Raises:
        InputError: The folder is of another kind, or its weights belong to another base.
    """
    card = _read_card(folder)
    _check_base(model, card, where=str(folder / CARD))
    if model.adaptation is not None and model.adaptation.kind != card.kind:
        raise InputError(
            where=str(folder),
            found=f"an adapter of kind {card.kind}",
            needed=f"one of kind {model.adaptation.kind}, as the model has",
            fix="Set adapter.kind to the one it was trained with",
        )
    return card.kind


def read_fresh_heads(folder: Path) -> tuple[Widths, int] | None:
    """Return the widths of states and actions and the seed of fresh heads; None if the base's own heads are used.

    Raises:
        InputError: The folder is of another kind, or damaged.
    """
    heads = _read_card(folder).fresh_heads
    return None if heads is None else (Widths(heads.state_dim, heads.action_dim), heads.seed)


def read_weights(path: Path, like: dict[str, Tensor]) -> dict[str, Tensor]:
    """Read weights that must have the names and shapes of given ones.

    Raises:
        InputError: The file is missing or damaged, or holds other tensors, or NaN or infinity.
    """
    needed = {name: tuple(value.shape) for name, value in like.items()}
    with opened_safetensors(path, needed="the weights of an adapter") as file:
        check_tensors(shapes_of(file), needed, where=str(path))
        weights = {name: file.get_tensor(name).clone() for name in needed}  # the file may be replaced meanwhile
    require_finite(weights, where=str(path), fix="Use an older checkpoint, or train it again")
    return weights


def _save(weights: dict[str, Tensor], path: Path) -> None:
    try:
        save_file(weights, path, metadata={"format": "pt"})
    except SafetensorError as error:  # the system's reason is in its text only
        raise OSError(errno.EIO, str(error), str(path)) from None


def _read_card(folder: Path) -> _Card:
    path, needed = folder / CARD, "the card of an adapter, as save_trained writes it"
    try:
        card = read_json_object(path, needed=needed)
    except FileNotFoundError:
        raise InputError(where=str(path), found="no such file", needed=needed) from None
    except OSError as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed=needed) from None
    return record_of(_Card, card, where=str(path), needed=needed)


def _check_base(model: WorldModel, card: _Card, *, where: str) -> None:
    own = model.adaptation.base if model.adaptation else model.predictor_fingerprint()
    encoder = model.adaptation.encoder if model.adaptation else model.encoder_fingerprint()
    for part, found, needed in (
        ("predictor", own, card.base_predictor),
        ("encoder", encoder, card.encoder),
    ):
        if found != needed:
            raise InputError(
                where=where,
                found=f"an adapter trained on another {part} ({needed[:12]})",
                needed=f"one trained on this model's {part} ({found[:12]})",
                fix="Set model.base to the model it was trained on",
            )
