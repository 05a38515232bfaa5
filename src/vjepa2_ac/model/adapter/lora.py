"""Trainable weights: a LoRA adapter on the predictor, or the whole predictor: add, save, load.

The only modules that use PEFT are this one and the layer in `lora_linear`. Merging an adapter into the base: `merging`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.adapter_file import ADAPTER_FILE, read_adapter_file
from vjepa2_ac.model.adapter.adapter_folder import (
    FULL_WEIGHTS,
    LORA_WEIGHTS,
    PRINCIPAL_PARTS,
    Card,
    Heads,
    read_card,
    read_weights,
    write_trained,
)
from vjepa2_ac.model.adapter.initialization import (
    draw_first_matrices,
    measure_magnitudes,
    original_weights,
    principal_parts,
    start_from,
)
from vjepa2_ac.model.adapter.lora_linear import LoraLinear
from vjepa2_ac.model.adapter.targets import lora_arguments, peft_arguments
from vjepa2_ac.model.network.input_heads import fit_heads, require_trained
from vjepa2_ac.model.network.predictor_network import PredictorNetwork
from vjepa2_ac.model.network.world_model import Adaptation, WorldModel, base_weights
from vjepa2_ac.model.quiet_imports import quiet_imports

with quiet_imports():
    from peft import LoraConfig, PeftModel, get_peft_model, get_peft_model_state_dict, set_peft_model_state_dict
    from peft.tuners.lora import LoraLayer


class TrainableReport(NamedTuple):
    """Parameter counts; those of an adapter count as trained only."""

    trained: int
    predictor: int
    total: int

    @property
    def share(self) -> float:
        """Trained parameters over the predictor's own."""
        return self.trained / self.predictor

    def __str__(self) -> str:
        return (
            f"{self.trained:,} parameters are trained: {self.share:.2%} of the predictor's {self.predictor:,};"
            f" the model has {self.total:,}"
        )


def add_adapter(model: WorldModel, config: AdapterConfig, seed: int, started: Path | None = None) -> None:
    """Make a model trainable: its predictor gets an adapter, or is trained completely. Trained weights are float32.

    A fresh adapter does not change the output: its second matrix is zero; the seed determines the first. With `init:
    pissa` it is a part of the weights, subtracted from them: the same output up to rounding.

    Args:
        model: The base.
        config: What is trained.
        seed: Determines the first matrices.
        started: A folder of `save_trained` with an adapter of the same start. With `init: pissa` the part is read from
            there instead of computed, which takes minutes; everything else is left to `load_trained`.

    Raises:
        InputError: A target matches no layer, another knob does not fit the predictor, a fresh head (`input_heads`)
            would not be trained, or `started` is of another adapter.
        ValueError: The model is already adapted.
    """
    if model.adaptation is not None:
        raise ValueError("this model has been adapted already: merge_adapter first, or load_trained into it")
    if config.kind == "none":
        _train_everything(model)
        return
    if model.fresh_heads is not None:
        require_trained(tuple(dict.fromkeys(name.split(".")[0] for name in model.fresh_heads.replaced)), config)
    _wrap(model, LoraConfig(**lora_arguments(model.base_predictor, config)))
    layers = lora_layers(model)
    if config.init == "pissa":
        parts = principal_parts(layers) if started is None else _read_principal_parts(model, started)
        _start_from_principal_parts(model, parts)
    else:
        draw_first_matrices(layers, config.init, torch.Generator().manual_seed(seed))
    measure_magnitudes(layers)


def with_adapter(predictor: PredictorNetwork, config: AdapterConfig) -> nn.Module:
    """Return a predictor with a LoRA adapter, as `add_adapter` makes it, but without initial values.

    Args:
        predictor: The predictor, not adapted.
        config: What is trained.

    Raises:
        InputError: A knob does not fit the predictor.
    """
    return _with_peft(predictor, LoraConfig(**lora_arguments(predictor, config)))


def trainable_report(model: WorldModel) -> TrainableReport:
    """Return the number of trained parameters, of the predictor's own, and of the model's without an adapter."""
    own = sum(value.numel() for value in base_weights(model.base_predictor).values())
    encoder = sum(value.numel() for value in model.encoder.parameters())
    return TrainableReport(sum(p.numel() for p in model.parameters() if p.requires_grad), own, own + encoder)


def save_trained(model: WorldModel, folder: str | Path, weights: dict[str, Tensor] | None = None) -> None:
    """Write the trained weights: an adapter in PEFT's format, or the whole predictor; and the base's identity.

    Args:
        model: The adapted model.
        folder: Where to.
        weights: The whole predictor, if the model itself has only a shard of each weight.

    Raises:
        ValueError: The model is not adapted.
    """
    adaptation, folder = adaptation_of(model), Path(folder)
    if adaptation.kind == "lora":
        write_trained(folder, _card_of(model), _lora_weights(model), adaptation.principal)
        _lora_config(model).save_pretrained(str(folder))
    else:
        write_trained(folder, _card_of(model), weights or model.predictor.state_dict())


def load_trained(model: WorldModel, folder: str | Path, trainable: bool | None = None) -> None:
    """Load what `save_trained` wrote onto its base, or into an existing adapter.

    Args:
        model: The base, or a model adapted in the same way; it is not wrapped again.
        folder: The folder.
        trainable: Whether it can be trained; None leaves an existing adapter unchanged, and freezes a new one.

    Raises:
        InputError: The folder is not an adapter, is damaged, belongs to another base, or differs from the existing
            one.
    """
    folder = Path(folder)
    fresh, card = model.adaptation is None, read_card(folder, model)
    heads = card.fresh_heads
    if heads is not None and fresh and model.fresh_heads is None:
        fit_heads(model, Widths(heads.state_dim, heads.action_dim), heads.seed)
    if card.kind == "lora":
        _load_lora(model, folder)
    else:
        _load_everything(model, folder)
    if fresh or trainable is not None:
        _set_trainable(model, bool(trainable))


def lora_layers(model: WorldModel) -> dict[str, Any]:
    """Return the layers of the predictor that have an adapter (PEFT's LoraLayer), by name."""
    found = model.base_predictor.named_modules()
    return {name: layer for name, layer in found if isinstance(layer, LoraLayer)}


def adaptation_of(model: WorldModel) -> Adaptation:
    """Return how a model was adapted.

    Raises:
        ValueError: It is not adapted.
    """
    if model.adaptation is None:
        raise ValueError("this model has not been adapted: add_adapter or load_trained first")
    return model.adaptation


def _card_of(model: WorldModel) -> Card:
    adaptation, sizes, heads = adaptation_of(model), model.sizes.predictor, None
    if model.fresh_heads is not None:
        heads = Heads(sizes.action_dim, sizes.state_dim, model.fresh_heads.seed)
    return Card(adaptation.kind, adaptation.base, adaptation.encoder, heads, model.encoder_in_words)


def _train_everything(model: WorldModel) -> None:
    start = {name: value.detach().to("cpu", copy=True) for name, value in model.predictor.state_dict().items()}
    model.adaptation = Adaptation("none", model.predictor_fingerprint(), model.encoder_fingerprint(), start)
    model.predictor.float()
    _set_trainable(model, trainable=True)


def _wrap(model: WorldModel, config: LoraConfig) -> None:
    base = model.predictor_fingerprint()
    checkpointing = model.base_predictor.gradient_checkpointing
    model.set_gradient_checkpointing(False)  # or PEFT hooks the input: not needed without re-entrance
    model.predictor = _with_peft(model.predictor, config)
    model.set_gradient_checkpointing(checkpointing)
    model.adaptation = Adaptation("lora", base, model.encoder_fingerprint())


def _with_peft(predictor: nn.Module, config: LoraConfig) -> nn.Module:
    config._register_custom_module({nn.Linear: LoraLinear})
    init, config.init_lora_weights = config.init_lora_weights, True  # or PEFT cuts PiSSA out of the base, in its type
    wrapped = get_peft_model(predictor, config).train(predictor.training)  # PEFT's dropout is enabled at first
    config.init_lora_weights = init
    for name, value in wrapped.named_parameters():
        if _is_trained(name):
            value.data = value.data.float()
    return wrapped  # type: ignore[no-any-return]  # PEFT has no types


def _is_trained(name: str) -> bool:
    return ".lora_" in name or ".modules_to_save." in name


def _start_from_principal_parts(model: WorldModel, parts: dict[str, Tensor]) -> None:
    adaptation, layers = adaptation_of(model), lora_layers(model)
    start = adaptation.start or original_weights(layers)
    start_from(layers, start, parts)
    model.adaptation = replace(adaptation, start=start, principal=parts)


def _read_principal_parts(model: WorldModel, folder: Path) -> dict[str, Tensor]:
    like = {
        f"{name}.{matrix}": getattr(layer, matrix)["default"].weight
        for name, layer in lora_layers(model).items()
        for matrix in ("lora_A", "lora_B")
    }
    return read_weights(folder / PRINCIPAL_PARTS, like)


def _lora_weights(model: WorldModel) -> dict[str, Tensor]:
    return dict(get_peft_model_state_dict(model.predictor, save_embedding_layers=False))


def _lora_config(model: WorldModel) -> Any:
    predictor: Any = model.predictor
    config = LoraConfig(**{**predictor.peft_config["default"].to_dict(), "inference_mode": True})
    config.target_modules = sorted(config.target_modules)
    return config


def _set_trainable(model: WorldModel, trainable: bool) -> None:
    lora = isinstance(model.predictor, PeftModel)
    for name, value in model.predictor.named_parameters():
        chosen = _is_trained(name) if lora else name.split(".", 1)[0] not in model.base_predictor.unused_layers
        value.requires_grad_(trainable and chosen)


def _load_lora(model: WorldModel, folder: Path) -> None:
    config = _read_lora_config(folder, model)
    if model.adaptation is None:
        _wrap(model, config)
    else:
        _check_same_adapter(_lora_config(model), config, where=str(folder))
    _check_scales(model, where=str(folder / "adapter_config.json"))
    weights = read_weights(folder / LORA_WEIGHTS, _lora_weights(model))
    if config.init_lora_weights == "pissa":
        _start_from_principal_parts(model, _read_principal_parts(model, folder))
    set_peft_model_state_dict(model.predictor, weights)


def _read_lora_config(folder: Path, model: WorldModel) -> Any:
    """Return an adapter's settings in PEFT's form; on a base they are checked to fit."""
    knobs = read_adapter_file(folder, LoraConfig().to_dict())
    if model.adaptation is not None:
        return LoraConfig(**peft_arguments(knobs, knobs.targets))
    try:
        return LoraConfig(**lora_arguments(model.base_predictor, knobs))
    except InputError as error:
        raise InputError(
            where=f"{folder / ADAPTER_FILE}: {error.where}", found=error.found, needed=error.needed, fix=error.fix
        ) from None


def _check_scales(model: WorldModel, *, where: str) -> None:
    for name, layer in lora_layers(model).items():
        scale, alpha = layer.scaling["default"], layer.lora_alpha["default"]
        if not math.isfinite(scale):
            found = f"lora_alpha {alpha} for {name}, a scale of {scale}"
            raise InputError(where=where, found=found, needed="a finite scale")


def _check_same_adapter(own: Any, other: Any, *, where: str) -> None:
    for key in sorted(peft_arguments(AdapterConfig(), ()).keys() - {"lora_dropout"}):
        found, needed = (
            sorted(value) if isinstance(value, set | list) else value
            for value in (getattr(other, key), getattr(own, key))
        )
        if found != needed:
            raise InputError(where=where, found=f"an adapter with {key} {found}", needed=f"{needed}, as the model has")


def _load_everything(model: WorldModel, folder: Path) -> None:
    weights = read_weights(folder / FULL_WEIGHTS, model.predictor.state_dict())
    if model.adaptation is None:
        _train_everything(model)
    model.predictor.load_state_dict(weights)
