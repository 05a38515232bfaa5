"""Loading `model.base`: folders, missing models, and a predictor without states in Meta's format."""

import logging
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from paths import GOLDEN
from tiny_models import draw, tiny_model
from vjepa2_ac.config import EncoderSizes, ModelConfig, ModelSizes, PredictorSizes, SizesConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints import load_base, load_official
from vjepa2_ac.model.world_model import ENCODER, PREDICTOR, WorldModel

BLOCK_LAYERS = ("norm1", "attn.qkv", "attn.proj", "norm2", "mlp.fc1", "mlp.fc2")
OTHER_LAYERS = ("predictor_embed", "action_encoder", "predictor_norm", "predictor_proj")


def names_in_file(depth: int) -> set[str]:
    """Return the names of all tensors in the file: weight and bias of each layer."""
    block_layers = [f"predictor_blocks.{index}.{layer}" for index in range(depth) for layer in BLOCK_LAYERS]
    return {f"module.{name}.{kind}" for name in (*OTHER_LAYERS, *block_layers) for kind in ("weight", "bias")}


def write_predictor_file(path: Path, model: WorldModel) -> Path:
    """Write the predictor of a model without states, with optimizer and scaler states that must be ignored."""
    state: dict[str, Tensor] = model.predictor.state_dict()
    weights: dict[str, Tensor] = {}
    for name in names_in_file(model.sizes.predictor.depth):
        our_name = (
            name.removeprefix("module.").replace("predictor_blocks.", "blocks.").replace(".attn.proj.", ".attn.o.")
        )
        our_names = [our_name.replace(".qkv.", f".{part}.") for part in "qkv"] if ".qkv." in our_name else [our_name]
        weights[name] = torch.cat([state[part] for part in our_names])
    moments = {index: {"step": torch.tensor(9.0), "exp_avg": value} for index, value in enumerate(weights.values())}
    opt = {"state": moments, "param_groups": [{"lr": 1e-4, "params": list(moments)}]}
    torch.save({"predictor": weights, "opt": opt, "scaler": None, "epoch": 9}, path)
    return path


def load_with_sizes(base: Path | str, sizes: SizesConfig) -> WorldModel:
    return load_base(ModelConfig(base=str(base), sizes=sizes, dtype="float32"), seed=0)


def test_sizes_that_contradict_a_model_folder_raise_with_their_keys(model: WorldModel, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path / "model")
    sizes = {"image_size": 64, "encoder": {"depth": 2, "heads": 4}, "predictor": {"width": 36, "heads": 3}}
    configured = SizesConfig.model_validate(sizes)
    with pytest.raises(InputError, match=r"image_size 48, and model\.sizes has 64, encoder\.heads 2, and .* 4"):
        load_with_sizes(tmp_path / "model", configured)


def test_folder_without_a_model_raises_with_the_export_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"config\.json: cannot be read: No such.*`vjepa2-ac export RUN FOLDER`"):
        load_with_sizes(tmp_path, SizesConfig())


@pytest.mark.parametrize("part", [ENCODER, PREDICTOR])
def test_weight_that_is_not_finite_raises_with_its_name(model: WorldModel, tmp_path: Path, part: str) -> None:
    model.save_pretrained(tmp_path)
    weights = load_file(tmp_path / part)
    name = sorted(weights)[-1]
    weights[name].flatten()[-1] = float("nan")
    save_file(weights, tmp_path / part)
    with pytest.raises(InputError, match=rf"{part}: {name} contains NaN or infinity"):
        load_with_sizes(tmp_path, SizesConfig())


MODEL = tiny_model(states=False)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_predictor_file(tmp_path / "vjepa2_ac_droid.pth.tar", MODEL)


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    MODEL.save_pretrained(tmp_path / "encoder")
    return tmp_path / "encoder"


def load_with_encoder(file: Path, encoder: Path, **settings: Any) -> WorldModel:
    # The tensors do not determine the image size and the number of heads.
    sizes = {"image_size": 48, "predictor": {"width": 36, "heads": 3}}
    config = {"base": str(file), "encoder": {"path": str(encoder)}, "sizes": sizes, "dtype": "float32", **settings}
    return load_base(ModelConfig.model_validate(config), seed=0)


def test_loaded_model_predicts_as_the_saved_one_and_logs_its_licence_once(
    file: Path, encoder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        model = load_with_encoder(file, encoder)
    assert model.sizes == MODEL.sizes
    inputs = draw(1, 3, 9, 24), draw(1, 3, 7), draw(1, 3, 7)
    with torch.no_grad():
        assert torch.equal(model.predict(*inputs), MODEL.predict(*inputs))
        frames = draw(1, 2, 3, 48, 48)
        assert torch.equal(model.encode(frames), MODEL.encode(frames))
    licence, unknown_encoder = (record.getMessage() for record in caplog.records)
    assert licence.startswith(f"{file}: weights of a predictor without states. ")
    assert "CC-BY-NC 4.0: for non-commercial use only" in licence
    assert f"{file} does not record the encoder on which its predictor was trained" in unknown_encoder


def test_predictor_file_that_does_not_fit_raises(file: Path, encoder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"predictor\.use_extrinsics|predictor: 2 tensors do not match"):
        load_with_encoder(
            file, encoder, sizes={"image_size": 48, "predictor": {"width": 36, "heads": 3, "use_extrinsics": True}}
        )
    with pytest.raises(InputError, match=r"no encoder \(keys: predictor, opt, scaler, epoch\)"):
        load_official(file, MODEL.sizes)
    wider = WorldModel.random(
        ModelSizes(
            image_size=48,
            encoder=EncoderSizes(width=48, depth=1, heads=2, mlp_ratio=2.0),
            predictor=PredictorSizes(width=36, depth=1, heads=3),
        ),
        seed=0,
    )
    wider.save_pretrained(tmp_path / "wider")
    with pytest.raises(InputError, match=r"predictor_embed.weight has shape \[36, 24\], not \[36, 48\].*model.encoder"):
        load_with_encoder(file, tmp_path / "wider")
    with pytest.raises(InputError, match=r"a model with an encoder, but model.encoder sets another encoder"):
        load_with_encoder(tmp_path / "wider", encoder)
    with pytest.raises(InputError, match=r"a model with an encoder, but model.encoder sets another encoder"):
        load_with_encoder(GOLDEN / "model" / "tiny.pt", encoder)
    content = torch.load(file, weights_only=True)
    content["predictor"]["module.predictor_proj.bias"][0] = float("nan")
    torch.save(content, file)
    with pytest.raises(InputError, match=r"predictor_proj\.bias contains NaN"):
        load_with_encoder(file, encoder)
