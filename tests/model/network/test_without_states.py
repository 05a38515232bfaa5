"""A predictor without states equals a predictor with states whose state tokens are removed."""

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import layer_norm

from tiny_models import DIM, draw, tiny_model
from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_folder import load_trained, save_trained
from vjepa2_ac.model.attention import TokenLayout, rotary_tables
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import (
    WorldModel,
    find_projections_to_replace,
    get_model_widths,
    replace_input_projections,
)

STEPS, GRID = 4, 3
LORA = AdapterConfig(rank=2, alpha=4.0)
with_and_without_extrinsics = pytest.mark.parametrize("extrinsics", [False, True])


def make_models(*, extrinsics: bool = False) -> tuple[WorldModel, WorldModel]:
    """Return a model with states, and a model without states that otherwise has the same weights."""
    full, stateless = (tiny_model(extrinsics=extrinsics, states=states) for states in (True, False))
    shared = {name: full.predictor.state_dict()[name] for name in stateless.predictor.state_dict()}
    stateless.predictor.load_state_dict(shared)
    return full, stateless


def make_inputs(*, extrinsics: bool = False) -> list[Tensor]:
    latents = layer_norm(draw(2, STEPS, GRID**2, DIM), (DIM,))
    inputs = [latents, draw(2, STEPS, 7, seed=2), draw(2, STEPS, 7, seed=3)]
    return [*inputs, draw(2, STEPS, 6, seed=4)] if extrinsics else inputs


def predict_without_state_tokens(full: WorldModel, latents: Tensor, actions: Tensor, cameras: list[Tensor]) -> Tensor:
    """Return the predictions of a model with states if its sequence has no state tokens."""
    predictor, steps = full.predictor, latents.shape[1]
    conditions = [predictor.action_encoder(actions), *(predictor.extrinsics_encoder(camera) for camera in cameras)]
    patches = predictor.predictor_embed(latents)
    tokens = torch.cat([*(condition[:, :, None] for condition in conditions), patches], dim=2)
    per_step = tokens.shape[2]
    tables = rotary_tables(TokenLayout(steps, GRID, len(conditions)), 12, tokens.device)
    tokens = tokens.flatten(1, 2)
    for block in predictor.blocks:
        tokens, _ = block(tokens, tables, per_step, "dense", 0)
    patches = tokens.unflatten(1, (steps, per_step))[:, :, len(conditions) :]
    return layer_norm(predictor.predictor_proj(predictor.predictor_norm(patches)), (DIM,))


@with_and_without_extrinsics
@pytest.mark.parametrize("attention", ["dense", "per_step"])
@torch.no_grad()
def test_predictions_equal_those_of_a_model_with_states_after_removing_state_tokens(
    extrinsics: bool, attention: str
) -> None:
    full, stateless = make_models(extrinsics=extrinsics)
    stateless.set_attention(attention)
    latents, actions, states, *cameras = make_inputs(extrinsics=extrinsics)
    expected = predict_without_state_tokens(full, latents, actions, cameras)
    torch.testing.assert_close(stateless.predict(latents, actions, states, *cameras), expected, atol=1e-5, rtol=1e-5)
    difference = (full.predict(latents, actions, states, *cameras) - expected).abs().max()
    assert difference > 1e-3, "states must affect the model with states"


@with_and_without_extrinsics
@torch.no_grad()
def test_states_of_any_value_and_width_do_not_change_predictions(extrinsics: bool) -> None:
    _, stateless = make_models(extrinsics=extrinsics)
    latents, actions, states, *cameras = make_inputs(extrinsics=extrinsics)
    expected = stateless.predict(latents, actions, states, *cameras)
    expected_rollout = stateless.rollout(latents[:, :1], actions, states, *cameras)
    for other_states in (states + 1, draw(2, STEPS, 14), draw(2, STEPS, 1) * 1e9, states * float("nan")):
        assert torch.equal(stateless.predict(latents, actions, other_states, *cameras), expected)
        assert torch.equal(stateless.rollout(latents[:, :1], actions, other_states, *cameras), expected_rollout)
    assert not torch.equal(stateless.predict(latents, actions + 1, states, *cameras), expected)


def test_adapter_on_the_missing_state_encoder_raises() -> None:
    with pytest.raises(
        InputError, match=r"modules_to_save: state_encoder, which a predictor without states does not have"
    ):
        add_adapter(tiny_model(states=False), LORA.model_copy(update={"modules_to_save": ("state_encoder",)}), seed=0)
    with pytest.raises(InputError, match="state_encoder matches no layer"):
        add_adapter(tiny_model(states=False), LORA.model_copy(update={"targets": ("q", "state_encoder")}), seed=0)


@pytest.mark.parametrize("width", [1, 7, 14])
def test_states_of_any_width_fit_and_another_action_width_needs_a_new_projection(width: int, tmp_path: Path) -> None:
    model = tiny_model(states=False)
    assert find_projections_to_replace(model.sizes, Widths(width, 7)) == ()
    assert replace_input_projections(model, Widths(width, 7), seed=0) == []
    assert len(replace_input_projections(model, Widths(width, 14), seed=0)) == 1
    assert get_model_widths(model.sizes) == Widths(14, 14)
    add_adapter(model, LORA.model_copy(update={"modules_to_save": ("action_encoder",)}), seed=0)
    save_trained(model, tmp_path / "adapter")
    load_trained(tiny_model(states=False), tmp_path / "adapter")
