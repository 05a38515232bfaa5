"""Rotary position tables over time, height and width, computed once per shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float32
from torch import Tensor

THETA = 10_000


@dataclass(frozen=True)
class TokenLayout:
    """Layout of a sequence: `steps` steps, each of `conditioning` tokens and then `grid` x `grid` patches."""

    steps: int
    grid: int
    conditioning: int = 0
    start: int = 0  # the first step's position in time
    interleaved: bool = False  # V-JEPA 2.1: the two of a pair have one frequency
    scaled_to: int | None = None  # V-JEPA 2.1: rows and columns of any grid are at the places of one of so many

    @property
    def tokens_per_step(self) -> int:
        """Conditioning tokens and patches of one step."""
        return self.conditioning + self.grid**2


class RotaryTables(NamedTuple):
    """Tables by which every layer rotates queries and keys; always float32, so positions stay exact in bfloat16."""

    cosine: Float32[Tensor, "sequence 1 head_dim"]
    signed_sine: Float32[Tensor, "sequence 1 head_dim"]  # minus for the first of a pair, plus for the second


@lru_cache(maxsize=32)
def rotary_tables(layout: TokenLayout, head_dim: int, device: torch.device) -> RotaryTables:
    """Return the rotary tables of a sequence; the same tables for the same shape.

    The head is cut into three equal parts of 2*((head_dim//3)//2) for time, height and width; the rest is not rotated.
    Conditioning tokens are rotated in the time part only. Pairs are neighbours (2i, 2i+1), yet in V-JEPA 2 and every
    predictor the frequencies are tiled ([w0..w9, w0..w9]): the released weights were trained so. In V-JEPA 2.1 they are
    interleaved ([w0, w0, w1, w1, ..]).

    Raises:
        ValueError: The head has no pairs to rotate: its size is odd.

    Source: facebookresearch/vjepa2 @ c2963a4, src/models/utils/modules.py, rotate_queries_or_keys and ACRoPEAttention;
    of V-JEPA 2.1 @ 204698b, app/vjepa_2_1/models/utils/modules.py.
    """
    if head_dim % 2:
        raise ValueError(f"a head of {head_dim} cannot be rotated in pairs: width / heads must be even")
    part = 2 * ((head_dim // 3) // 2)
    # Tables made in inference mode or under FakeTensor must not end up in the cache of a training run.
    with torch.inference_mode(False), torch.no_grad():
        places = _places(layout, device)
        frequencies = 1.0 / THETA ** (torch.arange(part // 2, dtype=torch.float32, device=device) / (part / 2))
        pairs = frequencies.repeat_interleave(2) if layout.interleaved else frequencies.repeat(2)
        angles = (places[..., None] * pairs).flatten(1)
        angles = torch.nn.functional.pad(angles, (0, head_dim - 3 * part))
        sign = torch.tensor([-1.0, 1.0], device=device).repeat((head_dim + 1) // 2)[:head_dim]
        return RotaryTables(angles.cos()[:, None], (angles.sin() * sign)[:, None])


def rotate(
    tokens: Float[Tensor, "batch sequence heads head_dim"], tables: RotaryTables
) -> Float[Tensor, "batch sequence heads head_dim"]:
    """Return queries or keys rotated by their position: computed in float32, returned in the input's type."""
    apply: Callable[..., Tensor] = _Rotation.apply
    return apply(tokens, *tables)


class _Rotation(torch.autograd.Function):
    """Rotates pairs, in two passes over the tokens; its gradient is the inverse rotation, and saves no token."""

    @staticmethod
    def forward(ctx: Any, tokens: Tensor, cosine: Tensor, signed_sine: Tensor) -> Tensor:
        ctx.save_for_backward(cosine, signed_sine)
        return _turned(tokens, cosine, signed_sine)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        cosine, signed_sine = ctx.saved_tensors
        return _turned(gradient, cosine, _swapped(signed_sine)), None, None


def _turned(tokens: Tensor, cosine: Tensor, signed_sine: Tensor) -> Tensor:
    # Computed in float32, as the tables are, and written in the type of the tokens, without a pass to cast it. A
    # compiler fuses that pass by itself, and torch 2.11 loses the gradient of what an autograd.Function writes in place
    # and then returns (PyTorch issue 180642); there even a cast that changes nothing loses it.
    if torch.compiler.is_compiling():
        turned = torch.addcmul(tokens * cosine, _swapped(tokens), signed_sine)
        return turned if turned.dtype == tokens.dtype else turned.to(tokens.dtype)
    turned = torch.empty_like(tokens)
    return torch.addcmul(tokens * cosine, _swapped(tokens), signed_sine, out=turned)


def _swapped(tokens: Tensor) -> Tensor:
    """Return the tokens with the two numbers of each pair swapped."""
    return torch.stack((tokens[..., 1::2], tokens[..., 0::2]), dim=-1).flatten(-2)


def _places(layout: TokenLayout, device: torch.device) -> Float32[Tensor, "sequence 3"]:
    """Return time, height and width of every token; conditioning tokens have only a time."""
    grid = torch.arange(layout.grid, dtype=torch.float32, device=device)
    if layout.scaled_to is not None:
        grid = grid * (layout.scaled_to - 1) / (layout.grid - 1)
    patches = torch.cartesian_prod(grid, grid)
    space = torch.cat([torch.zeros(layout.conditioning, 2, device=device), patches]).repeat(layout.steps, 1)
    steps = torch.arange(layout.start, layout.start + layout.steps, dtype=torch.float32, device=device)
    time = steps.repeat_interleave(layout.tokens_per_step)
    return torch.cat([time[:, None], space], dim=-1)
