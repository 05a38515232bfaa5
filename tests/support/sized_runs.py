"""Configs of runs with given sizes, whose base model and data are never opened."""

from typing import Any

import torch

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel

LORA = {"rank": 4, "alpha": 8}


def run_config(adapter: dict[str, Any] | None = None, **changes: Any) -> Config:
    """Return the config of a run; `section__name` changes a config key."""
    values: dict[str, Any] = {
        "run_dir": "run", "data": {"path": "set", "frames": 6}, "model": {"base": "base"}, "adapter": adapter or LORA,
        "training": {"device": "cpu", "batch_size": 2, "rollout_steps": 2},
    }  # fmt: skip
    for key, value in changes.items():
        section, name = key.split("__")
        values[section] = {**values.get(section, {}), name: value}
    return parse_config(values, where="test")


def model_sizes(
    latent: int = 48, width: int = 48, depth: int = 2, heads: int = 2, mlp: float = 4.0, image: int = 64,
    *, extrinsics: bool = False, states: bool = True,
) -> ModelSizes:  # fmt: skip
    """Return the sizes of a model with patches of 16 pixels."""
    encoder = {"width": latent, "depth": 1, "heads": 2, "mlp_ratio": 2.0}
    predictor = {"width": width, "depth": depth, "heads": heads, "mlp_ratio": mlp, "use_extrinsics": extrinsics}
    predictor["use_states"] = states
    return ModelSizes.model_validate({"image_size": image, "encoder": encoder, "predictor": predictor})


def built(config: Config, sizes: ModelSizes) -> WorldModel:
    """Return a random model, prepared as for training."""
    dtype = torch.bfloat16 if config.model.dtype == "bfloat16" else torch.float32
    model = WorldModel.random(sizes, seed=0, dtype=dtype)
    add_adapter(model, config.adapter, seed=0)
    model.set_gradient_checkpointing(config.training.gradient_checkpointing)
    return model.train()  # type: ignore[return-value]
