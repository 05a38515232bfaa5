"""Rotary positions, and every way of block-causal attention."""

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


def rotated_by_hand(x: list[float], places: tuple[int, int, int]) -> list[float]:
    """The rule of FACTS 1, one number at a time: three equal parts, neighbours are pairs, frequencies are tiled."""
    part = 2 * ((len(x) // 3) // 2)
    half = part // 2
    out = list(x)
    for axis, place in enumerate(places):
        for index in range(part):
            angle = place * 10000 ** (-(index % half) / half)
            at = axis * part + index
            partner = x[at + 1] if index % 2 == 0 else x[at - 1]
            sign = -1 if index % 2 == 0 else 1
            out[at] = x[at] * math.cos(angle) + sign * partner * math.sin(angle)
    return out


@pytest.mark.parametrize("head_dim", [12, 16, 64])
def test_each_token_is_rotated_by_its_time_row_and_column(head_dim: int) -> None:
    layout = TokenLayout(steps=3, grid=2, conditioning=2)
    x = torch.randn(1, layout.steps * layout.tokens_per_step, 1, head_dim, generator=torch.Generator().manual_seed(0))
    turned = rotate(x, rotary_tables(layout, head_dim, CPU))
    places = [
        (time, *place) for time in range(3) for place in [(0, 0), (0, 0), (0, 0), (0, 1), (1, 0), (1, 1)]
    ]  # two conditioning tokens have only a time
    for token, place in enumerate(places):
        expected = torch.tensor(rotated_by_hand(x[0, token, 0].tolist(), place))
        torch.testing.assert_close(turned[0, token, 0], expected, rtol=1e-5, atol=1e-6)


def test_tables_with_a_later_start_equal_the_end_of_a_longer_sequence() -> None:
    whole, rest = rotary_tables(TokenLayout(4, 3, 2), 12, CPU), rotary_tables(TokenLayout(3, 3, 2, start=1), 12, CPU)
    for longer, later in zip(whole, rest, strict=True):
        torch.testing.assert_close(later, longer[11:])


def test_gradients_equal_numerical_gradients() -> None:
    tables = rotary_tables(TokenLayout(2, 2, 1), 14, torch.device("cpu"))
    tokens = torch.randn(1, 10, 2, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda given: rotate(given, tables), tokens.requires_grad_())


PER_STEP = 5
REAL_STEP, REAL_STEPS = 66, 7  # 462 tokens: no multiple of a kernel's tiles, and more than short kernels take
ON_CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"))
ROUNDING = {torch.float32: 2e-3, torch.bfloat16: 2e-2}  # on CUDA, of the largest


def drawn(dtype: torch.dtype = torch.float32, steps: int = 4, device: str = "cpu") -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (2, 2, steps * PER_STEP, 16)
    return [torch.randn(shape, generator=generator).to(device, dtype).requires_grad_() for _ in range(3)]


@pytest.mark.filterwarnings("ignore:flex_attention called without torch.compile")  # eager on purpose: no compiler here
def test_flex_output_equals_that_of_the_dense_mask() -> None:
    inputs = [value.detach() for value in drawn()]
    found = block_causal_attention(*inputs, PER_STEP, "flex")
    whole = block_causal_attention(*inputs, PER_STEP, "dense")
    torch.testing.assert_close(found, whole, rtol=1e-5, atol=1e-6)
    query, key, value = inputs
    last = block_causal_attention(query[:, :, 2 * PER_STEP :], key, value, PER_STEP, "flex")
    torch.testing.assert_close(last, whole[:, :, 2 * PER_STEP :], rtol=1e-5, atol=1e-6)


def assert_near(found: list[Tensor], expected: list[Tensor], share: float) -> None:
    assert len(found) == len(expected) > 1
    for one, other in zip(found, expected, strict=True):
        assert (one.float() - other.float()).abs().max() <= share * other.float().abs().max()


@pytest.mark.parametrize("last", [REAL_STEPS, 2], ids=["all steps", "the last two"])
@pytest.mark.parametrize("dtype", list(ROUNDING), ids=str)
@pytest.mark.parametrize("kind", ["flex", "per_step", "auto"])
@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
def test_implementations_agree_at_training_lengths(
    device: str, kind: AttentionKind, dtype: torch.dtype, last: int
) -> None:
    if kind == "flex" and device == "cpu":
        pytest.skip("FlexAttention has gradients on CUDA only")
    generator = torch.Generator().manual_seed(0)
    shape = (2, 2, REAL_STEP * REAL_STEPS, 64)
    query, key, value = (torch.randn(shape, generator=generator).to(device) for _ in range(3))
    query = query[:, :, -last * REAL_STEP :]

    def outcome(kind: AttentionKind, dtype: torch.dtype) -> list[Tensor]:
        given = [one.to(dtype, copy=True).requires_grad_() for one in (query, key, value)]
        output = block_causal_attention(*given, REAL_STEP, kind)
        weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(1)).to(output)
        return [output, *torch.autograd.grad((output * weights).sum(), given)]

    assert_near(outcome(kind, dtype), outcome("dense", torch.float32), ROUNDING[dtype])


@pytest.mark.filterwarnings(*(one.args[0] for one in tracing))
@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
@pytest.mark.parametrize("kind", ["per_step", "flex"])
def test_attention_of_a_compiled_and_checkpointed_block_equals_the_dense_one(
    request: pytest.FixtureRequest, kind: AttentionKind, device: str
) -> None:
    if device == "cpu":
        if kind == "flex":
            pytest.skip("FlexAttention has gradients on CUDA only")
        request.getfixturevalue("traced")  # on CUDA the real compiler is asked
    block = Block(128, 2, 256, layer=1)
    generator = torch.Generator().manual_seed(0)
    for value in block.parameters():
        nn.init.normal_(value.data, std=0.05, generator=generator)
    block.to(device)
    tokens = torch.randn(1, REAL_STEP * REAL_STEPS, 128, generator=generator).to(device)
    tables = rotary_tables(TokenLayout(REAL_STEPS, 8, conditioning=2), 64, torch.device(device))

    def outcome(kind: AttentionKind, *, optimised: bool) -> list[Tensor]:
        block.compiled = "always" if optimised else "never"
        given = tokens.clone().requires_grad_()
        arguments: tuple[Any, ...] = (given, tables, REAL_STEP, kind)
        output, _ = checkpoint(block, *arguments, use_reentrant=False) if optimised else block(*arguments)
        return [output, *torch.autograd.grad(output.square().sum(), [given, *block.parameters()])]

    assert_near(outcome(kind, optimised=True), outcome("dense", optimised=False), ROUNDING[torch.float32])


@pytest.fixture
def flex_is_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """FlexAttention goes through torch.compile as on CUDA, but what is traced runs as it is."""
    original = attention._flex_attention
    monkeypatch.setattr(attention, "_flex_attention", lambda _: original(True))


def attended(clips: int) -> Tensor:
    query, key, value = (one.detach()[:1].expand(clips, -1, -1, -1) for one in drawn())
    return block_causal_attention(query, key, value, PER_STEP, "flex")


@pytest.mark.filterwarnings(*(one.args[0] for one in tracing))
@pytest.mark.usefixtures("traced", "flex_is_traced")
def test_too_many_flex_compilations_raise_with_a_fix() -> None:
    attended(1)
    with dynamo.patch(recompile_limit=2):
        attended(2)
        with pytest.raises(InputError, match=r"training\.attention: .*more than 2 sizes.*training\.attention=per_step"):
            attended(3)


@pytest.mark.parametrize("kind", ["dense", "per_step"])
def test_steps_attend_to_themselves_and_earlier_steps_only(kind: AttentionKind) -> None:
    query, key, value = (x.detach() for x in drawn())
    before = block_causal_attention(query, key, value, PER_STEP, kind)
    changed = value.clone()
    changed[:, :, 2 * PER_STEP + 4] += 1.0  # the last token of step 2
    after = block_causal_attention(query, key, changed, PER_STEP, kind)
    same = (before == after).all(dim=-1).all(dim=1).all(dim=0)
    assert same[: 2 * PER_STEP].all()
    assert not same[2 * PER_STEP :].any()
