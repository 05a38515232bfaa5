"""How do processes share the weights that they train, and not only the clips? FSDP2, for a predictor trained whole.

`accelerate launch --use_fsdp --fsdp_version 2` asks for it: it sets ACCELERATE_USE_FSDP and FSDP_VERSION for each
process. A process then keeps a part of each weight, gradient and moment; a block's weights are put together where it
computes. Gradients are summed over the processes after every micro-batch, so no process may be without a clip. The
frozen encoder stays whole, and a checkpoint is what one process alone writes: it goes on shared or not.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.optim import make_optimizer

_OTHER_WAYS = {
    "ACCELERATE_USE_DEEPSPEED": "DeepSpeed",
    "ACCELERATE_USE_MEGATRON_LM": "Megatron-LM",
    "ACCELERATE_USE_PARALLELISM_CONFIG": "a parallelism config",
}
_OPTIONS = {  # that would do nothing, and are not known by their default
    "FSDP_OFFLOAD_PARAMS": ("--fsdp_offload_params true", "start without it"),
    "FSDP_ACTIVATION_CHECKPOINTING": (
        "--fsdp_activation_checkpointing true",
        "start without it, and set training.gradient_checkpointing=true",
    ),
}


def check_launch(config: Config, environment: Mapping[str, str] = os.environ) -> None:
    """Refuse ways to share a model that this program does not know, and runs that FSDP2 cannot share.

    Raises:
        InputError: Any of these, with the way out.
    """
    for name, way in _OTHER_WAYS.items():
        if _is_set(environment, name):
            raise _refusal(way, "processes that share clips, or weights by FSDP2", "Start it without that")
    if not _is_set(environment, "ACCELERATE_USE_FSDP"):
        return
    version = environment.get("FSDP_VERSION", "1")
    if version != "2":
        raise _refusal(f"FSDP version {version}", "version 2", "Add --fsdp_version 2")
    _check_run(config)
    for name, (option, way_out) in _OPTIONS.items():
        if _is_set(environment, name):
            raise _refusal(option, "FSDP2 without it", way_out[0].upper() + way_out[1:])


def share_if_asked(
    world_model: WorldModel,
    optimizer: torch.optim.Optimizer,
    config: Config,
    accelerator: Accelerator,
    note: Callable[[str], None],
) -> torch.optim.Optimizer:
    """Leave each process its part of the predictor's weights and of the moments, where the launch asks for that.

    All processes have to bring the same weights and moments.

    Returns:
        The optimizer of this process's part; the given one where nothing is shared.
    """
    if not _is_set(os.environ, "ACCELERATE_USE_FSDP") or accelerator.num_processes == 1:
        return optimizer
    # The predictor ends in a view, which nobody changes in place.
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module .* returned a view tensor", category=UserWarning)
    mesh = init_device_mesh(accelerator.device.type, (accelerator.num_processes,))
    predictor = world_model.base_predictor
    for module in (*predictor.blocks, predictor):
        # The outermost, too, or its weights would be whole after a validation, when the optimizer looks for its parts.
        part = fully_shard(module, mesh=mesh, reshard_after_forward=True)
        part.set_gradient_divide_factor(1.0)  # a sum, as without shards: `step` makes means
        part.set_force_sum_reduction_for_comms(True)  # or it is scaled on the way, which gloo cannot do
    of_part = make_optimizer(world_model, config.training)
    of_part.load_state_dict(_parted(optimizer.state_dict(), of_part))
    note(
        f"{accelerator.num_processes} processes share the predictor's weights, gradients and moments (FSDP2):"
        f" {_own_numbers(predictor):,} weights are in this one."
    )
    return of_part


def whole_weights(world_model: WorldModel, *, keep: bool) -> dict[str, Tensor] | None:
    """Return the predictor's weights, put together on the CPU; None where they are not shared.

    All processes have to call.

    Args:
        world_model: The model.
        keep: Whether this process wants them: the others help to put them together, and get empty ones.
    """
    if not isinstance(world_model.predictor, FSDPModule):
        return None
    weights: dict[str, Tensor] = _whole(world_model.predictor.state_dict(), keep)
    return weights


def whole_moments(optimizer: torch.optim.Optimizer, *, keep: bool) -> dict[str, Any]:
    """Return the state of an optimizer, what is shared of it put together on the CPU. All processes have to call.

    Args:
        optimizer: The optimizer.
        keep: As with `whole_weights`.
    """
    state: dict[str, Any] = _whole(optimizer.state_dict(), keep)
    return state


def _check_run(config: Config) -> None:
    """Refuse runs whose weights FSDP2 cannot share."""
    if config.adapter.kind == "lora":
        raise _refusal(
            "FSDP with adapter.kind lora",
            "adapter.kind none: an adapter needs no shards",
            "Start without --use_fsdp",
        )
    if config.training.optimizer == "adamw_8bit":
        raise _refusal("FSDP with training.optimizer adamw_8bit", "adamw", "Set training.optimizer=adamw")
    if config.training.compile != "off":
        raise _refusal(
            "FSDP with training.compile blocks", "off: together they are untried", "Set training.compile=off"
        )
    if config.training.cuda_graph:
        raise _refusal("FSDP with training.cuda_graph", "false: together they are untried", "Set it to false")
    if config.data.broken_episodes == "skip":
        raise _refusal(
            "FSDP with data.broken_episodes skip",
            "clips for every process: one without would leave the others waiting",
            "Set data.broken_episodes=error, or start without --use_fsdp",
        )


def _is_set(environment: Mapping[str, str], name: str) -> bool:
    return environment.get(name, "false").lower() in {"1", "true", "yes", "on"}


def _refusal(found: str, needed: str, fix: str) -> InputError:
    return InputError(where="accelerate launch", found=found, needed=needed, fix=fix)


def _own_numbers(predictor: nn.Module) -> int:
    return sum(p.to_local().numel() for p in predictor.parameters() if isinstance(p, DTensor))


def _parted(state: dict[str, Any], optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the state of an optimizer over whole weights as that of one over parts; nothing is sent."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    parted = {
        index: {name: _like(parameters[index], value) for name, value in values.items()}
        for index, values in state["state"].items()
    }
    return {**state, "state": parted}


def _like(parameter: DTensor, value: Tensor) -> Tensor:
    if value.shape != parameter.shape:  # the count of steps
        return value
    return distribute_tensor(value, parameter.device_mesh, parameter.placements, src_data_rank=None)


def _whole(value: Any, keep: bool) -> Any:
    """Put together every tensor in nested dicts and lists, one after the other, in the same order in all processes."""
    if isinstance(value, DTensor):
        together = value.full_tensor()
        return together.cpu() if keep else together.new_empty(0)
    if isinstance(value, Mapping):
        return {key: _whole(inner, keep) for key, inner in value.items()}
    if isinstance(value, list):
        return [_whole(inner, keep) for inner in value]
    return value
