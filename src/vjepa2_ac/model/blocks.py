"""Predictor block: attention with rotary positions, MLP, pre-norm residuals."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from vjepa2_ac.model.attention import Attend, AttentionKind, RotaryTables, block_causal_attention, rotate
from vjepa2_ac.model.compilation import When, compile_function

NORM_EPSILON = 1e-6
INIT_STD = 0.02
_COMPILE_OFF = "training.compile=off (planning.compile=off)"  # the settings that disable compilation, for messages


class OutputLinear(nn.Linear):
    """A linear layer whose output is added to the residual; its initial weights get smaller with depth (`output_std`).

    Args:
        inputs: Width of the input.
        outputs: Width of the output.
        layer: Number of the block, counted from 1.
    """

    def __init__(self, inputs: int, outputs: int, layer: int) -> None:
        super().__init__(inputs, outputs)
        self.init_std = output_std(layer)


class Attention(nn.Module):
    """The linear layers of block-causal attention; attention itself is computed by `block_causal_attention`."""

    def __init__(self, width: int, heads: int, layer: int) -> None:
        super().__init__()
        self.heads = heads
        self.q = nn.Linear(width, width)
        self.k = nn.Linear(width, width)
        self.v = nn.Linear(width, width)
        self.o = OutputLinear(width, width, layer)

    def project(
        self, tokens: Float[Tensor, "batch sequence width"], tables: RotaryTables
    ) -> tuple[
        Float[Tensor, "batch heads sequence head_dim"],
        Float[Tensor, "batch heads sequence head_dim"],
        Float[Tensor, "batch heads sequence head_dim"],
    ]:
        """Return rotated queries, rotated keys, and values."""
        query, key, value = (project(tokens).unflatten(-1, (self.heads, -1)) for project in (self.q, self.k, self.v))
        query, key = rotate(query, tables), rotate(key, tables)
        return query.transpose(1, 2), key.transpose(1, 2), value.transpose(1, 2)


class Mlp(nn.Module):
    """Two linear layers with the exact (erf) GELU between them."""

    def __init__(self, width: int, hidden: int, layer: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.activation = nn.GELU()
        self.fc2 = OutputLinear(hidden, width, layer)

    def forward(self, tokens: Float[Tensor, "*batch width"]) -> Float[Tensor, "*batch width"]:
        """Transform each token independently."""
        return self.fc2(self.activation(self.fc1(tokens)))  # type: ignore[no-any-return]  # nn.Module is untyped


class Block(nn.Module):
    """A pre-norm transformer block: attention, then an MLP.

    A block stores no keys and values, because gradient checkpointing computes it twice. Keys and values of earlier
    steps are arguments, and keys and values for later steps are returned.

    Args:
        layer: Number of the block, counted from 1.
    """

    def __init__(self, width: int, heads: int, hidden: int, layer: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.attn = Attention(width, heads, layer)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.mlp = Mlp(width, hidden, layer)
        self.compiled: When = "never"  # when the two halves of the block are compiled

    def forward(
        self,
        tokens: Float[Tensor, "batch sequence width"],
        tables: RotaryTables,
        tokens_per_step: int,
        kind: AttentionKind | Attend = "auto",
        keep: int = 0,
        *past: Float[Tensor, "2 batch heads _ head_dim"],
    ) -> tuple[Float[Tensor, "batch sequence width"], Float[Tensor, "2 batch heads keep head_dim"] | None]:
        """Return the tokens after this block, and a copy of the keys and values of the first `keep` tokens, if any.

        Args:
            tokens: The tokens of whole steps.
            tables: The rotary tables of the tokens.
            tokens_per_step: Number of tokens per step.
            kind: The implementation of attention.
            keep: Number of tokens whose keys (rotated) and values are returned.
            past: Keys and values from earlier calls, in the order of the calls. The tokens follow them and attend to
                them. They are not passed as a tuple, because gradient checkpointing finds only tensors that are
                arguments themselves.
        """
        before, after = _before_attention, _after_attention
        if self.compiled == "always" or (self.compiled == "with gradients" and torch.is_grad_enabled()):
            before = compile_function(before, override=_COMPILE_OFF)
            after = compile_function(after, override=_COMPILE_OFF)
        query, key, value = before(self, tokens, tables)
        # `stack` copies, so the memory of all other keys and values can be freed.
        saved = torch.stack((key[:, :, :keep], value[:, :, :keep])) if keep else None
        if past:
            key, value = torch.cat((*past, torch.stack((key, value))), dim=3)
        attended = block_causal_attention(query, key, value, tokens_per_step, kind)
        return after(self, tokens, attended), saved


def initialise(module: nn.Module, generator: Generator | None = None) -> None:
    """Initialise one module (not its children): truncated normal, std 0.02; biases 0; norms 1.

    Source: facebookresearch/vjepa2 @ c2963a4, src/models/ac_predictor.py, _init_weights and _rescale_blocks.
    """
    if isinstance(module, nn.Linear | nn.Conv3d):
        std = module.init_std if isinstance(module, OutputLinear) else INIT_STD
        nn.init.trunc_normal_(module.weight, std=std, generator=generator)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.LayerNorm):
        nn.init.ones_(module.weight)
        nn.init.zeros_(module.bias)


def output_std(layer: int) -> float:
    """Return the initial standard deviation of a block's output layers, 0.02 / sqrt(2 * layer); blocks count from 1."""
    return INIT_STD / math.sqrt(2 * layer)


def _before_attention(block: Block, tokens: Tensor, tables: RotaryTables) -> tuple[Tensor, Tensor, Tensor]:
    return block.attn.project(apply_norm(block.norm1, tokens), tables)


def _after_attention(block: Block, tokens: Tensor, attended: Tensor) -> Tensor:
    tokens = tokens + block.attn.o(attended.transpose(1, 2).flatten(2))
    return tokens + block.mlp(apply_norm(block.norm2, tokens))  # type: ignore[no-any-return]  # nn.Module is untyped


def apply_norm(norm: nn.LayerNorm, tokens: Tensor) -> Tensor:
    """Return normalised tokens. Under autocast they are cast once, instead of in each of the following layers."""
    device_type = tokens.device.type
    if not torch.is_autocast_enabled(device_type):
        return norm(tokens)  # type: ignore[no-any-return]  # nn.Module is untyped
    with without_needless_autocast(tokens, norm.weight):
        return norm(tokens).to(torch.get_autocast_dtype(device_type))  # type: ignore[no-any-return]  # nn.Module is untyped


def without_needless_autocast(tokens: Tensor, weights: Tensor) -> AbstractContextManager[object]:
    """Return a context that disables autocast if tokens and weights already have autocast's data type.

    Autocast would compute norms from a float32 copy, and each following layer would cast the result back. Norm kernels
    compute in float32 in any case, so the result without autocast is the same, with a fifth of the memory traffic.
    """
    device_type = tokens.device.type
    if torch.is_autocast_enabled(device_type) and tokens.dtype == weights.dtype == torch.get_autocast_dtype(
        device_type
    ):
        return torch.autocast(device_type, enabled=False)
    return nullcontext()


def hidden_width(width: int, mlp_ratio: float) -> int:
    """Return the hidden width of an MLP, rounded down as in Meta's code."""
    return int(width * mlp_ratio)


def find_mlp_ratio(width: int, hidden: int, expected: float) -> float:
    """Return a ratio for which `hidden_width` returns `hidden`; the expected ratio if it is one."""
    if hidden_width(width, expected) == hidden:
        return expected
    exact = hidden / width
    return exact if hidden_width(width, exact) == hidden else (hidden + 0.5) / width
