from pathlib import Path

import pytest
import torch

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model.network.predictor import ActionConditionedPredictor, PredictorConfig
from vjepa2_ac.model.network.world_model import WorldModel

WIDE = PredictorConfig(
    image_size=32, latent_dim=24, hidden_size=240, num_hidden_layers=3, num_attention_heads=4, mlp_ratio=2.0
)


def test_a_prediction_depends_on_its_own_and_earlier_steps_only(model: WorldModel, inputs) -> None:
    before = model.predict(inputs.latents, inputs.actions, inputs.states)
    for name in ("latents", "actions", "states"):
        changed = {"latents": inputs.latents, "actions": inputs.actions, "states": inputs.states}
        changed[name] = changed[name].clone()
        changed[name][:, 2] += 1.0
        after = model.predict(**changed)
        assert torch.equal(before[:, :2], after[:, :2]), name
        assert not torch.isclose(before[:, 2:], after[:, 2:]).all(dim=(0, 2, 3)).any(), name


@pytest.mark.parametrize("image_size", [16, 80])
def test_other_image_sizes_work(image_size: int) -> None:
    small = PredictorSizes(width=12, depth=1, heads=2)
    model = WorldModel.random(
        ModelSizes(image_size=image_size, encoder=EncoderSizes(width=12, depth=1, heads=2), predictor=small), seed=0
    )
    latents = model.encode(torch.zeros(1, 2, 3, image_size, image_size))
    assert latents.shape[2] == (image_size // 16) ** 2
    assert model.predict(latents, torch.zeros(1, 2, 7), torch.zeros(1, 2, 7)).shape == latents.shape


@pytest.mark.parametrize("by_transformers", [True, False])
def test_output_layers_start_smaller_the_deeper_they_are(by_transformers: bool) -> None:
    predictor = ActionConditionedPredictor(WIDE)
    if not by_transformers:
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


def test_gradient_checkpointing_keeps_less(model: WorldModel, inputs) -> None:
    model.predictor.requires_grad_(True)

    def kept_bytes(checkpointing: bool) -> int:
        model.set_gradient_checkpointing(checkpointing)
        sizes: list[int] = []
        with torch.autograd.graph.saved_tensors_hooks(
            lambda tensor: sizes.append(tensor.nbytes) or tensor, lambda tensor: tensor
        ):
            model.predict(inputs.latents, inputs.actions, inputs.states)
        return sum(sizes)

    assert kept_bytes(True) < kept_bytes(False) / 3


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of transformers' own loader
def test_transformers_loads_the_predictor_by_itself(model: WorldModel, tmp_path: Path, inputs) -> None:
    model.save_pretrained(tmp_path / "model")
    alone = ActionConditionedPredictor.from_pretrained(tmp_path / "model" / "predictor")
    expected = model.predictor(inputs.latents, inputs.actions, inputs.states)
    assert torch.equal(alone(inputs.latents, inputs.actions, inputs.states), expected)
