"""Rotary positions, and all implementations of block-causal attention."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._dynamo import config as dynamo
from torch.utils.checkpoint import checkpoint

from tracing import tracing
from vjepa2_ac.errors import InputError
from vjepa2_ac.model import attention
from vjepa2_ac.model.attention import (
    AttentionKind,
    TokenLayout,
    block_causal_attention,
    rotary_tables,
    rotate,
)
from vjepa2_ac.model.blocks import Block

CPU = torch.device("cpu")


def rotate_numbers(token: list[float], position: tuple[int, int, int]) -> list[float]:
    """Rotate one number at a time: three equal parts, neighbours are pairs, frequencies are tiled."""
    part = 2 * ((len(token) // 3) // 2)
    half = part // 2
    rotated = list(token)
    for axis, coordinate in enumerate(position):
        for offset in range(part):
            angle = coordinate * 10000 ** (-(offset % half) / half)
            index = axis * part + offset
            partner = token[index + 1] if offset % 2 == 0 else token[index - 1]
            sign = -1 if offset % 2 == 0 else 1
            rotated[index] = token[index] * math.cos(angle) + sign * partner * math.sin(angle)
    return rotated


@pytest.mark.parametrize("head_dim", [12, 16, 64])
def test_each_token_is_rotated_by_its_time_row_and_column(head_dim: int) -> None:
    layout = TokenLayout(steps=3, grid=2, conditioning=2)
    shape = (1, layout.steps * layout.tokens_per_step, 1, head_dim)
    tokens = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    rotated = rotate(tokens, rotary_tables(layout, head_dim, CPU))
    # The two conditioning tokens of a step have a time, but no row and column.
    positions = [(time, *patch) for time in range(3) for patch in [(0, 0), (0, 0), (0, 0), (0, 1), (1, 0), (1, 1)]]
    for index, position in enumerate(positions):
        expected = torch.tensor(rotate_numbers(tokens[0, index, 0].tolist(), position))
        torch.testing.assert_close(rotated[0, index, 0], expected, rtol=1e-5, atol=1e-6)


def test_tables_with_a_later_start_equal_the_end_of_a_longer_sequence() -> None:
    longer, later = rotary_tables(TokenLayout(4, 3, 2), 12, CPU), rotary_tables(TokenLayout(3, 3, 2, start=1), 12, CPU)
    for longer_table, later_table in zip(longer, later, strict=True):
        torch.testing.assert_close(later_table, longer_table[11:])


def test_gradients_equal_numerical_gradients() -> None:
    tables = rotary_tables(TokenLayout(2, 2, 1), 14, torch.device("cpu"))
    tokens = torch.randn(1, 10, 2, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda values: rotate(values, tables), tokens.requires_grad_())


PER_STEP = 5
LONG_PER_STEP, LONG_STEPS = 66, 7  # 462 tokens: not a multiple of a kernel's tiles, and too long for short kernels
ON_CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"))
ROUNDING = {torch.float32: 2e-3, torch.bfloat16: 2e-2}  # on CUDA, relative to the largest value


def make_inputs() -> list[Tensor]:
    """Return random queries, keys and values of four steps."""
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(2, 2, 4 * PER_STEP, 16, generator=generator) for _ in range(3)]


@pytest.mark.filterwarnings("ignore:flex_attention called without torch.compile")  # this test needs no compiler
def test_flex_output_equals_that_of_the_dense_mask() -> None:
    query, key, value = make_inputs()
    expected = block_causal_attention(query, key, value, PER_STEP, "dense")
    output = block_causal_attention(query, key, value, PER_STEP, "flex")
    torch.testing.assert_close(output, expected, rtol=1e-5, atol=1e-6)
    last = block_causal_attention(query[:, :, 2 * PER_STEP :], key, value, PER_STEP, "flex")
    torch.testing.assert_close(last, expected[:, :, 2 * PER_STEP :], rtol=1e-5, atol=1e-6)


def assert_near(actual: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    assert len(actual) == len(expected) > 1
    for value, expected_value in zip(actual, expected, strict=True):
        largest = expected_value.float().abs().max()
        assert (value.float() - expected_value.float()).abs().max() <= tolerance * largest


@pytest.mark.parametrize("num_query_steps", [LONG_STEPS, 2], ids=["all steps", "the last two"])
@pytest.mark.parametrize("dtype", list(ROUNDING), ids=str)
@pytest.mark.parametrize("kind", ["flex", "per_step", "auto"])
@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
def test_implementations_agree_at_training_lengths(
    device: str, kind: AttentionKind, dtype: torch.dtype, num_query_steps: int
) -> None:
    if kind == "flex" and device == "cpu":
        pytest.skip("FlexAttention has gradients on CUDA only")
    generator = torch.Generator().manual_seed(0)
    shape = (2, 2, LONG_PER_STEP * LONG_STEPS, 64)
    query, key, value = (torch.randn(shape, generator=generator).to(device) for _ in range(3))
    query = query[:, :, -num_query_steps * LONG_PER_STEP :]

    def output_and_gradients(kind: AttentionKind, dtype: torch.dtype) -> list[Tensor]:
        inputs = [tensor.to(dtype, copy=True).requires_grad_() for tensor in (query, key, value)]
        output = block_causal_attention(*inputs, LONG_PER_STEP, kind)
        weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(1)).to(output)
        return [output, *torch.autograd.grad((output * weights).sum(), inputs)]

    assert_near(output_and_gradients(kind, dtype), output_and_gradients("dense", torch.float32), ROUNDING[dtype])


@pytest.mark.filterwarnings(*(mark.args[0] for mark in tracing))
@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
@pytest.mark.parametrize("kind", ["per_step", "flex"])
def test_attention_of_a_compiled_and_checkpointed_block_equals_the_dense_one(
    request: pytest.FixtureRequest, kind: AttentionKind, device: str
) -> None:
    if device == "cpu":
        if kind == "flex":
            pytest.skip("FlexAttention has gradients on CUDA only")
        request.getfixturevalue("traced")  # on CUDA the real compiler is used
    block = Block(128, 2, 256, layer=1)
    generator = torch.Generator().manual_seed(0)
    for value in block.parameters():
        nn.init.normal_(value.data, std=0.05, generator=generator)
    block.to(device)
    tokens = torch.randn(1, LONG_PER_STEP * LONG_STEPS, 128, generator=generator).to(device)
    tables = rotary_tables(TokenLayout(LONG_STEPS, 8, conditioning=2), 64, torch.device(device))

    def output_and_gradients(kind: AttentionKind, *, is_optimised: bool) -> list[Tensor]:
        block.compiled = "always" if is_optimised else "never"
        inputs = tokens.clone().requires_grad_()
        arguments: tuple[Any, ...] = (inputs, tables, LONG_PER_STEP, kind)
        output, _ = checkpoint(block, *arguments, use_reentrant=False) if is_optimised else block(*arguments)
        return [output, *torch.autograd.grad(output.square().sum(), [inputs, *block.parameters()])]

    expected = output_and_gradients("dense", is_optimised=False)
    assert_near(output_and_gradients(kind, is_optimised=True), expected, ROUNDING[torch.float32])


@pytest.fixture
def traced_flex(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trace FlexAttention with torch.compile, as on CUDA, but run the traced code without a compiler."""
    original = attention._flex_attention
    monkeypatch.setattr(attention, "_flex_attention", lambda _: original(True))


def attend_with_flex(num_clips: int) -> Tensor:
    query, key, value = (tensor[:1].expand(num_clips, -1, -1, -1) for tensor in make_inputs())
    return block_causal_attention(query, key, value, PER_STEP, "flex")


@pytest.mark.filterwarnings(*(mark.args[0] for mark in tracing))
@pytest.mark.usefixtures("traced", "traced_flex")
def test_too_many_flex_compilations_raise_with_a_fix() -> None:
    attend_with_flex(1)
    with dynamo.patch(recompile_limit=2):
        attend_with_flex(2)
        with pytest.raises(InputError, match=r"training\.attention: .*more than 2 sizes.*training\.attention=per_step"):
            attend_with_flex(3)


@pytest.mark.parametrize("kind", ["dense", "per_step"])
def test_steps_attend_to_themselves_and_earlier_steps_only(kind: AttentionKind) -> None:
    query, key, value = make_inputs()
    before = block_causal_attention(query, key, value, PER_STEP, kind)
    changed = value.clone()
    changed[:, :, 2 * PER_STEP + 4] += 1.0  # the last token of step 2
    after = block_causal_attention(query, key, changed, PER_STEP, kind)
    is_equal = (before == after).all(dim=-1).all(dim=1).all(dim=0)
    assert is_equal[: 2 * PER_STEP].all()
    assert not is_equal[2 * PER_STEP :].any()
