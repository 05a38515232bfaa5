"""Low-rank update of a frozen linear layer, computed within its matrix products. Needs only PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear


class LowRankLayer:
    """A layer with a low-rank update whose two matrices can be cast for all micro-steps at once (`CastMatrices`)."""

    cast: tuple[Tensor, Tensor] | None = (
        None  # copies in the data type of the arithmetic, during `CastMatrices.current`
    )

    def matrices(self) -> tuple[Tensor, ...]:
        """Return the two matrices; empty if PEFT computes this layer."""
        raise NotImplementedError


def low_rank_linear(
    tokens: Float[Tensor, "*batch inputs"],
    layer: nn.Linear,
    update: LowRankLayer,
    dropout: nn.Module | None,
    scale: float,
) -> Tensor:
    """Return the output of a frozen layer and its update, computed in the data type of the tokens.

    Args:
        tokens: The input.
        layer: The frozen layer.
        update: The layer with the two matrices.
        dropout: Dropout on the input of the update, or None.
        scale: The scale of the update.
    """
    dtype, matrices = tokens.dtype, update.matrices()
    cast: tuple[Tensor | None, ...]
    if update.cast is not None and update.cast[0].dtype == dtype:
        cast = update.cast
    else:
        cast = tuple(None if one.dtype == dtype else one.detach().to(dtype) for one in matrices)
    weight, bias = (None if own is None else own.to(dtype) for own in (layer.weight, layer.bias))
    masked = None if dropout is None else dropout(tokens)
    apply: Callable[..., Tensor] = _LowRankLinear.apply
    return apply(tokens, masked, weight, bias, *matrices, *cast, scale)


class CastMatrices:
    """The matrices of adapters in the data type of the arithmetic, cast together once per step instead of at each use.

    Args:
        module: The module with the adapters.
        dtype: The data type of the arithmetic.
    """

    def __init__(self, module: nn.Module, dtype: torch.dtype) -> None:
        self._layers = [
            layer
            for layer in module.modules()
            if isinstance(layer, LowRankLayer) and [one.dtype != dtype for one in layer.matrices()] == [True, True]
        ]
        self._own = [one for layer in self._layers for one in layer.matrices()]
        self._cast = [torch.empty_like(one, dtype=dtype, requires_grad=False) for one in self._own]

    @contextmanager
    def current(self) -> Iterator[None]:
        """Cast now, and make all layers use the copies within the block, in which the matrices must not change."""
        if self._own:
            with torch.no_grad():
                torch._foreach_copy_(self._cast, self._own)
        for layer, first, second in zip(self._layers, self._cast[::2], self._cast[1::2], strict=True):
            layer.cast = (first, second)
        try:
            yield
        finally:
            for layer in self._layers:
                layer.cast = None


class _LowRankLinear(torch.autograd.Function):
    """`tokens @ weight.T + bias + scale * masked @ first.T @ second.T` with a frozen weight, all of one data type.

    If the matrices have another data type, copies in this data type are passed as well and used for the computation;
    the gradients have the data type of the matrices. Saved for the gradient are the adapter's input (masked, or the
    tokens) and the values between its matrices; nothing for a frozen adapter.
    """

    @staticmethod
    def forward(  # noqa: PLR0913 - torch.autograd.Function takes every tensor as an argument
        ctx: Any,
        tokens: Tensor,
        masked: Tensor | None,
        weight: Tensor,
        bias: Tensor | None,
        first: Tensor,
        second: Tensor,
        first_cast: Tensor | None,
        second_cast: Tensor | None,
        scale: float,
    ) -> Tensor:
        ctx.own_dtype = first.dtype
        first, second = first if first_cast is None else first_cast, second if second_cast is None else second_cast
        read = (tokens if masked is None else masked).flatten(0, -2)
        inner = linear(read, first)
        result = linear(tokens, weight, bias)
        result = _plus_product(result.flatten(0, -2), inner, second.T, scale).view_as(result)
        needed = (ctx.needs_input_grad[4], ctx.needs_input_grad[5], ctx.needs_input_grad[0])
        kept = (value if is_needed else None for value, is_needed in zip((read, inner, weight), needed, strict=True))
        ctx.save_for_backward(*kept, first, second)
        ctx.scale, ctx.is_masked = scale, masked is not None
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        read, inner, weight, first, second = ctx.saved_tensors
        rows, shape = gradient.flatten(0, -2), (*gradient.shape[:-1], first.shape[1])
        to_inner = rows @ second
        of_tokens = of_masked = None
        if ctx.needs_input_grad[0]:
            of_tokens = rows @ weight
            if not ctx.is_masked:
                of_tokens = _plus_product(of_tokens, to_inner, first, ctx.scale)
            of_tokens = of_tokens.view(shape)
        if ctx.needs_input_grad[1]:
            of_masked = (to_inner * ctx.scale @ first).view(shape)
        of_first = None if read is None else (to_inner.T @ read * ctx.scale).to(ctx.own_dtype)
        of_second = None if inner is None else (rows.T @ inner * ctx.scale).to(ctx.own_dtype)
        return of_tokens, of_masked, None, None, of_first, of_second, None, None, None


def _plus_product(total: Tensor, left: Tensor, right: Tensor, scale: float) -> Tensor:
    """Return `total + scale * left @ right`, computed in place unless a compiler traces the function."""
    if torch.compiler.is_compiling():  # torch 2.11 would lose the gradient of the result (PyTorch issue 180642)
        return torch.addmm(total, left, right, alpha=scale)
    return torch.addmm(total, left, right, alpha=scale, out=total)  # PyTorch's FLOP counter knows this operation
