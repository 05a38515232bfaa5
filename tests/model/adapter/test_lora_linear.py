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


def make_layer(kind: type[Linear] = LoraLinear, dtype: torch.dtype = torch.float32, **changes: Any) -> Any:
    """Return a layer with 12 inputs, 8 outputs, and an adapter that changes the output."""
    generator = torch.Generator().manual_seed(0)
    config = LoraConfig(target_modules=["0"], **PLAIN | changes)
    config._register_custom_module({nn.Linear: kind})
    adapted = get_peft_model(nn.Sequential(nn.Linear(12, 8)), config).get_base_model()[0]
    for value in adapted.parameters():
        value.data = torch.randn(value.shape, generator=generator) / 3
    adapted.base_layer.to(dtype).requires_grad_(False)
    return adapted.train()


def tokens(dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(2, 5, 12, generator=torch.Generator().manual_seed(1)).to(dtype)


def output_and_gradients(layer: Linear, inputs: Tensor, *, autocast: bool = False) -> list[Tensor]:
    """Return the output and the gradients of the tokens and both matrices; dropout masks are the same in each call."""
    inputs = inputs.clone().requires_grad_()
    torch.manual_seed(2)
    with torch.autocast("cpu", torch.bfloat16) if autocast else contextlib.nullcontext():
        output = layer(inputs)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(3)).to(output.dtype)
    (output * weights).sum().backward()
    results = [output, inputs.grad, layer.lora_A["default"].weight.grad, layer.lora_B["default"].weight.grad]
    assert all(value is not None for value in results)
    return [value.detach() for value in results if value is not None]


@pytest.fixture
def peft_calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the type of each layer that PEFT computes."""
    calls: list[str] = []
    original = Linear.forward

    def forward(self: Linear, *args: Any, **kwargs: Any) -> Tensor:
        calls.append(type(self).__name__)
        return original(self, *args, **kwargs)  # type: ignore[no-any-return]

    monkeypatch.setattr(Linear, "forward", forward)
    return calls


@pytest.mark.parametrize("dropout", [0.0, 0.4])
def test_float32_outputs_and_gradients_equal_those_of_peft(peft_calls: list[str], dropout: float) -> None:
    expected = output_and_gradients(make_layer(Linear, lora_dropout=dropout), tokens())
    assert peft_calls == ["Linear"]
    actual = output_and_gradients(make_layer(lora_dropout=dropout), tokens())
    assert peft_calls == ["Linear"]
    for value, expected_value in zip(actual, expected, strict=True):
        torch.testing.assert_close(value, expected_value, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("base", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("input_dtype", [torch.float32, torch.bfloat16])
def test_bfloat16_error_is_at_most_that_of_peft_with_equal_data_types(
    peft_calls: list[str], base: torch.dtype, input_dtype: torch.dtype
) -> None:
    exact = output_and_gradients(make_layer(), tokens())
    expected = output_and_gradients(make_layer(Linear, base), tokens(input_dtype), autocast=True)
    actual = output_and_gradients(make_layer(LoraLinear, base), tokens(input_dtype), autocast=True)
    assert peft_calls == ["Linear"]
    for value, peft_value, exact_value in zip(actual, expected, exact, strict=True):
        assert value.dtype == peft_value.dtype
        assert (value - exact_value).norm() < 1.5 * (peft_value - exact_value).norm() + 1e-6


@pytest.mark.parametrize(
    "changes",
    [
        {"use_dora": True},
        {"lora_bias": True},
        {"disabled": True},
        {"merged": True},
        {"trained": True},
        {"one token": True},
        {"dtype": torch.bfloat16},
    ],
    ids=["dora", "bias", "disabled", "merged", "trained layer", "one token", "different data types"],
)
def test_layers_other_than_plain_lora_are_computed_by_peft(peft_calls: list[str], changes: dict[str, Any]) -> None:
    dtype = changes.get("dtype", torch.float32)
    outputs = []
    for kind in (LoraLinear, Linear):
        adapted = make_layer(kind, dtype, **{name: True for name in ("use_dora", "lora_bias") if name in changes})
        adapted.base_layer.requires_grad_("trained" in changes)
        if "disabled" in changes:
            adapted.enable_adapters(enabled=False)
        if "merged" in changes:
            adapted.merge()
        outputs.append(adapted(tokens(dtype)[0, 0] if "one token" in changes else tokens(dtype)))
    assert torch.equal(*outputs)
    assert peft_calls == ["LoraLinear", "Linear"]


@pytest.mark.parametrize("is_masked", [True, False])
@pytest.mark.parametrize("needs_token_gradient", [True, False])
def test_gradients_equal_numerical_gradients(is_masked: bool, needs_token_gradient: bool) -> None:
    draw = lambda *shape: torch.randn(*shape, dtype=torch.float64, requires_grad=True)  # noqa: E731
    torch.manual_seed(0)
    weight, bias = draw(4, 6).detach(), draw(4).detach()
    tokens, masked = draw(2, 3, 6).requires_grad_(needs_token_gradient), draw(2, 3, 6) if is_masked else None
    inputs = (tokens, masked, weight, bias, draw(2, 6))
    assert torch.autograd.gradcheck(_LowRankLinear.apply, (*inputs, draw(4, 2), None, None, 0.7))
