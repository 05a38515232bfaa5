import math
from collections.abc import Callable

import pytest
import torch

from tracing import tracing
from vjepa2_ac.model.network.attention import TokenLayout, rotary_tables, rotate

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
def test_each_token_is_turned_by_its_time_row_and_column(head_dim: int) -> None:
    layout = TokenLayout(steps=3, grid=2, conditioning=2)
    x = torch.randn(1, layout.steps * layout.tokens_per_step, 1, head_dim, generator=torch.Generator().manual_seed(0))
    turned = rotate(x, rotary_tables(layout, head_dim, CPU))
    places = [
        (time, *place) for time in range(3) for place in [(0, 0), (0, 0), (0, 0), (0, 1), (1, 0), (1, 1)]
    ]  # two conditioning tokens have only a time
    for token, place in enumerate(places):
        expected = torch.tensor(rotated_by_hand(x[0, token, 0].tolist(), place))
        torch.testing.assert_close(turned[0, token, 0], expected, rtol=1e-5, atol=1e-6)


def test_a_later_start_is_the_rest_of_a_longer_sequence() -> None:
    whole, rest = rotary_tables(TokenLayout(4, 3, 2), 12, CPU), rotary_tables(TokenLayout(3, 3, 2, start=1), 12, CPU)
    for longer, later in zip(whole, rest, strict=True):
        torch.testing.assert_close(later, longer[11:])


def test_tables_made_in_inference_mode_can_be_trained_with() -> None:
    with torch.inference_mode():
        tables = rotary_tables(TokenLayout(2, 5, 1), 12, CPU)
    x = torch.ones(1, 52, 1, 12, requires_grad=True)
    rotate(x, tables).sum().backward()
    assert x.grad is not None


def test_bfloat16_loses_nothing_but_the_rounding_of_its_result() -> None:
    layout = TokenLayout(steps=16, grid=16)
    x = torch.randn(1, 16 * 16**2, 1, 64, generator=torch.Generator().manual_seed(0)).bfloat16()
    tables = rotary_tables(layout, 64, CPU)
    turned = rotate(x, tables)
    assert turned.dtype == torch.bfloat16
    assert torch.equal(turned, rotate(x.float(), tables).bfloat16())


def test_gradients_are_those_of_differences() -> None:
    tables = rotary_tables(TokenLayout(2, 2, 1), 14, torch.device("cpu"))
    tokens = torch.randn(1, 10, 2, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda given: rotate(given, tables), tokens.requires_grad_())


@pytest.mark.filterwarnings(*(one.args[0] for one in tracing))
@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_compiled_a_gradient_comes_through(dtype: torch.dtype) -> None:
    layout = TokenLayout(steps=2, grid=3, conditioning=2)
    tables = rotary_tables(layout, 12, CPU)
    drawn = torch.randn(1, 2 * 11, 2, 12, generator=torch.Generator().manual_seed(0)).to(dtype)

    def turned_and_learned(turn: Callable[..., torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        given = drawn.clone().requires_grad_()
        turned = turn(given, tables)
        (of_given,) = torch.autograd.grad(turned.float().square().sum(), given)
        return turned, of_given

    compiled = torch.compile(lambda given, tables: rotate(given * 1, tables), backend="eager", fullgraph=True)
    found, expected = turned_and_learned(compiled), turned_and_learned(rotate)
    assert expected[1].abs().min() > 0
    torch.testing.assert_close(found, expected)
