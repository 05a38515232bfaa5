"""Properties of new, trained, disabled, saved, loaded and merged adapters."""

import copy
import json
from collections.abc import Callable
from pathlib import Path

import peft
import pytest
import torch
from torch import Tensor

from model_fixtures import tiny_inputs, tiny_model
from vjepa2_ac.config import AdapterConfig, ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_folder import load_trained, save_trained
from vjepa2_ac.model.lora import (
    add_adapter,
    copy_with_merged_adapter,
    merge_adapter,
    trainable_report,
    use_base_weights,
)
from vjepa2_ac.model.model_files import EncoderOrigin
from vjepa2_ac.model.predictor import ActionConditionedPredictor
from vjepa2_ac.model.world_model import WorldModel

LORA = AdapterConfig(rank=4, alpha=8.0, dropout=0.0)
FULL = AdapterConfig(kind="none")
Fresh = Callable[..., WorldModel]
METHODS = {
    "lora": LORA,
    "dora": LORA.model_copy(update={"dora": True}),
    "projections": LORA.model_copy(
        update={"targets": ("all",), "modules_to_save": ("action_encoder", "state_encoder")}
    ),
    "patterns": AdapterConfig(
        rank=4,
        alpha=8.0,
        rslora=False,
        peft={"rank_pattern": {"fc1": 6, r"blocks\.0\.attn\.(q|k)": 2}, "alpha_pattern": {"fc2": 3.0}},
    ),
    "one layer": AdapterConfig(
        rank=4, alpha=8.0, targets=("blocks.1.attn.q", "fc1"), peft={"init_lora_weights": "gaussian"}
    ),
}
both_kinds = pytest.mark.parametrize("config", [*METHODS.values(), FULL], ids=[*METHODS, "none"])
every_method = pytest.mark.parametrize("config", METHODS.values(), ids=METHODS)
both_types = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])


def predict(model: WorldModel, inputs) -> Tensor:
    with torch.no_grad():
        return model.predict(inputs.latents, inputs.actions, inputs.states)


def train(model: WorldModel, inputs, steps: int = 3) -> None:
    """Take a few large steps, so that the trained weights differ clearly."""
    model.train()
    trained = [value for value in model.parameters() if value.requires_grad]
    optimizer = torch.optim.SGD(trained, lr=1.0)
    for _ in range(steps):
        optimizer.zero_grad()
        predicted = model.predict(inputs.latents[:, :-1], inputs.actions[:, :-1], inputs.states[:, :-1])
        (predicted - inputs.latents[:, 1:]).abs().mean().backward()
        optimizer.step()
    model.eval()


@pytest.fixture(scope="module")
def trained() -> Callable[..., WorldModel]:
    """Return a function that returns a copy of a model with trained weights; each config is trained only once."""
    models: dict[tuple[str, torch.dtype], WorldModel] = {}

    def make(config: AdapterConfig, dtype: torch.dtype = torch.float32) -> WorldModel:
        key = config.model_dump_json(), dtype
        if key not in models:
            models[key] = tiny_model(dtype=dtype)
            add_adapter(models[key], config, seed=0)
            train(models[key], tiny_inputs())
        return copy.deepcopy(models[key])

    return make


def copy_weights(model: WorldModel) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in model.named_parameters()}


@both_types
@every_method
def test_new_adapter_leaves_predictions_unchanged(
    fresh: Fresh, inputs, config: AdapterConfig, dtype: torch.dtype
) -> None:
    model = fresh(dtype=dtype)
    before = predict(model, inputs)
    add_adapter(model, config, seed=0)
    after = predict(model.eval(), inputs)
    if config.modules_to_save and dtype == torch.bfloat16:  # trained projections are float32
        torch.testing.assert_close(after, before, rtol=0, atol=0.1)
    else:
        assert torch.equal(after, before)


@both_types
@every_method
def test_training_changes_exactly_the_adapter_weights(
    fresh: Fresh, inputs, config: AdapterConfig, dtype: torch.dtype
) -> None:
    model = fresh(dtype=dtype)
    add_adapter(model, config, seed=0)
    before = copy_weights(model)
    train(model, inputs)
    for name, value in model.named_parameters():
        is_adapter = ".lora_" in name or ".modules_to_save." in name
        assert value.requires_grad == is_adapter, name
        assert value.dtype == (torch.float32 if is_adapter else dtype), name
        assert torch.equal(value, before[name]) != is_adapter, name


def test_full_fine_tuning_changes_all_predictor_weights_except_unused_extrinsics(model: WorldModel, inputs) -> None:
    add_adapter(model, FULL, seed=0)
    before = copy_weights(model)
    train(model, inputs)
    for name, value in model.named_parameters():
        is_trained = name.startswith("predictor.") and "extrinsics_encoder" not in name
        assert torch.equal(value, before[name]) != is_trained, name


def adapted_layers(model: WorldModel) -> set[str]:
    names = [name for name, _ in model.base_predictor.named_modules() if name.endswith(".lora_A")]
    return {name.removesuffix(".lora_A") for name in names}


@pytest.mark.parametrize(
    ("targets", "names"),
    [
        (("attention",), {"attn.q", "attn.k", "attn.v", "attn.o"}),
        (("mlp", "q"), {"mlp.fc1", "mlp.fc2", "attn.q"}),
        (("all",), {"attn.q", "attn.k", "attn.v", "attn.o", "mlp.fc1", "mlp.fc2"}),
    ],
)
def test_target_set_adapts_its_layers(model: WorldModel, targets: tuple[str, ...], names: set[str]) -> None:
    add_adapter(model, LORA.model_copy(update={"targets": targets}), seed=0)
    expected = {f"blocks.{index}.{name}" for index in range(2) for name in names}
    if targets == ("all",):
        expected |= {"predictor_embed", "predictor_proj", "action_encoder", "state_encoder"}
    assert adapted_layers(model) == expected


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"peft": {"rank_pattern": {"fc3": 2}}}, r"adapter\.peft: .*rank_pattern keys did not match .*'fc3'"),
        ({"peft": {"rank_pattern": {"(": 2}}}, r"adapter\.peft: missing \)"),
        ({"peft": {"rank_patern": {"q": 2}}}, r"adapter\.peft: .*unexpected keyword argument 'rank_patern'"),
        ({"peft": {"bias": "all"}}, r"adapter\.peft: an adapter with unsupported options: 'bias' 'all'"),
        ({"targets": ("q", "state_encoder"), "modules_to_save": ("state_encoder",)}, "state_encoder, which .* too"),
        ({"targets": ("extrinsics_encoder",)}, "extrinsics_encoder matches no layer"),
    ],
)
def test_adapter_key_that_does_not_fit_the_predictor_raises(
    model: WorldModel, values: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        add_adapter(model, LORA.model_copy(update=values), seed=0)


@both_types
@both_kinds
def test_disabled_adapter_predicts_as_base_and_enabled_as_before(
    fresh: Fresh, trained: Fresh, inputs, config: AdapterConfig, dtype: torch.dtype
) -> None:
    model = trained(config, dtype)
    base = predict(fresh(dtype=torch.float32 if config.kind == "none" else dtype), inputs)
    before, adapted, num_trained = copy_weights(model), predict(model, inputs), trainable_report(model).trained
    with use_base_weights(model):
        disabled = predict(model, inputs)
    rounding = 0.05 if (config.kind, dtype) == ("none", torch.bfloat16) else 0  # float32 computation, rounded weights
    torch.testing.assert_close(disabled, base, rtol=0, atol=rounding)
    assert not torch.allclose(adapted, base, atol=0.05)
    assert torch.equal(predict(model, inputs), adapted)
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())
    assert trainable_report(model).trained == num_trained


@both_types
@both_kinds
def test_saved_weights_give_equal_predictions_after_loading(
    fresh: Fresh, trained: Fresh, inputs, tmp_path: Path, config: AdapterConfig, dtype: torch.dtype
) -> None:
    model, other = trained(config, dtype), fresh(dtype=dtype)
    save_trained(model, tmp_path)
    load_trained(other, tmp_path)
    assert torch.equal(predict(other, inputs), predict(model, inputs))
    assert not any(value.requires_grad for value in other.parameters())


@both_kinds
def test_loading_into_an_adapted_model_does_not_add_a_second_adapter(
    fresh: Fresh, trained: Fresh, inputs, tmp_path: Path, config: AdapterConfig
) -> None:
    model, resumed = trained(config), fresh()
    save_trained(model, tmp_path)
    add_adapter(resumed, config, seed=1)
    names = [name for name, _ in resumed.named_parameters()]
    load_trained(resumed, tmp_path)
    assert [name for name, _ in resumed.named_parameters()] == names
    assert trainable_report(resumed) == trainable_report(model)
    assert torch.equal(predict(resumed.eval(), inputs), predict(model, inputs))
    train(model, inputs, steps=1)
    train(resumed, inputs, steps=1)
    assert torch.equal(predict(resumed, inputs), predict(model, inputs))


@both_types
@both_kinds
def test_merged_model_predicts_the_same_and_is_a_plain_model(
    trained: Fresh, inputs, tmp_path: Path, config: AdapterConfig, dtype: torch.dtype
) -> None:
    model = trained(config, dtype)
    adapted = predict(model, inputs)
    merge_adapter(model)
    rounding = 3e-5 if dtype == torch.float32 else 0.15  # predictions are near 1; PyTorch 2.11 rounds by 1.6e-5
    torch.testing.assert_close(predict(model, inputs), adapted, rtol=0, atol=rounding)
    assert type(model.predictor) is ActionConditionedPredictor
    assert {value.dtype for value in model.parameters()} == {dtype}
    assert trainable_report(model).trained == 0
    assert model.adaptation is None
    model.save_pretrained(tmp_path / "merged")
    assert torch.equal(predict(WorldModel.from_pretrained(tmp_path / "merged"), inputs), predict(model, inputs))


def test_merge_under_autocast_equals_merge_without_autocast(trained: Fresh) -> None:
    model, other = trained(LORA), trained(LORA)
    merge_adapter(model)
    with torch.autocast("cpu", torch.bfloat16):
        merge_adapter(other)
    for name, value in model.predictor.state_dict().items():
        assert torch.equal(value, other.predictor.state_dict()[name]), name


def test_merged_copy_has_the_encoder_fingerprint_of_the_original(trained: Fresh) -> None:
    model = trained(LORA)
    model.encoder_origin = EncoderOrigin("encoder.pt", has_heads_in_fingerprint=True)
    merged = copy_with_merged_adapter(model)
    assert merged.encoder_origin == model.encoder_origin
    assert merged.encoder_fingerprint() == model.encoder_fingerprint()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # raised by the libraries' own loaders
@every_method
def test_peft_loads_a_saved_adapter_on_the_predictor(
    fresh: Fresh, trained: Fresh, inputs, tmp_path: Path, config: AdapterConfig
) -> None:
    fresh().save_pretrained(tmp_path / "base")
    model = trained(config)
    save_trained(model, tmp_path / "adapter")
    predictor = ActionConditionedPredictor.from_pretrained(tmp_path / "base" / "predictor")
    plain = peft.PeftModel.from_pretrained(predictor, str(tmp_path / "adapter"))
    with torch.no_grad():
        expected = model.predictor(inputs.latents, inputs.actions, inputs.states)
        predicted = plain.eval()(inputs.latents, inputs.actions, inputs.states)
    torch.testing.assert_close(predicted, expected, rtol=0, atol=1e-6)


def test_adapter_of_another_base_model_raises(fresh: Fresh, sizes: ModelSizes, tmp_path: Path) -> None:
    model = fresh(seed=0)
    add_adapter(model, LORA, seed=0)
    save_trained(model, tmp_path)
    with pytest.raises(InputError, match="an adapter trained on another predictor"):
        load_trained(fresh(seed=1), tmp_path)
    other_encoder = fresh(seed=0)
    other_encoder.encoder = WorldModel.random(sizes, seed=1).encoder
    with pytest.raises(InputError, match="an adapter trained on another encoder"):
        load_trained(other_encoder, tmp_path)


def change_rank(folder: Path) -> None:
    config = json.loads((folder / "adapter_config.json").read_text())
    (folder / "adapter_config.json").write_text(json.dumps(config | {"r": 8}))


def truncate(folder: Path) -> None:
    path = folder / "adapter_model.safetensors"
    path.write_bytes(path.read_bytes()[:-8])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "vjepa2_ac.json").unlink(), r"vjepa2_ac\.json: cannot be read: No such"),
        (lambda folder: (folder / "vjepa2_ac.json").write_text("[]"), r"vjepa2_ac\.json: a JSON list"),
        (lambda folder: (folder / "adapter_config.json").unlink(), r"adapter_config\.json: cannot be read: No such"),
        (truncate, "not a complete safetensors file"),
        (change_rank, r"24 tensors do not match .*has shape \[4, 36\], not \[8, 36\]"),
    ],
)
def test_incomplete_adapter_folder_raises_with_its_path(
    fresh: Fresh, tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    model = fresh()
    add_adapter(model, LORA, seed=0)
    save_trained(model, tmp_path)
    damage(tmp_path)
    with pytest.raises(InputError, match=message):
        load_trained(fresh(), tmp_path)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (LORA.model_copy(update={"rank": 2}), r"an adapter with rank 4\. Expected 2, as in the model"),
        (LORA.model_copy(update={"targets": ("q",)}), r"with targets \('fc1', .*Expected \('q',\)"),
        (FULL, r"weights of adapter\.kind lora, but the model has adapter\.kind none"),
    ],
)
def test_loading_into_an_adapter_with_another_config_raises(
    fresh: Fresh, tmp_path: Path, config: AdapterConfig, message: str
) -> None:
    model, other = fresh(), fresh()
    add_adapter(model, LORA, seed=0)
    save_trained(model, tmp_path)
    add_adapter(other, config, seed=0)
    with pytest.raises(InputError, match=message):
        load_trained(other, tmp_path)
