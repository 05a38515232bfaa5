"""Compilation of predictor blocks with torch.compile, in two halves: before and after attention.

Attention is not compiled here: SDPA is a single kernel, and FlexAttention is compiled separately (`attention`). The
halves therefore depend neither on the keys of earlier steps, whose number grows with every step, nor on a mask. Weights
are arguments, so that all blocks with the same kind of layers share one compilation. PyTorch compiles again for another
number of tokens or clips (then for any number), with and without gradients, and if nothing before a block is trained.

A failed compilation or recompilation is an error. PyTorch would continue without it, which is slow for a block, and
makes FlexAttention hold all scores in memory.
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
MAX_VARIANTS = 64  # that PyTorch may compile of one function: its default is 8

When = Literal["never", "with gradients", "always"]  # blocks are compiled
Function = TypeVar("Function", bound=Callable[..., Any])


def compile_function(function: Function, *, override: str, dynamic: bool | None = None) -> Function:
    """Return the compiled function, the same object for all callers; compilation happens at the first call.

    The compiled function raises `InputError` if it was already compiled for `MAX_VARIANTS` kinds of input.

    Args:
        function: The function, compiled as one graph.
        override: The setting that disables compilation, for the error message.
        dynamic: False: compile for each size separately; None: PyTorch decides.
    """
    return cast("Function", _compiled(function, BACKEND, override, dynamic))


@lru_cache(maxsize=1)
def has_triton() -> bool:
    """Return whether Triton is installed, without which nothing is compiled for CUDA."""
    return importlib.util.find_spec("triton") is not None


def missing_for_compilation(device: str) -> str | None:
    """Return what this machine lacks for compilation on a device type (cpu or cuda), or None."""
    if device == "cuda" and not has_triton():
        return "Triton is not installed"
    given = os.environ.get("CC" if device == "cuda" else "CXX")
    usual = ("gcc", "clang") if device == "cuda" else ("g++", "clang++")
    if any(map(shutil.which, (given,) if given else usual)):
        return None
    return f"no compiler is found ({given or ' or '.join(usual)})"


def require_compiler(device: str, *, where: str) -> None:
    """Check that blocks can be compiled on a device type.

    Args:
        device: The device type, cpu or cuda.
        where: The setting that requests compilation.

    Raises:
        InputError: The compiler is not installed; names what is missing.
    """
    missing = missing_for_compilation(device)
    if missing:
        hint = " (Triton comes with PyTorch for CUDA)" if device == "cuda" else ""
        raise InputError(where=where, found=f"blocks, but {missing}", fix=f"Set {where}=off, or install it{hint}")


@cache
def _compiled(function: Callable[..., Any], backend: str, override: str, dynamic: bool | None) -> Callable[..., Any]:
    from torch._dynamo import config
    from torch._dynamo.exc import FailOnRecompileLimitHit

    config.recompile_limit = max(config.recompile_limit, MAX_VARIANTS)
    # fullgraph: otherwise the limit is only a warning
    whole = torch.compile(function, backend=backend, fullgraph=True, dynamic=dynamic)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return whole(*args, **kwargs)
        except FailOnRecompileLimitHit as error:
            found = f"more than {config.recompile_limit} sizes of batches and clips, each of which needs a compilation"
            fix = f"Set {override}, or use fewer sizes"
            raise InputError(where=override.partition("=")[0], found=found, fix=fix) from error

    return call
