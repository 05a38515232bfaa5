"""What is compiled? Halves of a predictor block, what comes before attention and what after it, once for all blocks.

Attention stays as it is: SDPA is one kernel already, and FlexAttention is compiled by itself. So nothing that is
compiled sees keys of earlier steps, whose number grows with every step, and a mask is no part of it. Weights are
arguments: all blocks with the same kind of layers share what was compiled for the first of them. PyTorch compiles
again for another number of tokens or clips (then for any), with and without gradients, and where nothing before a
block is trained.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from typing import Any, Literal, TypeVar, cast

import torch

from vjepa2_ac.errors import InputError
from vjepa2_ac.model.attention import has_triton

BACKEND = "inductor"
VARIANTS = 24  # that PyTorch may compile of one function; it gives up, with a warning, at 8 if nothing is said

When = Literal["never", "with gradients", "always"]  # blocks are compiled
Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function compiled, the same for all who ask; it is compiled when it is called."""
    return cast("Function", _compiled(function, BACKEND))


def missing_for_compilation(device: str) -> str | None:
    """Return what this machine lacks to compile for a kind of device: cpu or cuda; None where it lacks nothing."""
    if device == "cuda" and not has_triton():
        return "Triton is not installed"
    given = os.environ.get("CC" if device == "cuda" else "CXX")
    usual = ("gcc", "clang") if device == "cuda" else ("g++", "clang++")
    if any(map(shutil.which, (given,) if given else usual)):
        return None
    return f"no compiler is found ({given or ' or '.join(usual)})"


def require_compiler(device: str, *, where: str) -> None:
    """Refuse to compile blocks for a kind of device, cpu or cuda, where nothing can.

    Args:
        device: What for.
        where: The setting that asks for it.

    Raises:
        InputError: Nothing can; says what is missing.
    """
    missing = missing_for_compilation(device)
    if missing:
        hint = " (Triton comes with PyTorch for CUDA)" if device == "cuda" else ""
        raise InputError(where=where, found=f"blocks, but {missing}", fix=f"Set {where}=off, or install it{hint}")


@cache
def _compiled(function: Callable[..., Any], backend: str) -> Callable[..., Any]:
    from torch._dynamo import config

    config.recompile_limit = max(config.recompile_limit, VARIANTS)
    return torch.compile(function, backend=backend)
