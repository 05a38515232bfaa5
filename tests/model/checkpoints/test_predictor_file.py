"""A predictor without states in Meta's layout: alone as jepa-wms publishes it, and beside an encoder."""

import logging
from pathlib import Path

import pytest
import torch

from paths import GOLDEN
from predictor_files import names_in_file, write_predictor_file
from tiny_models import draw, tiny_model
from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.official import fill_predictor, load_official, predictor_shapes, predictor_sizes
from vjepa2_ac.model.network.world_model import WorldModel

MODEL = tiny_model(states=False)
GIVEN = PredictorSizes(width=36, heads=3)  # as tensors do not show


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_predictor_file(tmp_path / "vjepa2_ac_droid.pth.tar", MODEL)


def test_a_predictor_without_a_state_encoder_is_recognised_by_its_tensors(file: Path) -> None:
    shapes = predictor_shapes(file)
    assert {f"module.{name}" for name in shapes} == names_in_file(depth=2)
    assert predictor_sizes(shapes, GIVEN) == MODEL.sizes.predictor


def test_it_predicts_as_the_model_that_was_written_and_its_licence_is_told_once(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loaded = WorldModel.empty(MODEL.sizes)
    loaded.encoder = MODEL.encoder
    with caplog.at_level(logging.WARNING):
        fill_predictor(loaded.predictor, file)
    given = draw(1, 3, 9, 24), draw(1, 3, 7), draw(1, 3, 7)
    with torch.no_grad():
        assert torch.equal(loaded.predict(*given), MODEL.predict(*given))
    (told,) = (record.getMessage() for record in caplog.records)
    assert told.startswith(f"{file}: a predictor without states and without an encoder. ")
    assert "CC-BY-NC 4.0: for non-commercial use only" in told


def test_in_bfloat16_its_weights_are_rounded(file: Path) -> None:
    loaded = WorldModel.empty(MODEL.sizes)
    fill_predictor(loaded.predictor, file, torch.bfloat16)
    for name, value in loaded.predictor.state_dict().items():
        assert torch.equal(value, MODEL.predictor.state_dict()[name].bfloat16()), name


def test_tensors_of_another_predictor_are_refused(file: Path) -> None:
    with_states = WorldModel.empty(tiny_model().sizes)
    with pytest.raises(InputError, match=r"predictor: 4 tensors do not fit \(missing: extrinsics_encoder.bias; "):
        fill_predictor(with_states.predictor, file)
    whole = torch.load(file, weights_only=True)
    whole["predictor"]["module.predictor_proj.bias"][0] = float("nan")
    torch.save(whole, file)
    with pytest.raises(InputError, match=r"predictor_proj\.bias holds NaN"):
        fill_predictor(WorldModel.empty(MODEL.sizes).predictor, file)
    with pytest.raises(InputError, match=r"no weights under 'encoder' \(keys: predictor, opt, scaler, epoch\)"):
        load_official(file, MODEL.sizes)


def test_beside_an_encoder_it_is_read_whole_and_no_licence_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = torch.load(GOLDEN / "model" / "tiny.pt", weights_only=True)
    for name in [name for name in whole["predictor"] if "state_encoder" in name or "extrinsics_encoder" in name]:
        del whole["predictor"][name]
    torch.save(whole, tmp_path / "whole.pt")
    sizes = ModelSizes(image_size=64, encoder=EncoderSizes(heads=2), predictor=PredictorSizes(heads=4))
    with caplog.at_level(logging.WARNING):
        model = load_official(tmp_path / "whole.pt", sizes)
    assert not model.sizes.predictor.use_states
    assert not caplog.records
    assert load_official(tmp_path / "whole.pt", model.sizes).sizes == model.sizes
    other = sizes.model_copy(update={"predictor": sizes.predictor.model_copy(update={"use_states": False})})
    with pytest.raises(InputError, match=r"predictor\.use_states True\. needed: predictor\.use_states False"):
        load_official(GOLDEN / "model" / "tiny.pt", other)
