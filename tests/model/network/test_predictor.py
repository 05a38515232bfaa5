"""The predictor, and its key-value cache: steps computed one after another equal steps computed in one pass."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from model_fixtures import move_trained
from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.predictor import ActionConditionedPredictor, KeyValueCache, new_predictor
from vjepa2_ac.model.world_model import WorldModel

WIDE = ModelSizes(
    image_size=32,
    encoder=EncoderSizes(width=24, heads=2),
    predictor=PredictorSizes(width=240, depth=3, heads=4, mlp_ratio=2.0),
)


def test_predictions_depend_on_their_own_and_earlier_steps_only(model: WorldModel, inputs) -> None:
    before = model.predict(inputs.latents, inputs.actions, inputs.states)
    for name in ("latents", "actions", "states"):
        changed = {"latents": inputs.latents, "actions": inputs.actions, "states": inputs.states}
        changed[name] = changed[name].clone()
        changed[name][:, 2] += 1.0
        after = model.predict(**changed)
        assert torch.equal(before[:, :2], after[:, :2]), name
        assert not torch.isclose(before[:, 2:], after[:, 2:]).all(dim=(0, 2, 3)).any(), name


@pytest.mark.parametrize("uses_transformers", [True, False])
def test_initial_output_weights_decrease_with_depth(uses_transformers: bool) -> None:
    predictor = new_predictor(WIDE)
    if not uses_transformers:
        predictor.initialise(torch.Generator().manual_seed(0))
    for layer, block in enumerate(predictor.blocks, start=1):
        for name, weight, std in (
            ("o", block.attn.o.weight, 0.02 / (2 * layer) ** 0.5),
            ("fc2", block.mlp.fc2.weight, 0.02 / (2 * layer) ** 0.5),
            ("q", block.attn.q.weight, 0.02),
            ("fc1", block.mlp.fc1.weight, 0.02),
        ):
            assert weight.std().item() == pytest.approx(std, rel=0.03), f"{name} of layer {layer}"
    assert not any(value.any() for name, value in predictor.named_parameters() if name.endswith("bias"))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # raised by transformers' own loader
def test_transformers_loads_a_saved_predictor(model: WorldModel, tmp_path: Path, inputs) -> None:
    model.save_pretrained(tmp_path / "model")
    loaded = ActionConditionedPredictor.from_pretrained(tmp_path / "model" / "predictor")
    expected = model.predictor(inputs.latents, inputs.actions, inputs.states)
    assert torch.equal(loaded(inputs.latents, inputs.actions, inputs.states), expected)


LORA = AdapterConfig(rank=4, alpha=8.0, dropout=0.0)


def make_adapted_model(sizes: ModelSizes, *, extrinsics: bool = False) -> WorldModel:
    """Return a model with an adapter that changes the predictions."""
    predictor = sizes.predictor.model_copy(update={"use_extrinsics": extrinsics})
    model = WorldModel.random(sizes.model_copy(update={"predictor": predictor}), seed=0)
    add_adapter(model, LORA, seed=0)
    move_trained(model)
    return model.train()  # type: ignore[return-value]


def make_arguments(inputs: Any, *, extrinsics: bool = False) -> list[Tensor]:
    """Return the arguments of `predict`, with gradients."""
    arguments = [inputs.latents, inputs.actions, inputs.states]
    if extrinsics:
        arguments.append(torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(3)))
    return [value.clone().requires_grad_() for value in arguments]


def predict_with_cache(model: WorldModel, arguments: list[Tensor], steps_per_call: tuple[int, ...]) -> Tensor:
    cache = KeyValueCache()
    calls = zip(*(value.split(steps_per_call, dim=1) for value in arguments), strict=True)
    return torch.cat([model.predict(*call, cache=cache) for call in calls], dim=1)


def output_and_gradients(model: WorldModel, predicted: Tensor, arguments: list[Tensor]) -> list[Tensor]:
    weights = torch.randn(predicted.shape, generator=torch.Generator().manual_seed(4))
    trained = [value for value in model.parameters() if value.requires_grad]
    return [predicted, *torch.autograd.grad((predicted * weights).sum(), [*arguments, *trained])]


def assert_near(actual: list[Tensor], expected: list[Tensor]) -> None:
    """Check that the norm of each difference is small, relative to the norm of the expected tensor."""
    for value, expected_value in zip(actual, expected, strict=True):
        assert expected_value.any()
        assert (value - expected_value).norm() <= 1e-5 * expected_value.norm()


@pytest.mark.parametrize("steps_per_call", [(1, 1, 1, 1), (1, 3)])
@pytest.mark.parametrize(("extrinsics", "checkpointing"), [(False, False), (True, True)])
def test_cached_steps_give_the_predictions_and_gradients_of_a_single_pass(
    sizes: ModelSizes, inputs, steps_per_call: tuple[int, ...], extrinsics: bool, checkpointing: bool
) -> None:
    model = make_adapted_model(sizes, extrinsics=extrinsics)
    arguments = make_arguments(inputs, extrinsics=extrinsics)
    expected = output_and_gradients(model, model.predict(*arguments), arguments)
    model.set_gradient_checkpointing(checkpointing)
    predicted = predict_with_cache(model, arguments, steps_per_call)
    assert_near(output_and_gradients(model, predicted, arguments), expected)


def rollout_without_cache(model: WorldModel, context: Tensor, actions: Tensor, states: Tensor) -> Tensor:
    """Return a rollout in which each prediction is computed from all earlier frames."""
    latents = context
    for time in range(context.shape[1], actions.shape[1] + 1):
        following = model.predict(latents, actions[:, :time], states[:, :time])[:, -1:]
        latents = torch.cat([latents, following], dim=1)
    return latents[:, context.shape[1] :]


@pytest.mark.parametrize("context", [1, 3])
@torch.no_grad()
def test_rollout_equals_a_rollout_without_a_cache(sizes: ModelSizes, inputs, context: int) -> None:
    model = make_adapted_model(sizes)
    arguments = (inputs.latents[:, :context], inputs.actions, inputs.states)
    expected = rollout_without_cache(model, *arguments)
    torch.testing.assert_close(model.rollout(*arguments), expected, rtol=1e-5, atol=1e-5)
