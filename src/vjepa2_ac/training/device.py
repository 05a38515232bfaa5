"""On what does a config compute? Asked before anything is loaded."""

from __future__ import annotations

import torch

from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.compilation import missing_for_compilation


def is_on_cpu(training: TrainingConfig) -> bool:
    """Return whether a run computes on a CPU; else on CUDA.

    Raises:
        InputError: CUDA was asked for and there is none, fp16 without CUDA, or nothing to compile with.
    """
    has_cuda = torch.cuda.is_available()
    if training.device == "cuda" and not has_cuda:
        raise InputError(
            where="training.device",
            found="cuda, but this PyTorch sees no CUDA device",
            fix="Set training.device=cpu, or install a CUDA build of PyTorch and a driver",
        )
    on_cpu = training.device == "cpu" or not has_cuda
    if training.precision == "fp16" and on_cpu:
        raise InputError(
            where="training.precision",
            found="fp16 on a CPU",
            needed="a CUDA device: only there are losses scaled so that small gradients do not vanish",
            fix="Set training.precision to bf16 or fp32",
        )
    missing = missing_for_compilation("cpu" if on_cpu else "cuda") if training.compile == "blocks" else None
    if missing:
        raise InputError(
            where="training.compile",
            found=f"blocks, but {missing}",
            fix="Set training.compile=off, or install it" + ("" if on_cpu else " (Triton comes with PyTorch for CUDA)"),
        )
    return on_cpu


def autocast(training: TrainingConfig, device: torch.device) -> torch.autocast:
    """Return the arithmetic that `training.precision` asks for, as Accelerate gives it to a run."""
    kinds = {"bf16": torch.bfloat16, "fp16": torch.float16}
    kind = kinds.get(training.precision)
    return torch.autocast(device.type, dtype=kind, enabled=kind is not None)
