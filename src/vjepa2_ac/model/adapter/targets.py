"""Target layers and ranks of the adapter: the knobs, checked, in PEFT's form."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from torch import nn

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.predictor_network import PredictorNetwork

ATTENTION = ("q", "k", "v", "o")
MLP = ("fc1", "fc2")

PEFT_NAMES = {  # of our knobs
    "r": "rank",
    "lora_alpha": "alpha",
    "lora_dropout": "dropout",
    "target_modules": "targets",
    "modules_to_save": "modules_to_save",
    "use_rslora": "rslora",
    "use_dora": "dora",
    "init_lora_weights": "init",
    "rank_pattern": "rank_pattern",
    "alpha_pattern": "alpha_pattern",
}


def lora_arguments(predictor: PredictorNetwork, config: AdapterConfig) -> dict[str, Any]:
    """Return the arguments of PEFT's LoraConfig; layers without input cannot have an adapter.

    Args:
        predictor: The predictor, not adapted.
        config: The knobs.

    Raises:
        InputError: A target, pattern or layer to train whole matches no layer, a layer is named twice, or a rank is too
            large for a layer.
    """
    layers = {
        name: layer
        for name, layer in predictor.named_modules()
        if isinstance(layer, nn.Linear) and name not in predictor.unused_layers
    }
    _check_saved(config, predictor)
    targets = chosen_targets(config, {_last(name) for name in layers})
    adapted = {name: layer for name, layer in layers.items() if _last(name) in targets}
    _check_patterns("rank_pattern", config.rank_pattern, adapted)
    _check_patterns("alpha_pattern", config.alpha_pattern, adapted)
    if config.init == "pissa":
        _check_ranks(config, adapted)
    return peft_arguments(config, targets)


def peft_arguments(config: AdapterConfig, targets: Iterable[str]) -> dict[str, Any]:
    """Return the arguments of PEFT's LoraConfig for layers of these names; not checked against a predictor."""
    return {
        **{peft: getattr(config, ours) for peft, ours in PEFT_NAMES.items()},
        "target_modules": list(targets),
        "bias": "none",
        "init_lora_weights": True if config.init == "default" else config.init,
        "rank_pattern": dict(config.rank_pattern),
        "alpha_pattern": dict(config.alpha_pattern),
        "modules_to_save": list(config.modules_to_save) or None,
    }


def chosen_targets(config: AdapterConfig, linear: set[str]) -> tuple[str, ...]:
    """Return the targets with sets replaced by their layers; `all` excludes layers that are trained directly.

    Raises:
        InputError: A target is no layer, there are none, or one is also in modules_to_save.
    """
    everything = tuple(sorted(linear - set(config.modules_to_save)))
    sets = {"attention": ATTENTION, "mlp": MLP, "all": everything}
    targets = tuple(dict.fromkeys(layer for target in config.targets for layer in sets.get(target, (target,))))
    unknown = [target for target in targets if target not in linear]
    if unknown or not targets:
        raise InputError(
            where="adapter.targets",
            found=", ".join(unknown) + " matches no layer of the predictor" if unknown else "no target",
            needed=f"some of {', '.join(sorted(linear))}; or {', '.join(sets)}",
        )
    twice = sorted(set(targets) & set(config.modules_to_save))
    if twice:
        raise InputError(
            where="adapter.modules_to_save",
            found=f"{', '.join(twice)}, which adapter.targets names too",
            needed="each layer once: trained whole, or with an adapter",
        )
    return targets


def adapter_ranks(predictor: PredictorNetwork, config: AdapterConfig) -> dict[str, int]:
    """Return the rank of each layer that gets an adapter, by name.

    Raises:
        InputError: As of `lora_arguments`.
    """
    targets = lora_arguments(predictor, config)["target_modules"]
    linear = [name for name, layer in predictor.named_modules() if isinstance(layer, nn.Linear)]
    return {name: rank_of(config, name) for name in linear if _last(name) in targets}


def rank_of(config: AdapterConfig, layer: str) -> int:
    """Return the rank that PEFT gives a layer: that of the first pattern that fits the end of its name."""
    return next((rank for key, rank in config.rank_pattern.items() if _matches(key, layer)), config.rank)


def _check_saved(config: AdapterConfig, predictor: PredictorNetwork) -> None:
    missing = [name for name in config.modules_to_save if not hasattr(predictor, name)]
    if missing:
        raise InputError(
            where="adapter.modules_to_save",
            found=f"{', '.join(missing)}, which this predictor does not have: it was made without states",
            needed="layers of the predictor",
            fix="Leave it out, and set model.sizes.predictor.use_states=false: both are then checked before loading",
        )


def _check_patterns(knob: str, patterns: Mapping[str, object], adapted: Iterable[str]) -> None:
    for pattern in patterns:
        if not any(_matches(pattern, name) for name in adapted):
            raise InputError(
                where=f"adapter.{knob}",
                found=f"{pattern!r} matches no layer that gets an adapter",
                needed="the end of a layer's name, such as fc1 or blocks.0.attn.q, or a regular expression for it",
            )


def _check_ranks(config: AdapterConfig, adapted: Mapping[str, nn.Linear]) -> None:
    for name, layer in adapted.items():
        rank = rank_of(config, name)
        most = min(layer.in_features, layer.out_features)
        if rank > most:
            raise InputError(
                where="adapter.init",
                found=f"pissa with rank {rank} for {name}, a matrix of {layer.out_features} x {layer.in_features}",
                needed=f"a rank of at most {most} there: it starts from that many of its singular vectors",
                fix=f"Set adapter.rank_pattern.{_last(name)}={most}, or leave the layer out of adapter.targets",
            )


def _matches(pattern: str, name: str) -> bool:
    """Return whether PEFT applies this pattern to this layer."""
    return re.match(rf"(.*\.)?({pattern})$", name) is not None


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]
