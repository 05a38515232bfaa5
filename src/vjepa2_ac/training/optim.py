"""The optimizer: trained parameters, update rule, and learning rate schedule."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.model.network.pretrained_folder import first_not_finite

_MOST_STEPS = 2**53  # larger counts are not exact in float64


def parameter_groups(module: nn.Module, weight_decay: float) -> list[dict[str, object]]:
    """Split the trained parameters into matrices, which decay, and biases and norms, which do not.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/utils.py, init_opt.
    """
    trained = [(name, parameter) for name, parameter in module.named_parameters() if parameter.requires_grad]
    decayed = [parameter for name, parameter in trained if parameter.ndim > 1 and not name.endswith("bias")]
    exempt = [parameter for name, parameter in trained if parameter.ndim <= 1 or name.endswith("bias")]
    groups = [{"params": decayed, "weight_decay": weight_decay}, {"params": exempt, "weight_decay": 0.0}]
    return [group for group in groups if group["params"]]


def make_optimizer(module: nn.Module, training: TrainingConfig) -> torch.optim.Optimizer:
    """Return the optimizer of the trained parameters. The learning rate is set before every step.

    AdamW on CUDA is fused: one kernel updates many tensors, and after an overflow in fp16 it updates none without
    involving the host. It rounds differently than on a CPU.

    Raises:
        InputError: It needs a library that is not installed.
    """
    groups = parameter_groups(module, training.weight_decay)
    if training.optimizer == "adamw_8bit":
        return _adamw_8bit()(groups, lr=training.learning_rate, betas=training.betas)  # type: ignore[no-any-return]
    fused = True if _are_on_cuda(trained_parameters(module)) else None
    return torch.optim.AdamW(groups, lr=training.learning_rate, betas=training.betas, fused=fused)


def require_optimizer(training: TrainingConfig) -> None:
    """Check that the optimizer is installed.

    Raises:
        InputError: It needs a library that is not installed.
    """
    if training.optimizer == "adamw_8bit":
        _adamw_8bit()


def _are_on_cuda(parameters: Iterable[nn.Parameter]) -> bool:
    return all(parameter.device.type == "cuda" for parameter in parameters)


def _adamw_8bit() -> Any:
    try:
        from bitsandbytes.optim import AdamW8bit
    except ImportError:
        raise InputError(
            where="training.optimizer",
            found="adamw_8bit, but bitsandbytes is not installed",
            fix=f"Run {pip_install('8bit')}, or set training.optimizer=adamw",
        ) from None
    return AdamW8bit


def load_moments(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore the state of an optimizer of the same kind; weight decay and betas keep their current values.

    The same holds for `fused`, by which PyTorch decides on the device of the step counts.

    Raises:
        ValueError: The state is of another kind of optimizer, or of other parameters, or not finite.
    """
    # Names of PyTorch and of bitsandbytes.
    first, second = ("exp_avg", "exp_avg_sq") if isinstance(optimizer, torch.optim.AdamW) else ("state1", "state2")
    known = (
        isinstance(state, dict) and isinstance(state.get("state"), dict) and isinstance(state.get("param_groups"), list)
    )
    if not known or not all(isinstance(moments, dict) for moments in state["state"].values()):
        raise ValueError("it is not the state of an optimizer")
    flat = {number: _flat(moments) for number, moments in state["state"].items()}
    if any(first not in moments for moments in flat.values()):
        raise ValueError("its moments are of another training.optimizer")
    _require_shapes(optimizer, flat, first)
    for number, moments in flat.items():
        if lacking := {second, "step"} - moments.keys():
            raise ValueError(f"{min(lacking)} of parameter {number} is missing")
        tensors = {name: value for name, value in moments.items() if isinstance(value, Tensor)}
        if (name := first_not_finite(tensors)) is not None:
            raise ValueError(f"{name} of parameter {number} holds NaN or infinity")
        if not _is_count(moments["step"]):
            raise ValueError(f"step of parameter {number} is no count of steps")
    own = [{name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups]
    groups = [group | settings for group, settings in zip(state["param_groups"], own, strict=False)]
    left = state["param_groups"][len(own) :]  # which PyTorch refuses
    optimizer.load_state_dict({**state, "param_groups": groups + left})


def _is_count(step: object) -> bool:
    """Return whether this is a possible step count of an optimizer: powers of its betas have to exist."""
    if isinstance(step, Tensor):
        return step.numel() == 1 and 1 <= float(step) <= _MOST_STEPS
    return isinstance(step, int | float) and 1 <= step <= _MOST_STEPS


def _flat(moments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the moments of a parameter by name: bitsandbytes stores its own in a nested dict."""
    groups = [value for value in moments.values() if isinstance(value, Mapping)]
    return {name: value for group in (moments, *groups) for name, value in group.items()}


def _require_shapes(optimizer: torch.optim.Optimizer, moments: Mapping[Any, Any], first: str) -> None:
    """Refuse moments of other shapes than their parameters, which nothing else checks before the first step."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for place, of_one in moments.items():
        if type(place) is not int or not 0 <= place < len(parameters):
            raise ValueError(f"moments of a parameter {place!r}, of {len(parameters)}")
        shape = getattr(of_one[first], "shape", None)
        if isinstance(optimizer, torch.optim.AdamW) and shape != parameters[place].shape:
            raise ValueError(f"moments of shape {shape} for a parameter of shape {tuple(parameters[place].shape)}")


def learning_rate_at(step: int, training: TrainingConfig) -> float:
    """Return the learning rate of optimizer step 1..steps: a pure function, so there is no scheduler to save.

    Raises:
        ValueError: A step before 1.

    Source: warmup_stable_decay is facebookresearch/vjepa2 @ c2963a4, src/utils/schedulers.py, WSDSchedule.
    """
    if step < 1:
        raise ValueError(f"optimizer steps count from 1, got {step}")
    start, peak, final = training.start_learning_rate, training.learning_rate, training.final_learning_rate
    if step <= training.warmup_steps:
        return start + (peak - start) * step / training.warmup_steps
    if training.schedule == "constant":
        return peak
    done = min(1.0, (step - training.warmup_steps) / max(1, training.steps - training.warmup_steps))
    if training.schedule == "cosine":
        return final + (peak - final) * 0.5 * (1.0 + math.cos(math.pi * done))
    if training.schedule == "linear":
        return peak + (final - peak) * done
    first_decay = training.steps - training.decay_steps
    if step <= first_decay:
        return peak
    return peak + (final - peak) * min(1.0, (step - first_decay) / training.decay_steps)


def set_learning_rate(optimizer: torch.optim.Optimizer, learning_rate: float) -> None:
    """Set the learning rate of every group."""
    for group in optimizer.param_groups:
        group["lr"] = learning_rate


def trained_parameters(module: nn.Module) -> Iterable[nn.Parameter]:
    """Return the parameters of the optimizer."""
    return (parameter for parameter in module.parameters() if parameter.requires_grad)
