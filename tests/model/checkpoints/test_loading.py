"""`model.base`: found, or reported missing with a fix."""

from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from vjepa2_ac.config import EncoderSizes, ModelConfig, ModelSizes, PredictorSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model import base_model
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.pretrained_folder import ENCODER, PREDICTOR
from vjepa2_ac.model.network.world_model import WorldModel


@pytest.fixture
def assets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in for the folder of models that come with the package; there is none in it."""
    monkeypatch.setattr(base_model, "ASSETS", tmp_path / "assets")
    return tmp_path / "assets"


def load_with(base: Path | str, sizes: ModelSizes) -> WorldModel:
    return load_base(ModelConfig(base=str(base), sizes=sizes, dtype="float32"), seed=0)


def test_a_model_of_the_package_is_found_by_its_name(model: WorldModel, assets: Path) -> None:
    model.save_pretrained(assets / "sim-tiny")
    loaded = load_with("builtin:sim-tiny", ModelSizes())
    assert loaded.predictor_fingerprint() == model.predictor_fingerprint()


@pytest.mark.parametrize("empty", [True, False])
def test_a_package_without_models_says_how_to_make_one(assets: Path, empty: bool) -> None:
    if empty:
        assets.mkdir()
    with pytest.raises(InputError, match=r"it has none: .*`make base`"):
        load_with("builtin:sim-tiny", ModelSizes())


def test_sizes_that_a_folder_does_not_have_are_refused_by_name(model: WorldModel, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path / "model")
    given = ModelSizes(
        image_size=64, encoder=EncoderSizes(depth=2, heads=4), predictor=PredictorSizes(width=36, heads=3)
    )
    with pytest.raises(InputError, match=r"image_size 48, encoder\.heads 2\. needed: image_size 64, encoder\.heads 4"):
        load_with(tmp_path / "model", given)


@pytest.mark.parametrize("given", [{}, {"image_size": 48, "encoder": EncoderSizes(heads=2)}])
def test_sizes_that_a_folder_has_and_defaults_are_fine(model: WorldModel, tmp_path: Path, given: dict) -> None:
    model.save_pretrained(tmp_path / "model")
    written_out = ModelSizes.model_validate_json(ModelSizes(**given).model_dump_json())  # as in a run's config.yaml
    assert load_with(tmp_path / "model", written_out).sizes == model.sizes


def test_a_folder_that_is_no_model_gives_the_command_that_makes_one_of_a_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"config\.json: cannot be read: No such.*`vjepa2-ac export RUN FOLDER`"):
        load_with(tmp_path, ModelSizes())


@pytest.mark.parametrize("part", [ENCODER, PREDICTOR])
@pytest.mark.parametrize("value", [float("nan"), float("-inf")])
def test_a_weight_that_is_not_finite_is_named(model: WorldModel, tmp_path: Path, part: str, value: float) -> None:
    model.save_pretrained(tmp_path)
    weights = load_file(tmp_path / part)
    name = sorted(weights)[-1]
    weights[name].flatten()[-1] = value
    save_file(weights, tmp_path / part)
    with pytest.raises(InputError, match=rf"{part}: {name} holds NaN or infinity"):
        load_with(tmp_path, ModelSizes())
