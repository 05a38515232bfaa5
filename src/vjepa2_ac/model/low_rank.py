"""The low-rank update of a frozen linear layer, computed with few passes over the tokens. Needs only PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear


class LowRankLayer:
    """A layer with a low-rank update. `CastMatrices` can cast its two matrices once for all micro-steps."""

    # Copies of the matrices in the data type of the computation; set within `CastMatrices.use`.
    cast: tuple[Tensor, Tensor] | None = None

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
    """Return the sum of the outputs of a frozen layer and its low-rank update, in the data type of the tokens.

    Args:
        tokens: The input.
        layer: The frozen layer.
        update: The object with the two matrices of the update.
        dropout: Dropout on the input of the update, or None.
        scale: The factor of the update.
    """
    dtype, matrices = tokens.dtype, update.matrices()
    cast: tuple[Tensor | None, ...]
    if update.cast is not None and update.cast[0].dtype == dtype:
        cast = update.cast
    else:
        cast = tuple(None if matrix.dtype == dtype else matrix.detach().to(dtype) for matrix in matrices)
    weight, bias = (None if value is None else value.to(dtype) for value in (layer.weight, layer.bias))
    masked = None if dropout is None else dropout(tokens)
    apply: Callable[..., Tensor] = _LowRankLinear.apply
    return apply(tokens, masked, weight, bias, *matrices, *cast, scale)


class CastMatrices:
    """Copies of adapter matrices in the data type of the computation, cast once per step instead of at each use.

    Args:
        module: The module with the adapters.
        dtype: The data type of the computation.
    """

    def __init__(self, module: nn.Module, dtype: torch.dtype) -> None:
        self._layers = [
            layer
            for layer in module.modules()
            if isinstance(layer, LowRankLayer)
            and [matrix.dtype != dtype for matrix in layer.matrices()] == [True, True]
        ]
        self._matrices = [matrix for layer in self._layers for matrix in layer.matrices()]
        self._copies = [torch.empty_like(matrix, dtype=dtype, requires_grad=False) for matrix in self._matrices]

    @contextmanager
    def use(self) -> Iterator[None]:
        """Cast the matrices, and make all layers use the copies within the `with` block.

        The matrices must not change within the block.
        """
        if self._matrices:
            with torch.no_grad():
                torch._foreach_copy_(self._copies, self._matrices)
        for layer, first, second in zip(self._layers, self._copies[::2], self._copies[1::2], strict=True):
            layer.cast = (first, second)
        try:
            yield
        finally:
            for layer in self._layers:
                layer.cast = None


class _LowRankLinear(torch.autograd.Function):
    """`tokens @ weight.T + bias + scale * masked @ first.T @ second.T` with a frozen weight.

    `masked` are the tokens after dropout. All tensors have one data type, except that `first` and `second` may have
    another one; then `first_cast` and `second_cast` are used for the computation, and the gradients of the matrices
    have the matrices' own data type. Only what the required gradients need is saved: the adapter's input and the values
    between its matrices, if the adapter is trained.
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
        ctx.matrix_dtype = first.dtype
        first, second = first if first_cast is None else first_cast, second if second_cast is None else second_cast
        adapter_input = (tokens if masked is None else masked).flatten(0, -2)
        inner = linear(adapter_input, first)
        result = linear(tokens, weight, bias)
        result = _add_product(result.flatten(0, -2), inner, second.T, scale).view_as(result)
        # The gradients of `first`, `second` and `tokens` need the adapter's input, the inner values and the weight.
        are_needed = (ctx.needs_input_grad[4], ctx.needs_input_grad[5], ctx.needs_input_grad[0])
        values = zip((adapter_input, inner, weight), are_needed, strict=True)
        ctx.save_for_backward(*(value if is_needed else None for value, is_needed in values), first, second)
        ctx.scale, ctx.is_masked = scale, masked is not None
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        adapter_input, inner, weight, first, second = ctx.saved_tensors
        flat_gradient, shape = gradient.flatten(0, -2), (*gradient.shape[:-1], first.shape[1])
        inner_gradient = flat_gradient @ second
        tokens_gradient = masked_gradient = None
        if ctx.needs_input_grad[0]:
            tokens_gradient = flat_gradient @ weight
            if not ctx.is_masked:
                tokens_gradient = _add_product(tokens_gradient, inner_gradient, first, ctx.scale)
            tokens_gradient = tokens_gradient.view(shape)
        if ctx.needs_input_grad[1]:
            masked_gradient = (inner_gradient * ctx.scale @ first).view(shape)
        first_gradient = (
            None if adapter_input is None else (inner_gradient.T @ adapter_input * ctx.scale).to(ctx.matrix_dtype)
        )
        second_gradient = None if inner is None else (flat_gradient.T @ inner * ctx.scale).to(ctx.matrix_dtype)
        return tokens_gradient, masked_gradient, None, None, first_gradient, second_gradient, None, None, None


def _add_product(total: Tensor, left: Tensor, right: Tensor, scale: float) -> Tensor:
    """Return `total + scale * left @ right`, computed in place unless a compiler traces the function."""
    if torch.compiler.is_compiling():  # torch 2.11 would lose the gradient of the result (PyTorch issue 180642)
        return torch.addmm(total, left, right, alpha=scale)
    return torch.addmm(total, left, right, alpha=scale, out=total)  # unlike addmm_, counted by PyTorch's FLOP counter
