"""What does PyTorch do otherwise where there is a GPU? It takes other attention, and many small tensors at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.nn.functional import pad
from torch.utils._python_dispatch import _disable_current_modes

from vjepa2_ac.model.network import attention

FAKE = FakeTensorMode()  # one for all rows: our code keeps tables from one call to the next
_MASK_ALIGNMENT = 16  # numbers
_replaced: list[tuple[object, str, Any]] = []
_seen_by_flex: dict[tuple[int, int], float] = {}  # by the numbers of queries and keys


@contextmanager
def fake_gpu() -> Iterator[None]:
    """Make tensors that have no numbers, and take what a GPU takes.

    Functions are replaced: a function mode would not be there in the thread in which autograd computes blocks again.
    """
    changes: list[tuple[object, str, Any]] = [
        (torch.nn.functional, "scaled_dot_product_attention", _attention),
        (attention, "scaled_dot_product_attention", _attention),
        (attention, "_IMPLEMENTATIONS", attention._IMPLEMENTATIONS | {"flex": _flex}),
        (attention, "has_triton", lambda: True),
        (torch.cuda.amp.common, "amp_definitely_not_available", lambda: False),
        (torch.cuda, "is_bf16_supported", lambda *_, **__: True),
        (import_module("torch.optim.optimizer"), "_foreach_supported_types", [FakeTensor]),
        (torch.utils._foreach_utils, "_foreach_supported_types", [FakeTensor]),
        (FakeTensor, "__deepcopy__", _copied),
        (nn.Module, "_apply", _applied),
    ]
    _replaced[:] = [(place, name, getattr(place, name)) for place, name, _ in changes]
    with _replacing(changes), FAKE:
        yield
    _replaced.clear()


@contextmanager
def no_fake_gpu() -> Iterator[None]:
    """Put back what `fake_gpu` replaced: `training.cost` measures on fake tensors of its own."""
    with _replacing(_replaced), _disable_current_modes():
        yield


@contextmanager
def _replacing(changes: list[tuple[object, str, Any]]) -> Iterator[None]:
    with ExitStack() as stack:
        for place, name, instead in changes:
            stack.enter_context(mock.patch.object(place, name, instead))
        yield


def _copied(own: Tensor, memo: dict[int, Any]) -> Tensor:
    """Return a copy in the same mode: PyTorch's own brings another, which the first does not take."""
    with torch.no_grad():
        copied = own.detach().clone()
    memo[id(own)] = nn.Parameter(copied, own.requires_grad) if isinstance(own, nn.Parameter) else copied
    return memo[id(own)]  # type: ignore[no-any-return]  # a memo's


def _applied(module: nn.Module, change: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
    """Do what moves and casts weights, by replacing them: PyTorch cannot change fake ones where they are."""
    for child in module.children() if recurse else ():
        _applied(child, change)
    for name, own in module._parameters.items():
        if own is not None:
            module._parameters[name] = nn.Parameter(change(own.detach()), own.requires_grad)
    for name, held in module._buffers.items():
        module._buffers[name] = None if held is None else change(held)
    return module


def share_seen(queries: int, keys: int) -> float:
    """Return the share of pairs of a query and a key that FlexAttention's mask leaves."""
    return _seen_by_flex[queries, keys]


def _attention(
    query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor | None = None, dropout_p: float = 0.0,
    is_causal: bool = False, scale: float | None = None, enable_gqa: bool = False,
) -> Tensor:  # fmt: skip
    """Return what `scaled_dot_product_attention` takes on a GPU: flash, or efficient with a mask or in float32."""
    assert not is_causal
    assert not enable_gqa
    query, key, value = _as_autocast(query, key, value)
    if attn_mask is None and query.dtype != torch.float32:
        flash = torch.ops.aten._scaled_dot_product_flash_attention
        return flash(query, key, value, dropout_p, scale=scale)[0]  # type: ignore[no-any-return]  # ops have no types
    mask = None if attn_mask is None else _added(attn_mask, query, key)
    backward = torch.is_grad_enabled() and any(given.requires_grad for given in (query, key, value))
    efficient = torch.ops.aten._scaled_dot_product_efficient_attention
    return efficient(query, key, value, mask, backward, dropout_p, scale=scale)[0]  # type: ignore[no-any-return]


def _as_autocast(*given: Tensor) -> tuple[Tensor, ...]:
    if not torch.is_autocast_enabled("cuda"):
        return given
    return tuple(one.to(torch.get_autocast_dtype("cuda")) for one in given)


def _added(mask: Tensor, query: Tensor, key: Tensor) -> Tensor:
    """Return a mask as the efficient kernel wants it: numbers to add, rows aligned, for every batch and head.

    Source: pytorch @ v2.13, aten/src/ATen/native/transformers/attention.cpp, convert_boolean_attn_mask and
    preprocess_mask.
    """
    if mask.dtype == torch.bool:
        zero, minus_infinity = (query.new_full((), number) for number in (0.0, float("-inf")))
        mask = torch.where(mask, zero, minus_infinity)
    keys = key.shape[2]
    if keys % _MASK_ALIGNMENT:
        mask = pad(mask, (0, -keys % _MASK_ALIGNMENT))[..., :keys]
    return mask.expand(*query.shape[:3], keys)


def _flex(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:
    """Stand in for compiled FlexAttention, which without a compiler would make the whole matrix: one flash operation.

    It is marked as causal, by which `share_seen` is asked for its arithmetic.
    """
    query, key, value = _as_autocast(query, key, value)
    steps, before = query.shape[2] // tokens_per_step, (key.shape[2] - query.shape[2]) // tokens_per_step
    seen = sum(range(before + 1, before + steps + 1)) / (steps * (before + steps))
    _seen_by_flex[query.shape[2], key.shape[2]] = seen
    return torch.ops.aten._scaled_dot_product_flash_attention(query, key, value, 0.0, True)[0]  # type: ignore[no-any-return]
