"""The knobs of the adapter, checked against a predictor, as arguments of PEFT's LoraConfig; needs PyTorch alone."""

from __future__ import annotations

from typing import Any

from torch import nn

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.model import PEFT_NAMES
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.predictor_network import PredictorNetwork

_SETS = {"attention": ("q", "k", "v", "o"), "mlp": ("fc1", "fc2")}


def lora_arguments(predictor: PredictorNetwork, config: AdapterConfig) -> dict[str, Any]:
    """Return the arguments of PEFT's LoraConfig; layers without input cannot have an adapter.

    Raises:
        InputError: A target or a layer to train whole matches no layer, or a layer is named twice.
    """
    missing = [name for name in config.modules_to_save if not hasattr(predictor, name)]
    if missing:
        raise InputError(
            where="adapter.modules_to_save",
            found=f"{', '.join(missing)}, which this predictor does not have: it was made without states",
            needed="layers of the predictor",
            fix="Leave it out, and set model.sizes.predictor.use_states=false: both are then checked before loading",
        )
    return {
        **{peft: getattr(config, ours) for peft, ours in PEFT_NAMES.items()},
        "target_modules": _chosen_targets(predictor, config),
        "modules_to_save": list(config.modules_to_save) or None,
        **config.peft,
    }


def _chosen_targets(predictor: PredictorNetwork, config: AdapterConfig) -> list[str]:
    """Return the targets with sets replaced by their layers; `all` excludes layers that are trained directly."""
    layers = _linear(predictor)
    kinds = {_last(name) for name in layers}
    sets = {**_SETS, "all": tuple(sorted(kinds - set(config.modules_to_save)))}
    targets = list(dict.fromkeys(layer for target in config.targets for layer in sets.get(target, (target,))))
    unknown = [target for target in targets if target not in kinds and target not in layers]
    if unknown or not targets:
        raise InputError(
            where="adapter.targets",
            found=", ".join(unknown) + " matches no layer of the predictor" if unknown else "no target",
            needed=f"some of {', '.join(sorted(kinds))}; or {', '.join(sets)}",
        )
    twice = sorted(set(targets) & set(config.modules_to_save))
    if twice:
        raise InputError(
            where="adapter.modules_to_save",
            found=f"{', '.join(twice)}, which adapter.targets names too",
            needed="each layer once: trained whole, or with an adapter",
        )
    return targets


def _linear(predictor: PredictorNetwork) -> list[str]:
    layers = ((name, layer) for name, layer in predictor.named_modules() if isinstance(layer, nn.Linear))
    return [name for name, _ in layers if name not in predictor.unused_layers]


def _last(name: str) -> str:
    return name.rpartition(".")[2]
