"""Optimizer, parameter groups and learning rate schedule."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import nn

from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.errors import require_library

_BETAS = (0.9, 0.999)


def parameter_groups(module: nn.Module, weight_decay: float) -> list[dict[str, object]]:
    """Split the trained parameters into matrices, with weight decay, and biases and norms, without weight decay.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/utils.py, init_opt.
    """
    trained = [(name, parameter) for name, parameter in module.named_parameters() if parameter.requires_grad]
    decayed = [parameter for name, parameter in trained if parameter.ndim > 1 and not name.endswith("bias")]
    exempt = [parameter for name, parameter in trained if parameter.ndim <= 1 or name.endswith("bias")]
    groups = [{"params": decayed, "weight_decay": weight_decay}, {"params": exempt, "weight_decay": 0.0}]
    return [group for group in groups if group["params"]]


def make_optimizer(module: nn.Module, training: TrainingConfig) -> torch.optim.Optimizer:
    """Return the optimizer for the trained parameters. The training loop sets the learning rate before every step.

    AdamW on CUDA is fused: one kernel updates many tensors, and skips the update after an fp16 overflow without
    synchronizing with the host. Its rounding differs from that on a CPU.

    Raises:
        UnreachableError: The optimizer needs a library that is not installed.
    """
    groups = parameter_groups(module, training.weight_decay)
    if training.optimizer == "adamw_8bit":
        return _import_adamw_8bit()(groups, lr=training.learning_rate, betas=_BETAS)  # type: ignore[no-any-return]
    fused = True if _are_on_cuda(trained_parameters(module)) else None
    return torch.optim.AdamW(groups, lr=training.learning_rate, betas=_BETAS, fused=fused)


def require_optimizer(training: TrainingConfig) -> None:
    """Check that the library of the optimizer is installed.

    Raises:
        UnreachableError: The library is not installed.
    """
    if training.optimizer == "adamw_8bit":
        _import_adamw_8bit()


def _are_on_cuda(parameters: Iterable[nn.Parameter]) -> bool:
    return all(parameter.device.type == "cuda" for parameter in parameters)


def _import_adamw_8bit() -> Any:
    library = "bitsandbytes, which training.optimizer=adamw_8bit needs"
    return require_library("bitsandbytes.optim", where="training.optimizer", called=library, extra="8bit").AdamW8bit


def load_moments(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore the moments of an optimizer of the same kind; weight decay and betas keep their current values.

    `fused` also keeps its current value, because PyTorch chooses the device of the step counts by it.

    Raises:
        ValueError: The state belongs to another kind of optimizer, or to other parameters.
    """
    is_adamw = isinstance(optimizer, torch.optim.AdamW)  # bitsandbytes uses other names for the moments
    if any(("exp_avg" in moments) != is_adamw for moments in state["state"].values()):
        raise ValueError("the moments belong to another training.optimizer")
    current_settings = [
        {name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups
    ]
    groups = [group | settings for group, settings in zip(state["param_groups"], current_settings, strict=True)]
    optimizer.load_state_dict({**state, "param_groups": groups})


def learning_rate_at(step: int, training: TrainingConfig) -> float:
    """Return the learning rate of an optimizer step in 1..steps. There is no scheduler state to save.

    Source: warmup_stable_decay is facebookresearch/vjepa2 @ c2963a4, src/utils/schedulers.py, WSDSchedule.
    """
    peak, warmup = training.learning_rate, training.warmup_steps
    if step <= warmup:
        return peak * step / warmup
    if training.schedule == "cosine":
        progress = (step - warmup) / max(1, training.steps - warmup)
        return peak * 0.5 * (1.0 + math.cos(math.pi * min(1.0, progress)))
    decay_start = training.steps - training.decay_steps
    if step <= decay_start or not training.decay_steps:
        return peak
    return peak - peak * min(1.0, (step - decay_start) / training.decay_steps)


def describe_changed_rate(step: int, before: TrainingConfig, now: TrainingConfig) -> str:
    """Describe the learning rate at which a resumed run continues; empty if the config change does not affect it.

    Args:
        step: The last completed step.
        before: The config up to this step.
        now: The config for the following steps.
    """
    if not 0 < step < now.steps or learning_rate_at(step + 1, before) == (rate := learning_rate_at(step + 1, now)):
        return ""
    return (
        f"The learning rate continues at {rate:.1e} (it had reached {learning_rate_at(step, before):.2g} at step"
        f" {step:,}). Alternatives: training.learning_rate=RATE with training.schedule=warmup_stable_decay, and"
        " training.decay_steps=N for a decay at the end; or a new run, whose model.base is the folder that"
        " `vjepa2-ac export` writes"
    )


def trained_parameters(module: nn.Module) -> Iterable[nn.Parameter]:
    """Return the trained parameters of a module."""
    return (parameter for parameter in module.parameters() if parameter.requires_grad)
