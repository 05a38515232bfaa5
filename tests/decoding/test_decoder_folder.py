"""The folder of a decoder: read as it was written, and refused where it is not what it should be."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from run_fixtures import TINY
from vjepa2_ac.config import DataConfig, ModelSizes
from vjepa2_ac.decoding.decoder import CARD, SIMULATED, WEIGHTS, load_decoder, save_decoder
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage.places import NO_DATA, SIMULATION_FILE


@pytest.fixture
def folder(whole_decoder: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole_decoder, tmp_path / "copy")


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def test_a_decoder_is_read_as_it_was_written_bit_for_bit(whole_decoder: Path, tmp_path: Path) -> None:
    one = load_decoder(whole_decoder)
    save_decoder(tmp_path / "again", one.card, one.decoder.state_dict())
    other = load_decoder(tmp_path / "again")
    assert other.card == one.card
    assert not one.decoder.training
    assert not any(weight.requires_grad for weight in one.decoder.parameters())
    latents = torch.randn(2, 4, 24, generator=torch.Generator().manual_seed(0))
    assert torch.equal(one.decoder.decode(latents), other.decoder.decode(latents))
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == sorted([CARD, WEIGHTS])


@pytest.mark.parametrize(
    ("damage", "found"), [(Path.unlink, "No such file"), (truncated, "not a whole safetensors file")]
)
def test_damaged_weights_are_refused_and_named(folder: Path, damage: Callable[[Path], None], found: str) -> None:
    damage(folder / WEIGHTS)
    with pytest.raises(InputError, match=found) as caught:
        load_decoder(folder)
    assert WEIGHTS in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"format": "vjepa2-ac decoder 2"}, "format"),
        ({"more": 1}, "more: unknown"),
        ({"shape": {"size": "huge", "dim": 24, "grid": 2, "patch_size": 16}}, "shape.size"),
        ({"shape": {"size": "tiny", "dim": 10**12, "grid": 2, "patch_size": 16}}, "shape.dim"),
    ],
)
def test_a_card_with_wrong_values_is_refused_and_names_them(folder: Path, changes: dict, found: str) -> None:
    values = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(values | changes))
    with pytest.raises(InputError, match=re.escape(found)) as caught:
        load_decoder(folder)
    assert str(folder / CARD) in str(caught.value)
    assert "train the decoder again" in str(caught.value)


@pytest.mark.parametrize("name", ["nowhere", "file", "empty"])
def test_a_folder_without_a_decoder_is_refused_with_the_command_that_makes_one(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"--decoder .*no decoder\.json there") as caught:
        load_decoder(tmp_path / name)
    assert "vjepa2-ac decoder CONFIG" in str(caught.value)


def test_a_model_of_another_encoder_crop_or_size_is_refused(whole_decoder: Path, base_folder: Path) -> None:
    decoder, model = load_decoder(whole_decoder), WorldModel.from_pretrained(base_folder)
    data, square = DataConfig(path=decoder.card.data), DataConfig(path=decoder.card.data, crop="square")
    assert decoder.require_fit(model, data, subject="run") == ()
    other = WorldModel.random(ModelSizes.model_validate(TINY), seed=4)
    with pytest.raises(InputError, match=r"another encoder or crop than that of run.*vjepa2-ac decoder CONFIG"):
        decoder.require_fit(other, data, subject="run")
    with pytest.raises(InputError, match=r"data\.crop released, not square"):
        decoder.require_fit(model, square, subject="run")
    larger = WorldModel.random(ModelSizes.model_validate(TINY | {"image_size": 64}), seed=3)
    same = replace(decoder, card=replace(decoder.card, encoder=larger.encoder_fingerprint()))  # the same weights
    with pytest.raises(InputError, match="image size 32, not 64"):
        same.require_fit(larger, data, subject="run")


def test_a_decoder_of_other_data_warns_with_both_data_sets(
    whole_decoder: Path, base_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder, model = load_decoder(whole_decoder), WorldModel.from_pretrained(base_folder)
    own, (real, simulated) = Path(decoder.card.data), (tmp_path / "real", tmp_path / "simulated")
    simulated.mkdir()
    (simulated / SIMULATION_FILE).write_text("{}")
    ours = replace(decoder, name="builtin:sim-tiny")
    fits = {
        (decoder, str(own)): True, (decoder, str(real)): False, (decoder, SIMULATED): False, (decoder, NO_DATA): True,
        (ours, str(real)): False, (ours, str(simulated)): True, (ours, SIMULATED): True,
    }  # fmt: skip
    for (one, shown), is_own in fits.items():
        said = one.require_fit(model, DataConfig(path=str(own)), subject="run", shown=shown)
        learned = SIMULATED if one is ours else str(own)
        warning = f"The decoder {one.name} was trained on {learned}, not on {shown}: its images may be wrong."
        assert said == (() if is_own else (warning,))
    monkeypatch.chdir(own.parent)
    assert decoder.require_fit(model, DataConfig(path=own.name), subject="run") == (), "the same folder"
    assert decoder.require_fit(model, DataConfig(path=str(real)), subject="run"), "by default the data of the config"
