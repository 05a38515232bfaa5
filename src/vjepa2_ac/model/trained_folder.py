"""How does what was trained lie in a folder? Weights, and a card that says which base they belong to."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.model.folder import check_tensors
from vjepa2_ac.model.world_model import Adaptation, WorldModel

CARD = "vjepa2_ac.json"
LORA_WEIGHTS = "adapter_model.safetensors"  # PEFT's name
FULL_WEIGHTS = "predictor.safetensors"
PRINCIPAL_PARTS = "pissa_start.safetensors"  # what an adapter of init pissa started from, and the base then lacks


def write_trained(
    folder: Path, adaptation: Adaptation, weights: dict[str, Tensor], fresh_heads: dict[str, int] | None = None
) -> None:
    """Write weights and the card that says what they are, what they were trained on, and with which fresh heads.

    Raises:
        OSError: The disk is full, or another reason of the system's.
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
    """Return what was trained, lora or none, once it is certain that it belongs to this model.

    Raises:
        InputError: The folder is of another kind, or belongs to another base.
    """
    card = _read_card(folder)
    _check_base(model, card, where=str(folder / CARD))
    if model.adaptation is not None and model.adaptation.kind != card["kind"]:
        raise InputError(
            where=str(folder),
            found=f"an adapter of kind {card['kind']}",
            needed=f"one of kind {model.adaptation.kind}, as the model has",
            fix="Set adapter.kind to the one it was trained with",
        )
    return str(card["kind"])


def read_fresh_heads(folder: Path) -> tuple[Widths, int] | None:
    """Return the widths of states and actions and the seed of fresh heads; None where the base's own were kept.

    Raises:
        InputError: The folder is of another kind, or damaged.
    """
    card = _read_card(folder)
    if "fresh_heads" not in card:
        return None
    try:
        said = card["fresh_heads"]
        state, action, seed = (int(said[key]) for key in ("state_dim", "action_dim", "seed"))
    except (KeyError, TypeError, ValueError):
        state = action = seed = 0
    if min(state, action) < 1:
        raise InputError(
            where=str(folder / CARD),
            found=f"fresh_heads that cannot be used: {card['fresh_heads']!r}"[:200],
            needed="state_dim, action_dim and seed, as they were written",
        )
    return Widths(state, action), seed


def read_weights(path: Path, like: dict[str, Tensor]) -> dict[str, Tensor]:
    """Read weights that have the names and shapes of others.

    Raises:
        InputError: The file is missing or damaged, or holds other tensors, or NaN or infinity.
    """
    try:
        weights = dict(load_file(path))
    except FileNotFoundError:
        raise InputError(where=str(path), found="no such file", needed="the weights of an adapter") from None
    except (SafetensorError, OSError) as error:
        raise InputError(where=str(path), found=f"not a whole safetensors file ({error})") from None
    found, needed = ({name: tuple(value.shape) for name, value in some.items()} for some in (weights, like))
    check_tensors(found, needed, where=str(path))
    require_finite(weights, where=str(path), fix="Use an older checkpoint, or train it again")
    return weights


def _save(weights: dict[str, Tensor], path: Path) -> None:
    try:
        save_file(weights, path, metadata={"format": "pt"})
    except SafetensorError as error:  # the system's reason stands in its text alone
        raise OSError(errno.EIO, str(error), str(path)) from None


def _read_card(folder: Path) -> dict[str, Any]:
    needed = "a folder written by save_trained"
    try:
        card = json.loads((folder / CARD).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(where=str(folder / CARD), found="no such file", needed=needed) from None
    except (OSError, ValueError) as error:
        raise InputError(where=str(folder / CARD), found=f"cannot be read ({error})", needed=needed) from None
    if not isinstance(card, dict) or card.get("kind") not in ("lora", "none"):
        raise InputError(where=str(folder / CARD), found="not the card of an adapter", needed=needed)
    return card


def _check_base(model: WorldModel, card: dict[str, Any], *, where: str) -> None:
    own = model.adaptation.base if model.adaptation else model.predictor_fingerprint()
    encoder = model.adaptation.encoder if model.adaptation else model.encoder_fingerprint()
    for part, found, needed in (
        ("predictor", own, card.get("base_predictor")),
        ("encoder", encoder, card.get("encoder")),
    ):
        if found != needed:
            raise InputError(
                where=where,
                found=f"an adapter trained on another {part} ({str(needed)[:12]})",
                needed=f"one trained on this model's {part} ({found[:12]})",
                fix="Set model.base to the model it was trained on",
            )
