"""On what does a config compute? Asked before anything is loaded."""

from __future__ import annotations

import torch

from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.compilation import require_compiler

PRECISIONS = {"bf16": torch.bfloat16, "fp16": torch.float16, "fp32": torch.float32}


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
    if training.cuda_graph and on_cpu:
        raise InputError(
            where="training.cuda_graph", found="true, on a CPU", needed="a CUDA device", fix="Set it to false"
        )
    if training.compile == "blocks":
        require_compiler("cpu" if on_cpu else "cuda", where="training.compile")
    return on_cpu


def autocast(training: TrainingConfig, device: torch.device) -> torch.autocast:
    """Return the arithmetic that `training.precision` asks for, as Accelerate gives it to a run."""
    kind = None if training.precision == "fp32" else PRECISIONS[training.precision]
    return torch.autocast(device.type, dtype=kind, enabled=kind is not None)
