"""The device of a config, and whether it supports the config's types: checked before anything is loaded."""

from __future__ import annotations

import logging
import math
import os
import time
from functools import cache, lru_cache

import torch
from torch import Tensor

from vjepa2_ac.config import ModelConfig, TrainingConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.compilation import require_compiler

_log = logging.getLogger(__name__)

PRECISIONS = {"bf16": torch.bfloat16, "fp16": torch.float16, "fp32": torch.float32}
_BF16_FROM = (8, 0)  # compute capability; PyTorch's is_bf16_supported includes emulation, which is slower than fp32
_CEILING_S = 0.2
_CUDA_MATRIX, _CPU_MATRIX = 8192, 512
_SLOW = 2.0  # times as long as in float32: of a CPU that computes bfloat16 without instructions for it


def is_on_cpu(training: TrainingConfig) -> bool:
    """Return whether a config computes on a CPU; else on CUDA.

    Raises:
        InputError: CUDA was requested and there is none.
    """
    has_cuda = torch.cuda.is_available()
    if training.device == "cuda" and not has_cuda:
        raise no_cuda(where="training.device", asked="cuda", instead="Set training.device=cpu")
    return training.device == "cpu" or not has_cuda


def no_cuda(*, where: str, asked: str, instead: str) -> InputError:
    """Return the error of a CUDA device where there is none."""
    fix = f"{instead}, or install a CUDA build of PyTorch and a driver"
    return InputError(where=where, found=f"{asked}, but this PyTorch sees no CUDA device", fix=fix)


def computing_device(training: TrainingConfig) -> torch.device:
    """Return the device of this process, after checking that it supports the config.

    On a CPU without instructions for bfloat16 a config that asks for it is warned of.

    Raises:
        InputError: CUDA was requested and there is none, fp16 without CUDA, bfloat16 on a GPU that has none, or nothing
            to compile with.
    """
    on_cpu = is_on_cpu(training)
    if training.precision == "fp16" and on_cpu:
        needed = "a CUDA device: only there are losses scaled so that small gradients do not vanish"
        fix = "Set training.precision=fp32"
        raise InputError(where="training.precision", found="fp16 on a CPU", needed=needed, fix=fix)
    device = torch.device("cpu") if on_cpu else torch.device("cuda", cuda_index())
    if training.precision == "bf16":  # fp32 is for float32 weights only, and fp16 casts any weights
        fix = f"Set training.precision={'fp32 with model.dtype=float32' if on_cpu else 'fp16'}"
        _require_bf16(device, where="training.precision", found="bf16", fix=fix)
    if training.compile == "blocks":
        require_compiler(device.type, where="training.compile")
    return device


def require_type_of_weights(model: ModelConfig, device: torch.device) -> None:
    """Refuse a weight type that the device does not support: planning computes in it, without autocast.

    On a CPU without instructions for bfloat16 it is warned of.

    Raises:
        InputError: They are bfloat16 on a GPU without it.
    """
    if model.dtype == "bfloat16":
        _require_bf16(device, where="model.dtype", found="bfloat16", fix="Set model.dtype=float32")


def slow_bf16() -> str | None:
    """Return what a product of matrices costs in bfloat16 on this CPU, if that is much slower than in float32.

    Measured here: which instructions a CPU has, and which of them PyTorch uses, no list of names tells.
    """
    cpu = torch.device("cpu")
    bf16, fp32 = (2e3 * _CPU_MATRIX**3 / matmul_speed(cpu, dtype) for dtype in (torch.bfloat16, torch.float32))
    if bf16 < _SLOW * fp32:
        return None
    return f"a product of matrices takes {bf16:.3g} ms on this CPU, {fp32:.3g} ms in float32 ({bf16 / fp32:.0f} times)"


@lru_cache(maxsize=8)
def matmul_speed(device: torch.device, dtype: torch.dtype) -> float:
    """Return the FLOPs per second of a large matrix product, the best within a fraction of a second.

    Measured once per device and type in a program: load by other programs affects it.
    """
    size = _CUDA_MATRIX if device.type == "cuda" else _CPU_MATRIX
    generator = torch.Generator(device).manual_seed(0)  # its own, so that training's random numbers do not change
    matrix = torch.randn(size, size, device=device, generator=generator).to(dtype)
    _product_s(matrix)  # warm-up
    best, ends = math.inf, time.perf_counter() + _CEILING_S
    while best == math.inf or time.perf_counter() < ends:
        best = min(best, _product_s(matrix))
    return 2 * size**3 / best


def has_bf16() -> bool:
    """Return whether the CUDA device of this process computes in bfloat16."""
    return torch.cuda.get_device_capability(cuda_index()) >= _BF16_FROM


def cuda_index() -> int:
    """Return the index of this process's CUDA device on its machine."""
    return int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count()


def autocast(training: TrainingConfig, device: torch.device) -> torch.autocast:
    """Return the arithmetic of `training.precision`, as Accelerate provides it."""
    kind = None if training.precision == "fp32" else PRECISIONS[training.precision]
    return torch.autocast(device.type, dtype=kind, enabled=kind is not None)


def _require_bf16(device: torch.device, *, where: str, found: str, fix: str) -> None:
    """Refuse bfloat16 where a GPU only emulates it; on a CPU that is slow in it, say so."""
    if device.type == "cpu":
        _warn(f"{where}: {found}", fix)
    if device.type != "cuda" or has_bf16():
        return
    major, minor = torch.cuda.get_device_capability(cuda_index())
    found += f", on {torch.cuda.get_device_name(cuda_index())} of compute capability {major}.{minor}"
    needed = "8.0 or more (Ampere or later): earlier GPUs only emulate bfloat16"
    raise InputError(where=where, found=found, needed=needed, fix=fix)


@cache  # once
def _warn(found: str, fix: str) -> None:
    if slow := slow_bf16():
        _log.warning("%s: %s. %s", found, slow, fix)


def _product_s(matrix: Tensor) -> float:
    _wait_for(matrix.device)
    started = time.perf_counter()
    torch.mm(matrix, matrix)
    _wait_for(matrix.device)
    return time.perf_counter() - started


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
