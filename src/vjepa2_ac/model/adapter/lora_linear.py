"""Linear layer with a LoRA adapter: the update is added inside the matrix products, in the layer's own type."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear

from vjepa2_ac.model.quiet_imports import quiet_imports

with quiet_imports():
    from peft.tuners.lora import Linear


class LoraLinear(Linear):  # type: ignore[misc]  # PEFT has no types
    """PEFT's linear layer with a low-rank adapter; plain LoRA takes fewer passes over the tokens.

    PEFT casts tokens to the adapter's float32 and autocast casts them back; dropout, scaling and adding are separate
    passes, and so are their gradients. Here only the two small matrices are cast, and the matrix products scale and
    add. In float32 the result is the same to rounding; in bfloat16 it is rounded less often. Everything except plain
    LoRA on a frozen layer (DoRA, a disabled or merged adapter, types that do not match) is left to PEFT. Hooks on the
    layer and the matrices inside are not called, and there are no second derivatives.
    """

    cast: tuple[Tensor, Tensor] | None = None  # its matrices in the arithmetic's type, while `CastMatrices` holds them

    def forward(self, tokens: Float[Tensor, "*batch inputs"], *args: Any, **kwargs: Any) -> Tensor:
        """Return the output of the layer and its adapter for each token."""
        dtype = self._dtype_of_plain_lora(tokens)
        if dtype is None or args or kwargs:
            return super().forward(tokens, *args, **kwargs)  # type: ignore[no-any-return]
        name, layer = self.active_adapters[0], self.base_layer
        matrices = self.lora_A[name].weight, self.lora_B[name].weight
        cast: tuple[Tensor | None, ...]
        if self.cast is not None and self.cast[0].dtype == dtype:
            cast = self.cast
        else:
            cast = tuple(None if one.dtype == dtype else one.detach().to(dtype) for one in matrices)
        weight, bias = (None if own is None else own.to(dtype) for own in (layer.weight, layer.bias))
        tokens = tokens.to(dtype)
        dropout = self.lora_dropout[name]
        masked = None if isinstance(dropout, nn.Identity) or not self.training else dropout(tokens)
        apply: Callable[..., Tensor] = _LowRankLinear.apply
        return apply(tokens, masked, weight, bias, *matrices, *cast, self.scaling[name])

    def _dtype_of_plain_lora(self, tokens: Tensor) -> torch.dtype | None:
        """Return the type to compute in; None if PEFT computes."""
        adapters, layer = self.active_adapters, self.base_layer
        if self.disable_adapters or self.merged or len(adapters) != 1 or adapters[0] not in self.lora_A:
            return None
        if self.lora_variant or self.lora_bias.get(adapters[0]) or type(layer).forward is not nn.Linear.forward:
            return None
        if tokens.dim() < 2 or any(own.requires_grad for own in layer.parameters()):
            return None
        if torch.is_autocast_enabled(tokens.device.type):
            return torch.get_autocast_dtype(tokens.device.type)
        same = tokens.dtype == layer.weight.dtype == self.lora_A[adapters[0]].weight.dtype
        return tokens.dtype if same else None


class CastMatrices:
    """The matrices of adapters in the arithmetic's type, cast together once per step instead of at each use.

    Args:
        module: The module with the adapters.
        dtype: Of the arithmetic.
    """

    def __init__(self, module: nn.Module, dtype: torch.dtype) -> None:
        self._layers = [
            layer
            for layer in module.modules()
            if isinstance(layer, LoraLinear) and [one.weight.dtype != dtype for one in _matrices(layer)] == [True, True]
        ]
        self._own = [one.weight for layer in self._layers for one in _matrices(layer)]
        self._cast = [torch.empty_like(one, dtype=dtype, requires_grad=False) for one in self._own]

    @contextmanager
    def current(self) -> Iterator[None]:
        """Cast now, and let all layers use the result within the block: the matrices must not change."""
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


def _matrices(layer: LoraLinear) -> list[nn.Linear]:
    """Return the two matrices of the adapter that is computed here; none if there are several adapters."""
    names = layer.active_adapters
    return [layer.lora_A[names[0]], layer.lora_B[names[0]]] if len(names) == 1 and names[0] in layer.lora_A else []


class _LowRankLinear(torch.autograd.Function):
    """`tokens @ weight.T + bias + scale * masked @ first.T @ second.T`, the weight frozen; all of one type.

    If the matrices have another type, they are also given in this one, which is used to compute; their gradients have
    their own type. Saved for the gradient are the adapter's input (masked, else the tokens) and the values between its
    matrices; for a frozen adapter neither.
    """

    @staticmethod
    def forward(
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
    """Return `total + scale * left @ right` in the memory of the total; a compiler chooses the memory itself."""
    if torch.compiler.is_compiling():  # torch 2.11 would lose the gradient of the result (PyTorch issue 180642)
        return torch.addmm(total, left, right, alpha=scale)
    return torch.addmm(total, left, right, alpha=scale, out=total)  # PyTorch's FLOP counter knows this operation
