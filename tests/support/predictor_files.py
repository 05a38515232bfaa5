"""A file of a predictor alone, in the layout in which jepa-wms publishes its V-JEPA 2-AC: no states, no encoder."""

from pathlib import Path

import torch
from torch import Tensor

from vjepa2_ac.model.world_model import WorldModel

BLOCK = ("norm1", "attn.qkv", "attn.proj", "norm2", "mlp.fc1", "mlp.fc2")
OUTSIDE = ("predictor_embed", "action_encoder", "predictor_norm", "predictor_proj")


def names_in_file(depth: int) -> set[str]:
    """Return the names of its tensors, each twice: weight and bias."""
    inside = [f"predictor_blocks.{index}.{part}" for index in range(depth) for part in BLOCK]
    return {f"module.{name}.{kind}" for name in (*OUTSIDE, *inside) for kind in ("weight", "bias")}


def write_predictor_file(path: Path, model: WorldModel) -> Path:
    """Write the predictor of a model without states; optimizer and scaler are there, and hold nothing of use."""
    ours: dict[str, Tensor] = model.predictor.state_dict()
    weights: dict[str, Tensor] = {}
    for name in names_in_file(model.sizes.predictor.depth):
        own = name.removeprefix("module.").replace("predictor_blocks.", "blocks.").replace(".attn.proj.", ".attn.o.")
        thirds = [own.replace(".qkv.", f".{part}.") for part in "qkv"] if ".qkv." in own else [own]
        weights[name] = torch.cat([ours[one] for one in thirds])
    moments = {index: {"step": torch.tensor(9.0), "exp_avg": value} for index, value in enumerate(weights.values())}
    opt = {"state": moments, "param_groups": [{"lr": 1e-4, "params": list(moments)}]}
    torch.save({"predictor": weights, "opt": opt, "scaler": None, "epoch": 9}, path)
    return path
