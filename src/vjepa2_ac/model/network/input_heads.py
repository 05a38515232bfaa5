"""Input heads for robots with other states or actions than the base: new encoders, which must be trained."""

from __future__ import annotations

import hashlib

import torch
from torch import Generator, Tensor, nn

from vjepa2_ac.config import AdapterConfig, ModelSizes
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.blocks import initialise
from vjepa2_ac.model.network.world_model import FreshHeads, WorldModel


def heads_to_replace(sizes: ModelSizes, widths: Widths) -> tuple[str, ...]:
    """Return the input heads of a model of these sizes that do not fit states and actions of these widths.

    States of any width fit a model without states.
    """
    own = sizes.predictor
    fits = {
        "action_encoder": own.action_dim == widths.action,
        "state_encoder": not own.use_states or own.state_dim == widths.state,
    }
    return tuple(name for name, does in fits.items() if not does)


def require_trained(heads: tuple[str, ...], config: AdapterConfig) -> None:
    """Refuse to leave a fresh head untrained.

    Raises:
        InputError: An adapter is trained and a head is not among its modules_to_save; says what to set.
    """
    missing = [name for name in heads if name not in config.modules_to_save]
    if config.kind == "none" or not missing:
        return
    whole = ", ".join([*config.modules_to_save, *missing])
    raise InputError(
        where="adapter.modules_to_save",
        found=f"nothing that trains the {_as_text(missing)}, fresh because the data has other widths than the base",
        needed="fresh heads are trained whole, beside the adapter",
        fix=f"Set adapter.modules_to_save=[{whole}]",
    )


def fit_heads(model: WorldModel, widths: Widths, seed: int) -> list[str]:
    """Replace the input heads that do not fit states and actions of these widths by fresh ones.

    They are initialised as in the released recipe, each from the seed and its own name. The base's identity does not
    change (`WorldModel.predictor_fingerprint`), but without training the model predicts noise.

    Returns:
        A line for each replaced head; none if all fit.

    Raises:
        ValueError: The model is adapted, or has fresh heads already.
    """
    heads = heads_to_replace(model.sizes, widths)
    if not heads:
        return []
    if model.adaptation is not None or model.fresh_heads is not None:
        raise ValueError("heads are replaced once, and before the model is adapted")
    predictor = model.base_predictor
    replaced: dict[str, Tensor] = {}
    lines: list[str] = []
    for name in heads:
        own, width = getattr(predictor, name), widths.action if name == "action_encoder" else widths.state
        replaced |= {f"{name}.{key}": value.detach().cpu() for key, value in own.state_dict().items()}
        head = nn.Linear(width, own.out_features)
        initialise(head, _generator(seed, name))
        setattr(predictor, name, head.to(own.weight.device, own.weight.dtype).requires_grad_(False))
        lines.append(f"{_as_text([name])}: {width} numbers instead of the base's {own.in_features}: initialised anew")
    dims = {"action_dim": widths.action}
    dims |= {"state_dim": widths.state} if model.sizes.predictor.use_states else {}
    predictor.config.update(dims)
    model.sizes = model.sizes.model_copy(update={"predictor": model.sizes.predictor.model_copy(update=dims)})
    model.fresh_heads = FreshHeads(replaced, seed)
    return lines


def widths_of_model(sizes: ModelSizes) -> Widths:
    """Return the widths of a model's states and actions; without states, that of its actions for both.

    A plan changes states by actions: where the model does not tell the width of a state, it is that of an action.
    """
    own = sizes.predictor
    return Widths(state=own.state_dim if own.use_states else own.action_dim, action=own.action_dim)


def widths_as_text(sizes: ModelSizes) -> str:
    """Return which states and actions a model takes, for messages."""
    own = sizes.predictor
    states = f"states of {own.state_dim}" if own.use_states else "any states"
    return f"{states} and actions of {own.action_dim} numbers"


def _generator(seed: int, name: str) -> Generator:
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "big") >> 1)


def _as_text(names: list[str]) -> str:
    return " and the ".join(name.replace("_", " ") for name in names)
