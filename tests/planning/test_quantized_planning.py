"""Plans in 8 bits are close to the plain ones, and the given model stays unchanged; bfloat16 only."""

import copy
import importlib.util
import sys

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch.nn import Linear

from tiny_models import actions, cost, tiny_model
from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.planning import CemConfig, GradientConfig, PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model import quantization
from vjepa2_ac.model.adapter.lora import add_adapter
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.model_setup import prepare_for_planning

with_torchao = pytest.mark.skipif(
    importlib.util.find_spec("torchao") is None or not quantization.has_int8(),
    reason="torchao (extra quantize) is not installed, or this CPU's products in 8 bits are wrong",
)
PLAIN = PlanningConfig(samples=64, iterations=3, cem=CemConfig(elites=8))
INT8 = PLAIN.model_copy(update={"quantize": "int8"})
FP8 = PLAIN.model_copy(update={"quantize": "fp8"})


def in_bfloat16(*, adapted: bool = False) -> WorldModel:
    """Return a tiny model with frozen weights in bfloat16, what is trained in float32."""
    model = tiny_model(adapted=adapted)
    for value in model.parameters():
        if not value.requires_grad:
            value.data = value.data.bfloat16()
    return model


@with_torchao
@torch.no_grad()
@pytest.mark.parametrize("adapted", [False, True])
def test_energies_in_8_bits_are_nearly_the_plain_ones(adapted: bool) -> None:
    model, tried = in_bfloat16(adapted=adapted), actions(50, 3)
    before, exact = cost(model)(tried), cost(copy.deepcopy(model).float())(tried)
    smaller = prepare_for_planning(model, INT8)
    assert smaller.encoder is model.encoder
    assert smaller.adaptation is None
    energies = cost(smaller)(tried)
    assert not torch.equal(energies, before)
    assert (energies - before).norm() < 0.01 * before.norm()
    assert (energies - exact).std() < 2.5 * (before - exact).std()  # what 8 bits add to bfloat16's own rounding
    assert torch.equal(cost(model)(tried), before)  # the given model is as it was
    assert (model.adaptation is not None) == adapted


@with_torchao
def test_a_controller_plans_in_8_bits() -> None:
    images = np.random.default_rng(0).integers(0, 256, (3, 48, 48, 3), dtype=np.uint8)
    state, model = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2]), in_bfloat16(adapted=True)
    found: list[list[np.ndarray]] = []
    energies: list[list[float]] = []
    for config in (PLAIN, INT8, INT8):
        run = Controller(model, config)
        run.reset(images[0])
        found.append([])
        energies.append([])
        for image in images[1:]:
            found[-1].append(run.act(image, state))
            energies[-1].append(run.decision.plan.energy)
    np.testing.assert_array_equal(found[1], found[2])
    np.testing.assert_allclose(energies[1], energies[0], rtol=0.01)  # as good; which of two is taken hangs by a digit
    assert not np.array_equal(found[1], found[0])


@with_torchao
def test_fp8_needs_a_device_that_has_it() -> None:
    with pytest.raises(InputError, match=r"fp8, on cpu.*compute capability 8\.9.*planning\.quantize=int8 or off"):
        Controller(in_bfloat16(), FP8)


@pytest.fixture
def has_fp8(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let torchao make fp8 weights on a CPU, without its device check."""
    quant_api = pytest.importorskip("torchao.quantization.quant_api", reason="the extra quantize is not installed")
    monkeypatch.setattr(quantization, "_has_fp8", lambda _: True)
    monkeypatch.setattr(quant_api, "_check_hardware_support", lambda _: None)


@pytest.mark.usefixtures("has_fp8")
def test_on_a_device_that_has_fp8_every_layer_of_the_blocks_is_in_it() -> None:
    sizes = tiny_model().sizes
    sizes = sizes.model_copy(update={"predictor": sizes.predictor.model_copy(update={"width": 48})})
    model = WorldModel.random(sizes, seed=0, dtype=torch.bfloat16)
    add_adapter(model, AdapterConfig(rank=2), seed=0)
    ready = prepare_for_planning(model, FP8).predictor
    layers = {name: layer.weight for name, layer in ready.named_modules() if isinstance(layer, Linear)}
    in_fp8 = {name for name, weight in layers.items() if getattr(weight, "qdata", weight).dtype == torch.float8_e4m3fn}
    assert in_fp8 == {name for name in layers if name.startswith("blocks.")}
    assert len(in_fp8) == 12


@pytest.mark.usefixtures("has_fp8")
def test_layers_that_fp8_does_not_have_are_refused() -> None:
    with pytest.raises(InputError, match=r"fp8, and layer 0\.attn\.q from 36 to 36.*multiples of 16"):
        Controller(in_bfloat16(), FP8)


@with_torchao
@pytest.mark.parametrize("kind", ["int8", "fp8"])
@pytest.mark.parametrize("adapter", [None, "lora", "none"])
def test_8_bits_in_float32_are_refused(kind: str, adapter: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quantization, "_has_fp8", lambda _: True)
    model = tiny_model()
    if adapter is not None:
        add_adapter(model, AdapterConfig(kind=adapter, rank=2), seed=0)
    reported = rf"planning\.quantize: {kind}, with weights in float32.*needed: bfloat16.*model\.dtype=bfloat16"
    with pytest.raises(InputError, match=reported):
        Controller(model, PLAIN.model_copy(update={"quantize": kind}))


@with_torchao
def test_a_predictor_that_was_trained_whole_is_in_its_bases_type() -> None:
    model = in_bfloat16()
    add_adapter(model, AdapterConfig(kind="none"), seed=0)
    assert model.predictor.predictor_norm.weight.dtype == torch.float32
    prepare_for_planning(model, INT8)


def test_without_its_library_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "torchao"] or ["torchao"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"torchao is not installed.*\[quantize\]"):
        Controller(in_bfloat16(), INT8)


def test_gradients_are_not_in_8_bits() -> None:
    with pytest.raises(ValidationError, match="planner gradient needs gradients"):
        PlanningConfig(planner="gradient", gradient=GradientConfig(starts=2), quantize="int8")


@with_torchao
def test_a_cpu_whose_sums_overflow_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quantization, "has_int8", lambda: False)
    with pytest.raises(InputError, match=r"where PyTorch's sums overflow\. Set planning\.quantize=off"):
        Controller(in_bfloat16(), INT8)
