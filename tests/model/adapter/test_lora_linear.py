"""Plain LoRA layers: the same results as PEFT's, in fewer passes."""

import contextlib
from typing import Any

import pytest
import torch
from peft import LoraConfig, get_peft_model
from peft.tuners.lora import Linear
from torch import Tensor, nn

from vjepa2_ac.model.lora import LoraLinear
from vjepa2_ac.model.low_rank import _LowRankLinear

PLAIN = {"r": 3, "lora_alpha": 5, "use_rslora": True}


def layer(kind: type[Linear] = LoraLinear, dtype: torch.dtype = torch.float32, **changes: Any) -> Any:
    """Return a layer of 12 inputs and 8 outputs with an adapter that does something."""
    generator = torch.Generator().manual_seed(0)
    config = LoraConfig(target_modules=["0"], **PLAIN | changes)
    config._register_custom_module({nn.Linear: kind})
    made = get_peft_model(nn.Sequential(nn.Linear(12, 8)), config).get_base_model()[0]
    for value in made.parameters():
        value.data = torch.randn(value.shape, generator=generator) / 3
    made.base_layer.to(dtype).requires_grad_(False)
    return made.train()


def tokens(dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(2, 5, 12, generator=torch.Generator().manual_seed(1)).to(dtype)


def output_and_gradients(made: Linear, given: Tensor, *, autocast: bool = False) -> list[Tensor]:
    """Return the output and the gradients of the tokens and of both matrices, with the same masks for the same seed."""
    given = given.clone().requires_grad_()
    torch.manual_seed(2)
    with torch.autocast("cpu", torch.bfloat16) if autocast else contextlib.nullcontext():
        output = made(given)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(3)).to(output.dtype)
    (output * weights).sum().backward()
    found = [output, given.grad, made.lora_A["default"].weight.grad, made.lora_B["default"].weight.grad]
    assert all(value is not None for value in found)
    return [value.detach() for value in found if value is not None]


@pytest.fixture
def by_peft(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Tell what was left to PEFT."""
    calls: list[str] = []
    original = Linear.forward

    def forward(self: Linear, *args: Any, **kwargs: Any) -> Tensor:
        calls.append(type(self).__name__)
        return original(self, *args, **kwargs)  # type: ignore[no-any-return]

    monkeypatch.setattr(Linear, "forward", forward)
    return calls


@pytest.mark.parametrize("dropout", [0.0, 0.4])
def test_in_float32_outputs_and_gradients_are_those_of_peft(by_peft: list[str], dropout: float) -> None:
    expected = output_and_gradients(layer(Linear, lora_dropout=dropout), tokens())
    assert by_peft == ["Linear"]
    found = output_and_gradients(layer(lora_dropout=dropout), tokens())
    assert by_peft == ["Linear"]
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("base", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("given", [torch.float32, torch.bfloat16])
def test_in_bfloat16_it_rounds_no_more_than_peft_and_types_stay(
    by_peft: list[str], base: torch.dtype, given: torch.dtype
) -> None:
    exact = output_and_gradients(layer(), tokens())
    expected = output_and_gradients(layer(Linear, base), tokens(given), autocast=True)
    found = output_and_gradients(layer(LoraLinear, base), tokens(given), autocast=True)
    assert by_peft == ["Linear"]
    for one, other, true in zip(found, expected, exact, strict=True):
        assert one.dtype == other.dtype
        assert (one - true).norm() < 1.5 * (other - true).norm() + 1e-6


@pytest.mark.parametrize(
    "changes",
    [
        {"use_dora": True},
        {"lora_bias": True},
        {"disabled": True},
        {"merged": True},
        {"thawed": True},
        {"flat": True},
        {"dtype": torch.bfloat16},
    ],
    ids=["dora", "bias", "switched off", "merged", "the layer is trained", "one token", "types that differ"],
)
def test_what_is_not_plain_is_left_to_peft(by_peft: list[str], changes: dict[str, Any]) -> None:
    dtype = changes.get("dtype", torch.float32)
    outputs = []
    for kind in (LoraLinear, Linear):
        made = layer(kind, dtype, **{name: True for name in ("use_dora", "lora_bias") if name in changes})
        made.base_layer.requires_grad_("thawed" in changes)
        if "disabled" in changes:
            made.enable_adapters(enabled=False)
        if "merged" in changes:
            made.merge()
        outputs.append(made(tokens(dtype)[0, 0] if "flat" in changes else tokens(dtype)))
    assert torch.equal(*outputs)
    assert by_peft == ["LoraLinear", "Linear"]


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("reached", [True, False])
def test_gradients_are_those_of_differences(masked: bool, reached: bool) -> None:
    draw = lambda *shape: torch.randn(*shape, dtype=torch.float64, requires_grad=True)  # noqa: E731
    torch.manual_seed(0)
    weight, bias = draw(4, 6).detach(), draw(4).detach()
    inputs = (draw(2, 3, 6).requires_grad_(reached), draw(2, 3, 6) if masked else None, weight, bias, draw(2, 6))
    assert torch.autograd.gradcheck(_LowRankLinear.apply, (*inputs, draw(4, 2), None, None, 0.7))
