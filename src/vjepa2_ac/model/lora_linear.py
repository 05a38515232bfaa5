"""How does a layer with an adapter compute? The update is added inside the matrix products, in the layer's own type."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from peft.tuners.lora import Linear
from torch import Tensor, nn
from torch.nn.functional import linear


class LoraLinear(Linear):  # type: ignore[misc]  # PEFT has no types
    """PEFT's linear layer with a low-rank adapter; plain LoRA takes fewer passes over the tokens.

    PEFT casts tokens to the adapter's float32 and autocast casts them back; dropout, scaling and adding are passes of
    their own, and so are their gradients. Here nothing is cast but the two small matrices, and the matrix products
    scale and add. In float32 the same to rounding; in bfloat16 it rounds less often. Whatever is not plain LoRA
    (DoRA, an adapter that is switched off or merged, types that nothing brings together) is left to PEFT.
    """

    def forward(self, tokens: Float[Tensor, "*batch inputs"], *args: Any, **kwargs: Any) -> Tensor:
        """Return what the layer and its adapter make of each token."""
        dtype = self._dtype_of_plain_lora(tokens)
        if dtype is None or args or kwargs:
            return super().forward(tokens, *args, **kwargs)  # type: ignore[no-any-return]
        name, layer = self.active_adapters[0], self.base_layer
        first, second = (matrices[name].weight.to(dtype) for matrices in (self.lora_A, self.lora_B))
        weight, bias = (None if own is None else own.to(dtype) for own in (layer.weight, layer.bias))
        tokens = tokens.to(dtype)
        dropout = self.lora_dropout[name]
        masked = None if isinstance(dropout, nn.Identity) or not self.training else dropout(tokens)
        apply: Callable[..., Tensor] = _LowRankLinear.apply
        return apply(tokens, masked, weight, bias, first, second, self.scaling[name])

    def _dtype_of_plain_lora(self, tokens: Tensor) -> torch.dtype | None:
        """Return the type to compute in; None where PEFT shall compute."""
        adapters, layer = self.active_adapters, self.base_layer
        plain = len(adapters) == 1 and adapters[0] in self.lora_A and not self.lora_variant
        if self.disable_adapters or self.merged or not plain or type(layer).forward is not nn.Linear.forward:
            return None
        if torch.is_autocast_enabled(tokens.device.type):
            return torch.get_autocast_dtype(tokens.device.type)
        same = tokens.dtype == layer.weight.dtype == self.lora_A[adapters[0]].weight.dtype
        return tokens.dtype if same else None


class _LowRankLinear(torch.autograd.Function):
    """`tokens @ weight.T + bias + scale * masked @ first.T @ second.T`, the weight frozen; all of one type.

    What is kept for the gradient is the adapter's input (masked, else the tokens) and what is between its matrices.
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
        scale: float,
    ) -> Tensor:
        read = (tokens if masked is None else masked).flatten(0, -2)
        inner = linear(read, first)
        result = linear(tokens, weight, bias)
        _add_product(result.flatten(0, -2), inner, second.T, scale)
        ctx.save_for_backward(read, inner, weight if ctx.needs_input_grad[0] else None, first, second)
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
                _add_product(of_tokens, to_inner, first, ctx.scale)
            of_tokens = of_tokens.view(shape)
        if ctx.needs_input_grad[1]:
            of_masked = (to_inner * ctx.scale @ first).view(shape)
        of_first, of_second = to_inner.T @ read * ctx.scale, rows.T @ inner * ctx.scale
        return of_tokens, of_masked, None, None, of_first, of_second, None


def _add_product(total: Tensor, left: Tensor, right: Tensor, scale: float) -> None:
    torch.addmm(total, left, right, alpha=scale, out=total)  # in place, and PyTorch's counter of FLOPs knows it
