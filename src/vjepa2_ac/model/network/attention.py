"""Block-causal attention: a token of step t sees every token of steps up to t.

There may be more keys than queries: the queries are then those of the last steps.

Three exact ways to compute it:
    dense     one attention with a mask: the plain reference
    per_step  one attention per step, on the keys up to it, without a mask: computes about half as much
    flex      FlexAttention with a block mask, compiled: for training on CUDA
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from vjepa2_ac.model.network.compilation import compiled, has_triton

AttentionKind = Literal["auto", "dense", "per_step", "flex"]
Attend = Callable[[Tensor, Tensor, Tensor, int], Tensor]  # of queries, keys, values and tokens per step

_FLEX_HEAD_DIM = 16  # minimum of its kernels
_FLEX_STEPS = 4  # minimum that is worth a compilation


def block_causal_attention(
    query: Float[Tensor, "batch heads sequence head_dim"],
    key: Float[Tensor, "batch heads keys head_dim"],
    value: Float[Tensor, "batch heads keys head_dim"],
    tokens_per_step: int,
    kind: AttentionKind | Attend = "auto",
) -> Float[Tensor, "batch heads sequence head_dim"]:
    """Return the attention in which a token of step t sees all tokens of steps <= t.

    `auto` uses `flex` on CUDA if Triton is installed, with gradients on and at least four steps; `per_step`
    everywhere else. Each length and each number of clips is compiled anew: lengths vary in evaluation and planning, and
    the short ones at the start of a rollout are not worth it. A function in place of a kind computes it.

    Raises:
        InputError: FlexAttention was compiled for too many sizes; uncompiled it would hold all scores in memory.
    """
    if kind == "auto":
        steps = query.shape[2] // tokens_per_step
        kind = best_kind(query.device, query.shape[-1], steps, gradients=torch.is_grad_enabled())
    attend = kind if callable(kind) else _IMPLEMENTATIONS[kind]
    return attend(query, key, value, tokens_per_step)


def best_kind(device: torch.device, head_dim: int, steps: int, *, gradients: bool) -> AttentionKind:
    """Return the choice of `auto`: see `block_causal_attention`."""
    fits_flex = device.type == "cuda" and head_dim >= _FLEX_HEAD_DIM and steps >= _FLEX_STEPS and gradients
    return "flex" if fits_flex and has_triton() else "per_step"


def _dense(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:
    mask = _dense_mask(key.shape[2] // tokens_per_step, tokens_per_step, query.device)[-query.shape[2] :]
    return scaled_dot_product_attention(query, key, value, attn_mask=mask)


def _per_step(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:
    before = key.shape[2] - query.shape[2]
    ends = tuple(range(before + tokens_per_step, key.shape[2] + 1, tokens_per_step))
    parts = torch.split(query, tokens_per_step, dim=2)
    beginnings: Callable[..., tuple[Tensor, ...]] = _Beginnings.apply
    steps = zip(parts, beginnings(key, ends), beginnings(value, ends), strict=True)
    seen = [scaled_dot_product_attention(*inputs) for inputs in steps]
    return seen[0] if len(seen) == 1 else torch.cat(seen, dim=2)


class _Beginnings(torch.autograd.Function):
    """The first tokens of keys or values up to each end, as views: nothing is copied.

    With plain slices, the gradient of each would be padded with zeros to the full length before it is added to the
    others; here it is added in place.
    """

    @staticmethod
    def forward(_ctx: Any, values: Tensor, ends: tuple[int, ...]) -> tuple[Tensor, ...]:
        return tuple(values[:, :, :end] for end in ends)

    @staticmethod
    def backward(_ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:  # the last is of all tokens
        total = gradients[-1].clone()
        for gradient in gradients[:-1]:
            total[:, :, : gradient.shape[2]] += gradient
        return total, None


def _flex(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:
    mask = _flex_mask(query.shape[2], key.shape[2], tokens_per_step, query.device)
    attend = _flex_attention(query.device.type == "cuda")
    return attend(query, key, value, block_mask=mask)  # type: ignore[no-any-return]  # torch.compile has no types


_IMPLEMENTATIONS: dict[str, Attend] = {"dense": _dense, "per_step": _per_step, "flex": _flex}


@lru_cache(maxsize=8)
def _dense_mask(steps: int, tokens_per_step: int, device: torch.device) -> Bool[Tensor, "sequence sequence"]:
    with torch.inference_mode(False):
        step = torch.arange(steps, device=device).repeat_interleave(tokens_per_step)
        return step[:, None] >= step[None, :]


@lru_cache(maxsize=16)
def _flex_mask(queries: int, keys: int, tokens_per_step: int, device: torch.device) -> Any:
    from torch.nn.attention.flex_attention import create_block_mask

    before = keys - queries
    with torch.inference_mode(False):
        return create_block_mask(
            lambda _batch, _head, query, key: (before + query) // tokens_per_step >= key // tokens_per_step,
            None,
            None,
            queries,
            keys,
            device=device,
        )


def _flex_attention(is_compiled: bool) -> Callable[..., Any]:
    from torch.nn.attention.flex_attention import flex_attention

    attend: Callable[..., Any] = flex_attention
    return compiled(attend, way_out="training.attention=per_step", dynamic=False) if is_compiled else attend
