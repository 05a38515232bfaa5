"""New input projections, for robots whose states or actions have other widths than those of the base model."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from model_fixtures import move_trained
from vjepa2_ac.config import AdapterConfig, ModelConfig, ModelSizes
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_folder import load_trained, save_trained
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.lora import add_adapter, merge_adapter
from vjepa2_ac.model.predictor import ActionConditionedPredictor
from vjepa2_ac.model.world_model import (
    WorldModel,
    find_projections_to_replace,
    get_model_widths,
    replace_input_projections,
)

TINY = ModelSizes.model_validate(
    {
        "image_size": 32,
        "encoder": {"width": 24, "depth": 1, "heads": 2, "mlp_ratio": 2.0},
        "predictor": {"width": 24, "depth": 2, "heads": 2},
    }
)
INPUT_PROJECTIONS = ("action_encoder", "state_encoder")
# With a larger alpha, rounding in float32 would exceed the tolerances of these tests.
LORA = AdapterConfig(rank=2, alpha=4.0, dropout=0.0, modules_to_save=INPUT_PROJECTIONS)
FULL = AdapterConfig(kind="none")
both_kinds = pytest.mark.parametrize("config", [LORA, FULL], ids=["lora", "none"])
widths = pytest.mark.parametrize("widths", [Widths(14, 14), Widths(8, 7)], ids=str)


def base_model() -> WorldModel:
    return WorldModel.random(TINY, seed=1)


def model_with_widths(widths: Widths) -> WorldModel:
    model = base_model()
    replace_input_projections(model, widths, seed=0)
    return model


def predict(model: WorldModel, widths: Widths) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    latents, states, actions = (torch.randn(1, 3, *shape, generator=generator) for shape in ((4, 24), *zip(widths)))
    with torch.no_grad():
        return model.predict(latents, actions, states)


def trained_model(widths: Widths, config: AdapterConfig) -> WorldModel:
    """Return an adapted model, all of whose trained weights have changed."""
    model = model_with_widths(widths)
    add_adapter(model, config, seed=0)
    move_trained(model)
    return model


@widths
def test_only_input_projections_of_other_widths_are_replaced_and_reported(widths: Widths) -> None:
    model, before = base_model(), base_model().predictor.state_dict()
    lines = replace_input_projections(model, widths, seed=0)
    replaced = {name: width for name, width in zip(INPUT_PROJECTIONS, widths[::-1], strict=True) if width != 7}
    expected = [f"New {name.replace('_', ' ')} for {width} numbers" for name, width in replaced.items()]
    assert [line.partition(",")[0] for line in lines] == expected
    assert find_projections_to_replace(TINY, widths) == tuple(replaced)
    for name, value in model.predictor.state_dict().items():
        if name.split(".")[0] not in find_projections_to_replace(TINY, widths):
            assert torch.equal(value, before[name]), name
    assert get_model_widths(model.sizes) == widths
    assert (model.predictor.config.state_dim, model.predictor.config.action_dim) == widths
    assert predict(model, widths).shape == (1, 3, 4, 24)


def test_new_input_projection_that_would_not_be_trained_raises_with_the_fix() -> None:
    trains_none = LORA.model_copy(update={"modules_to_save": ()})
    with pytest.raises(InputError, match=r"modules_to_save=\[action_encoder, state_encoder\]"):
        add_adapter(model_with_widths(Widths(14, 14)), trains_none, seed=0)
    trains_actions = LORA.model_copy(update={"modules_to_save": ("action_encoder",)})
    with pytest.raises(InputError, match=r"new state encoder would not be trained.*=\[action_encoder, state_encoder\]"):
        add_adapter(model_with_widths(Widths(8, 7)), trains_actions, seed=0)
    add_adapter(model_with_widths(Widths(7, 8)), trains_actions, seed=0)  # only the action encoder is new


@both_kinds
@widths
def test_trained_input_projections_load_into_the_base_model(
    tmp_path: Path, config: AdapterConfig, widths: Widths
) -> None:
    model = trained_model(widths, config)
    save_trained(model, tmp_path)
    loaded = base_model()
    load_trained(loaded, tmp_path)
    assert torch.equal(predict(loaded, widths), predict(model, widths))
    assert not any(value.requires_grad for value in loaded.parameters())
    resumed = model_with_widths(widths)
    add_adapter(resumed, config, seed=0)
    load_trained(resumed, tmp_path, trainable=True)
    assert torch.equal(predict(resumed, widths), predict(model, widths))
    names = [name for name, value in resumed.predictor.named_parameters() if value.requires_grad]
    assert all(any(projection in name for name in names) for projection in INPUT_PROJECTIONS)


@both_kinds
@widths
def test_merged_model_with_new_input_projections_loads_as_a_base_model(
    tmp_path: Path, config: AdapterConfig, widths: Widths
) -> None:
    model = trained_model(widths, config)
    before = predict(model, widths)
    merge_adapter(model)
    assert model.new_input_projections is None
    model.save_pretrained(tmp_path)
    loaded = load_base(ModelConfig(base=str(tmp_path), dtype="float32"), seed=0)
    assert get_model_widths(loaded.sizes) == widths
    assert replace_input_projections(loaded, widths, seed=3) == []
    torch.testing.assert_close(predict(loaded, widths), before, atol=1e-5, rtol=1e-5)
    predictor = ActionConditionedPredictor.from_pretrained(tmp_path / "predictor")
    assert (predictor.state_encoder.in_features, predictor.action_encoder.in_features) == widths
