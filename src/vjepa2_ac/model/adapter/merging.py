"""Disabling an adapter temporarily, and merging it into the model for good."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any

import torch

from vjepa2_ac.model.adapter.lora import adaptation_of
from vjepa2_ac.model.network.world_model import WorldModel


@contextmanager
def base_only(model: WorldModel) -> Iterator[None]:
    """Let the model predict as its base within the block; a model without adapter is the base.

    A model with fresh heads returns to their initial values: not a base for comparison.
    """
    if model.adaptation is None:
        yield
        return
    trained = [(value, value.requires_grad) for value in model.predictor.parameters()]
    predictor: Any = model.predictor
    start = model.adaptation.start
    try:
        with predictor.disable_adapter() if start is None else _weights(predictor, start):
            yield
    finally:
        for value, requires_grad in trained:  # PEFT enables gradients when it enables an adapter
            value.requires_grad_(requires_grad)


def merge_adapter(model: WorldModel) -> None:
    """Merge the trained weights into the predictor: added in float32, then cast to the base's type, frozen.

    A surrounding autocast has no effect.

    Raises:
        ValueError: The model is not adapted.
    """
    adaptation = adaptation_of(model)
    never_trained = model.base_predictor.predictor_norm.weight  # beside an adapter
    dtype = (adaptation.start or {}).get("predictor_norm.weight", never_trained).dtype
    if adaptation.kind == "lora":
        kind = model.device.type
        has_autocast = torch.amp.is_autocast_available(kind)  # some, such as meta, have none
        with torch.autocast(kind, enabled=False) if has_autocast else nullcontext():  # or its type would be computed in
            model.predictor = model.predictor.float().merge_and_unload()  # type: ignore[operator]  # PEFT is untyped
    model.predictor.to(dtype).requires_grad_(False)
    model.adaptation = model.fresh_heads = None


def unadapted_copy(model: WorldModel) -> WorldModel:
    """Return a model for inference with a shared encoder and its own predictor, into which the adapter is merged.

    The given model is not changed.
    """
    own = WorldModel.empty(model.sizes)
    own.encoder, own.predictor = model.encoder, copy.deepcopy(model.predictor)
    own.adaptation, own.fresh_heads = model.adaptation, model.fresh_heads
    if own.adaptation is not None:
        merge_adapter(own)
    return own.eval()


@contextmanager
def _weights(predictor: Any, weights: Mapping[str, torch.Tensor]) -> Iterator[None]:
    now = {name: value.detach().clone() for name, value in predictor.state_dict().items()}
    predictor.load_state_dict(weights)
    try:
        yield
    finally:
        predictor.load_state_dict(now)
