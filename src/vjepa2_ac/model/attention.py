"""Rotary position tables over time, height and width, and block-causal attention.

In block-causal attention a token of step t attends to all tokens of steps up to t. If there are more keys than queries,
the queries belong to the last steps. There are three exact implementations:
    dense     one call with a mask: the reference
    per_step  one call per step, on the keys up to this step, without a mask: about half the computation
    flex      compiled FlexAttention with a block mask: for training on CUDA
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from vjepa2_ac.model.compilation import compile_function, has_triton

THETA = 10_000


@dataclass(frozen=True)
class TokenLayout:
    """Layout of a sequence: `steps` steps, each of `conditioning` tokens followed by `grid` x `grid` patches."""

    steps: int
    grid: int
    conditioning: int = 0
    start: int = 0  # position in time of the first step
    interleaved: bool = False  # V-JEPA 2.1: both numbers of a pair have the same frequency
    scaled_to: int | None = None  # V-JEPA 2.1: row and column positions are scaled to a grid of this size

    @property
    def tokens_per_step(self) -> int:
        """The number of conditioning tokens and patches per step."""
        return self.conditioning + self.grid**2


class RotaryTables(NamedTuple):
    """Tables for the rotation of queries and keys in every layer; float32, because bfloat16 would round positions."""

    cosine: Float32[Tensor, "sequence 1 head_dim"]
    signed_sine: Float32[Tensor, "sequence 1 head_dim"]  # sines, negated for the first number of each pair


@lru_cache(maxsize=32)
def rotary_tables(layout: TokenLayout, head_dim: int, device: torch.device) -> RotaryTables:
    """Return the rotary tables of a sequence. Tables are cached per layout, head width and device.

    A head is split into three equal parts of 2*((head_dim//3)//2) for time, height and width; the rest is not rotated.
    Conditioning tokens are rotated in the time part only. Pairs are neighbours (2i, 2i+1). In V-JEPA 2 and in all
    predictors the frequencies are nevertheless tiled ([w0..w9, w0..w9]), because the released weights were trained this
    way. In V-JEPA 2.1 they are interleaved ([w0, w0, w1, w1, ..]).

    Source: facebookresearch/vjepa2 @ c2963a4, src/models/utils/modules.py, rotate_queries_or_keys and ACRoPEAttention;
    for V-JEPA 2.1 @ 204698b, app/vjepa_2_1/models/utils/modules.py.
    """
    part = 2 * ((head_dim // 3) // 2)
    # A training run cannot use tensors that were created in inference mode, and the tables are cached.
    with torch.inference_mode(False), torch.no_grad():
        positions = _token_positions(layout, device)
        frequencies = 1.0 / THETA ** (torch.arange(part // 2, dtype=torch.float32, device=device) / (part / 2))
        pairs = frequencies.repeat_interleave(2) if layout.interleaved else frequencies.repeat(2)
        angles = (positions[..., None] * pairs).flatten(1)
        angles = torch.nn.functional.pad(angles, (0, head_dim - 3 * part))
        sign = torch.tensor([-1.0, 1.0], device=device).repeat((head_dim + 1) // 2)[:head_dim]
        return RotaryTables(angles.cos()[:, None], (angles.sin() * sign)[:, None])


def rotate(
    tokens: Float[Tensor, "batch sequence heads head_dim"], tables: RotaryTables
) -> Float[Tensor, "batch sequence heads head_dim"]:
    """Return queries or keys rotated by their position, computed in float32 and returned in the input's data type."""
    apply: Callable[..., Tensor] = _Rotation.apply
    return apply(tokens, *tables)


class _Rotation(torch.autograd.Function):
    """The rotation of pairs in two passes over the tokens. Its gradient is the inverse rotation and needs no tokens."""

    @staticmethod
    def forward(ctx: Any, tokens: Tensor, cosine: Tensor, signed_sine: Tensor) -> Tensor:
        ctx.save_for_backward(cosine, signed_sine)
        return _rotate_pairs(tokens, cosine, signed_sine)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        cosine, signed_sine = ctx.saved_tensors
        return _rotate_pairs(gradient, cosine, _swap_pairs(signed_sine)), None, None


def _rotate_pairs(tokens: Tensor, cosine: Tensor, signed_sine: Tensor) -> Tensor:
    # With `out`, addcmul computes in float32 and writes the data type of the tokens, without another pass for the cast.
    # A compiler fuses the cast itself. In compiled code torch 2.11 loses the gradient of a tensor that an
    # autograd.Function writes in place and returns (PyTorch issue 180642), even after a cast that changes nothing.
    if torch.compiler.is_compiling():
        rotated = torch.addcmul(tokens * cosine, _swap_pairs(tokens), signed_sine)
        return rotated if rotated.dtype == tokens.dtype else rotated.to(tokens.dtype)
    rotated = torch.empty_like(tokens)
    return torch.addcmul(tokens * cosine, _swap_pairs(tokens), signed_sine, out=rotated)


def _swap_pairs(tokens: Tensor) -> Tensor:
    """Return the tokens with the two numbers of each pair swapped."""
    return torch.stack((tokens[..., 1::2], tokens[..., 0::2]), dim=-1).flatten(-2)


def _token_positions(layout: TokenLayout, device: torch.device) -> Float32[Tensor, "sequence 3"]:
    """Return the positions (time, height, width) of all tokens; conditioning tokens have height and width 0."""
    grid = torch.arange(layout.grid, dtype=torch.float32, device=device)
    if layout.scaled_to is not None:
        grid = grid * (layout.scaled_to - 1) / (layout.grid - 1)
    patches = torch.cartesian_prod(grid, grid)
    space = torch.cat([torch.zeros(layout.conditioning, 2, device=device), patches]).repeat(layout.steps, 1)
    steps = torch.arange(layout.start, layout.start + layout.steps, dtype=torch.float32, device=device)
    time = steps.repeat_interleave(layout.tokens_per_step)
    return torch.cat([time[:, None], space], dim=-1)


AttentionKind = Literal["auto", "dense", "per_step", "flex"]
Attend = Callable[[Tensor, Tensor, Tensor, int], Tensor]  # arguments: queries, keys, values, tokens per step

_FLEX_HEAD_DIM = 16  # minimum head width of FlexAttention's kernels
_FLEX_STEPS = 4  # minimum number of steps for which a compilation is worthwhile


def block_causal_attention(
    query: Float[Tensor, "batch heads sequence head_dim"],
    key: Float[Tensor, "batch heads keys head_dim"],
    value: Float[Tensor, "batch heads keys head_dim"],
    tokens_per_step: int,
    kind: AttentionKind | Attend = "auto",
) -> Float[Tensor, "batch heads sequence head_dim"]:
    """Return the attention in which a token of step t attends to all tokens of steps <= t.

    `auto` uses `flex` on CUDA if Triton is installed, gradients are enabled and there are at least four steps;
    otherwise it uses `per_step`. FlexAttention is compiled again for each length and number of clips, and lengths vary
    in evaluation and planning. `kind` may also be a function that computes the attention.

    Raises:
        InputError: FlexAttention was compiled for too many sizes; uncompiled it would store all scores in memory.
    """
    if kind == "auto":
        is_long = query.shape[-1] >= _FLEX_HEAD_DIM and query.shape[2] // tokens_per_step >= _FLEX_STEPS
        has_flex = query.device.type == "cuda" and has_triton()
        kind = "flex" if is_long and has_flex and torch.is_grad_enabled() else "per_step"
    attend = kind if callable(kind) else _IMPLEMENTATIONS[kind]
    return attend(query, key, value, tokens_per_step)


def _dense(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:
    mask = _dense_mask(key.shape[2] // tokens_per_step, tokens_per_step, query.device)[-query.shape[2] :]
    return scaled_dot_product_attention(query, key, value, attn_mask=mask)


def _per_step(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:
    num_cached = key.shape[2] - query.shape[2]
    ends = tuple(range(num_cached + tokens_per_step, key.shape[2] + 1, tokens_per_step))
    queries = torch.split(query, tokens_per_step, dim=2)
    prefixes: Callable[..., tuple[Tensor, ...]] = _Prefixes.apply
    steps = zip(queries, prefixes(key, ends), prefixes(value, ends), strict=True)
    outputs = [scaled_dot_product_attention(*inputs) for inputs in steps]
    return outputs[0] if len(outputs) == 1 else torch.cat(outputs, dim=2)


class _Prefixes(torch.autograd.Function):
    """The keys (or values) before each end, as views without copies.

    With plain slices, the gradient of each prefix would be padded with zeros to the full length before the gradients
    are added. Here each gradient is added in place.
    """

    @staticmethod
    def forward(_ctx: Any, values: Tensor, ends: tuple[int, ...]) -> tuple[Tensor, ...]:
        return tuple(values[:, :, :end] for end in ends)

    @staticmethod
    def backward(_ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        total = gradients[-1].clone()  # the last prefix contains all tokens
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

    num_cached = keys - queries
    with torch.inference_mode(False):
        return create_block_mask(
            lambda _batch, _head, query, key: (num_cached + query) // tokens_per_step >= key // tokens_per_step,
            None,
            None,
            queries,
            keys,
            device=device,
        )


def _flex_attention(is_compiled: bool) -> Callable[..., Any]:
    from torch.nn.attention.flex_attention import flex_attention

    attend: Callable[..., Any] = flex_attention
    return compile_function(attend, override="training.attention=per_step", dynamic=False) if is_compiled else attend
