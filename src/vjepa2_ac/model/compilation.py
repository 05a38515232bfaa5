"""Compilation of predictor blocks with torch.compile, in two halves: before and after attention.

Attention is not compiled here: SDPA is a single kernel, and FlexAttention is compiled separately (`attention`). The
halves therefore depend neither on the keys of earlier steps, whose number grows with every step, nor on a mask. Weights
are arguments, so all blocks with the same kinds of layers share one compilation. PyTorch compiles again if the number
of tokens or clips changes for the first time (the new code supports any number), if gradients are enabled or disabled,
and if the tokens need no gradient because no earlier layer is trained.

A failed compilation or recompilation is an error. PyTorch would continue with uncompiled code, which is slow for a
block and makes FlexAttention store all attention scores in memory.
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
MAX_VARIANTS = 64  # limit of compiled variants per function; PyTorch's default is 8

When = Literal["never", "with gradients", "always"]  # when blocks are compiled
Function = TypeVar("Function", bound=Callable[..., Any])


def compile_function(function: Function, *, override: str, dynamic: bool | None = None) -> Function:
    """Return the compiled function. It is compiled at its first call, and equal arguments return the same object.

    The compiled function raises `InputError` if it was already compiled for `MAX_VARIANTS` kinds of input.

    Args:
        function: The function, which must be compilable as one graph.
        override: The setting that disables compilation, for the error message.
        dynamic: False: every size is compiled separately; None: PyTorch decides.
    """
    return cast("Function", _compiled(function, BACKEND, override, dynamic))


@lru_cache(maxsize=1)
def has_triton() -> bool:
    """Return whether Triton is installed, which compilation for CUDA needs."""
    return importlib.util.find_spec("triton") is not None


def describe_missing_compiler(device: str) -> str | None:
    """Describe what is missing on this machine for compilation on a device type (cpu or cuda); None if nothing is."""
    if device == "cuda" and not has_triton():
        return "Triton is not installed"
    variable, compilers = ("CC", ("gcc", "clang")) if device == "cuda" else ("CXX", ("g++", "clang++"))
    configured = os.environ.get(variable)
    if any(map(shutil.which, (configured,) if configured else compilers)):
        return None
    if configured:
        return f"the compiler {configured} (environment variable {variable}) is not installed"
    return f"no C{'' if device == 'cuda' else '++'} compiler is installed ({' or '.join(compilers)})"


def require_compiler(device: str, *, where: str) -> None:
    """Check that predictor blocks can be compiled for a device type.

    Args:
        device: The device type, cpu or cuda.
        where: The setting that requests compilation.

    Raises:
        InputError: A compiler or Triton is not installed; the message names it.
    """
    missing = describe_missing_compiler(device)
    if missing:
        hint = " (Triton comes with PyTorch for CUDA)" if device == "cuda" else ""
        fix = f"Install what is missing{hint}, or set {where}=off"
        raise InputError(where=where, found=f"blocks is not possible: {missing}", fix=fix)


@cache
def _compiled(function: Callable[..., Any], backend: str, override: str, dynamic: bool | None) -> Callable[..., Any]:
    from torch._dynamo import config
    from torch._dynamo.exc import FailOnRecompileLimitHit

    config.recompile_limit = max(config.recompile_limit, MAX_VARIANTS)
    # Without fullgraph=True PyTorch only warns when the limit is reached.
    compiled = torch.compile(function, backend=backend, fullgraph=True, dynamic=dynamic)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return compiled(*args, **kwargs)
        except FailOnRecompileLimitHit as error:
            problem = (
                f"more than {config.recompile_limit} sizes of batches and clips, each of which needs a compilation"
            )
            fix = f"Set {override}, or use fewer sizes"
            raise InputError(where=override.partition("=")[0], found=problem, fix=fix) from error

    return call
