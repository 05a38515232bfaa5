"""FSDP2: processes share the trained weights and not only the clips, for a predictor trained whole.

`accelerate launch --use_fsdp --fsdp_version 2` requests it: it sets ACCELERATE_USE_FSDP and FSDP_VERSION for each
process. A process then holds a part of each weight, gradient and moment; a block's weights are gathered where it
computes. Gradients are summed over the processes after every micro-batch, so no process may be without a clip. The
frozen encoder stays whole. A checkpoint has the format that one process alone writes: a run resumes from it with or
without FSDP2.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from vjepa2_ac.config import Config
from vjepa2_ac.distributed.launch import shares_weights
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.training.optim import make_optimizer


def shard_predictor(
    world_model: WorldModel,
    optimizer: torch.optim.Optimizer,
    config: Config,
    accelerator: Accelerator,
    reporter: Reporter,
) -> torch.optim.Optimizer:
    """Give each process its part of the predictor's weights and moments, if the launch requests it.

    All processes have to bring the same weights and moments.

    Returns:
        The optimizer of this process's part; the given one if nothing is shared.
    """
    if not shares_weights() or accelerator.num_processes == 1:
        return optimizer
    # The predictor ends in a view, which is never changed in place.
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module .* returned a view tensor", category=UserWarning)
    mesh = init_device_mesh(accelerator.device.type, (accelerator.num_processes,))
    predictor = world_model.base_predictor
    for module in (*predictor.blocks, predictor):
        # The outermost, too, or its weights would be whole after a validation, when the optimizer needs its parts.
        part = fully_shard(module, mesh=mesh, reshard_after_forward=True)
        part.set_gradient_divide_factor(1.0)  # a sum, as without shards: `step` divides
        part.set_force_sum_reduction_for_comms(True)  # otherwise it is scaled on the way, which gloo cannot do
    of_part = make_optimizer(world_model, config.training)
    of_part.load_state_dict(_parted(optimizer.state_dict(), of_part))
    reporter.note(
        f"{accelerator.num_processes} processes share the predictor's weights, gradients and moments (FSDP2):"
        f" {_own_numbers(predictor):,} weights are in this one."
    )
    return of_part


def full_state_dict(world_model: WorldModel, *, keep: bool) -> dict[str, Tensor] | None:
    """Return the predictor's weights, gathered on the CPU; None if they are not shared.

    All processes have to call this.

    Args:
        world_model: The model.
        keep: Whether this process needs them: the others take part in gathering, and get empty ones.
    """
    if not isinstance(world_model.predictor, FSDPModule):
        return None
    weights: dict[str, Tensor] = _whole(world_model.predictor.state_dict(), keep)
    return weights


def full_optimizer_state_dict(optimizer: torch.optim.Optimizer, *, keep: bool) -> dict[str, Any]:
    """Return the state of an optimizer, its shared parts gathered on the CPU. All processes have to call this.

    Args:
        optimizer: The optimizer.
        keep: As with `full_state_dict`.
    """
    state: dict[str, Any] = _whole(optimizer.state_dict(), keep)
    return state


def _own_numbers(predictor: nn.Module) -> int:
    return sum(p.to_local().numel() for p in predictor.parameters() if isinstance(p, DTensor))


def _parted(state: dict[str, Any], optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Convert the state of an optimizer over whole weights into that of one over parts; nothing is sent."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    parted = {
        index: {name: _like(parameters[index], value) for name, value in values.items()}
        for index, values in state["state"].items()
    }
    return {**state, "state": parted}


def _like(parameter: DTensor, value: Tensor) -> Tensor:
    if value.shape != parameter.shape:  # the step count
        return value
    return distribute_tensor(value, parameter.device_mesh, parameter.placements, src_data_rank=None)


def _whole(value: Any, keep: bool) -> Any:
    """Gather every tensor in nested dicts and lists, one after the other, in the same order in all processes."""
    if isinstance(value, DTensor):
        together = value.full_tensor()
        return together.cpu() if keep else together.new_empty(0)
    if isinstance(value, Mapping):
        return {key: _whole(inner, keep) for key, inner in value.items()}
    if isinstance(value, list):
        return [_whole(inner, keep) for inner in value]
    return value
