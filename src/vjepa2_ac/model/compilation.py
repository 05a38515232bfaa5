"""Compilation of predictor blocks in halves, before and after attention, once for all blocks.

Attention is not compiled here: SDPA is one kernel already, and FlexAttention is compiled by itself (`attention`). So no
half sees keys of earlier steps, whose number grows with every step, and a mask is no part of it. Weights are arguments:
all blocks with the same kind of layers share what was compiled for the first of them. PyTorch compiles again for
another number of tokens or clips (then for any), with and without gradients, and where nothing before a block is
trained.

A failed compilation or recompilation is an error: PyTorch would continue without it, which is slow for a block, and for
FlexAttention holds all scores in memory.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Callable
from functools import cache, lru_cache, wraps
from typing import Any, Literal, TypeVar, cast

import torch

from vjepa2_ac.errors import InputError

BACKEND = "inductor"
VARIANTS = 64  # that PyTorch may compile of one function: its default is 8

When = Literal["never", "with gradients", "always"]  # blocks are compiled
Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function, *, way_out: str, dynamic: bool | None = None) -> Function:
    """Return the compiled function, the same object for all callers; it is compiled when called.

    The compiled function raises `InputError` if it was compiled for `VARIANTS` kinds of input already.

    Args:
        function: Compiled as one graph.
        way_out: The setting that disables compilation.
        dynamic: False: for each size separately; None: PyTorch decides.
    """
    return cast("Function", _compiled(function, BACKEND, way_out, dynamic))


@lru_cache(maxsize=1)
def has_triton() -> bool:
    """Return whether Triton is installed, without which nothing is compiled for CUDA."""
    return importlib.util.find_spec("triton") is not None


def missing_for_compilation(device: str) -> str | None:
    """Return what this machine lacks to compile for a kind of device, cpu or cuda; None if nothing."""
    if device == "cuda" and not has_triton():
        return "Triton is not installed"
    given = os.environ.get("CC" if device == "cuda" else "CXX")
    usual = ("gcc", "clang") if device == "cuda" else ("g++", "clang++")
    if any(map(shutil.which, (given,) if given else usual)):
        return None
    return f"no compiler is found ({given or ' or '.join(usual)})"


def require_compiler(device: str, *, where: str) -> None:
    """Refuse to compile blocks for a kind of device, cpu or cuda, without a compiler.

    Args:
        device: The kind of device.
        where: The setting that requests it.

    Raises:
        InputError: There is none; says what is missing.
    """
    missing = missing_for_compilation(device)
    if missing:
        hint = " (Triton comes with PyTorch for CUDA)" if device == "cuda" else ""
        raise InputError(where=where, found=f"blocks, but {missing}", fix=f"Set {where}=off, or install it{hint}")


@cache
def _compiled(function: Callable[..., Any], backend: str, way_out: str, dynamic: bool | None) -> Callable[..., Any]:
    from torch._dynamo import config
    from torch._dynamo.exc import FailOnRecompileLimitHit

    config.recompile_limit = max(config.recompile_limit, VARIANTS)
    # fullgraph: otherwise the limit is only a warning
    whole = torch.compile(function, backend=backend, fullgraph=True, dynamic=dynamic)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return whole(*args, **kwargs)
        except FailOnRecompileLimitHit as error:
            found = f"more than {config.recompile_limit} sizes of batches and clips, each of which is compiled anew"
            fix = f"Set {way_out}, or use fewer sizes"
            raise InputError(where=way_out.partition("=")[0], found=found, fix=fix) from error

    return call
