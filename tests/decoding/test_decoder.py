"""The decoder survives save and load; an image depends on all latents of its own frame only."""

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
from vjepa2_ac.decoding.decoder import CARD, SIMULATED, WEIGHTS, Decoder, DecoderShape, load_decoder, save_decoder
from vjepa2_ac.decoding.training import decoder_loss
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage.paths import SIMULATION_FILE


@pytest.fixture
def folder(whole_decoder: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole_decoder, tmp_path / "copy")


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def test_decoder_survives_save_and_load_bit_exactly(whole_decoder: Path, tmp_path: Path) -> None:
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
    ("damage", "found"), [(Path.unlink, "No such file"), (truncate, "not a complete safetensors file")]
)
def test_damaged_weights_raise_with_their_name(folder: Path, damage: Callable[[Path], None], found: str) -> None:
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
def test_invalid_card_values_raise_with_their_names(folder: Path, changes: dict, found: str) -> None:
    values = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(values | changes))
    with pytest.raises(InputError, match=re.escape(found)) as caught:
        load_decoder(folder)
    assert str(folder / CARD) in str(caught.value)
    assert "train the decoder again" in str(caught.value)


@pytest.mark.parametrize("name", ["nowhere", "file", "empty"])
def test_folder_without_a_decoder_raises_with_the_command(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"--decoder .*no decoder\.json") as caught:
        load_decoder(tmp_path / name)
    assert "vjepa2-ac decoder CONFIG" in str(caught.value)


def test_model_with_another_encoder_crop_or_size_raises(whole_decoder: Path, base_folder: Path) -> None:
    decoder, model = load_decoder(whole_decoder), WorldModel.from_pretrained(base_folder)
    data, square = DataConfig(path=decoder.card.data), DataConfig(path=decoder.card.data, crop="square")
    assert decoder.require_fit(model, data, subject="run") == ()
    other = WorldModel.random(ModelSizes.model_validate(TINY), seed=4)
    with pytest.raises(InputError, match=r"does not fit the encoder and crop of run.*vjepa2-ac decoder CONFIG"):
        decoder.require_fit(other, data, subject="run")
    with pytest.raises(InputError, match=r"data\.crop released, the model's is square"):
        decoder.require_fit(model, square, subject="run")
    larger = WorldModel.random(ModelSizes.model_validate(TINY | {"image_size": 64}), seed=3)
    same = replace(decoder, card=replace(decoder.card, encoder=larger.encoder_fingerprint()))  # the same weights
    with pytest.raises(InputError, match="image size 32, the model's is 64"):
        same.require_fit(larger, data, subject="run")


def test_decoder_of_other_data_warns_with_both_data_sets(
    whole_decoder: Path, base_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder, model = load_decoder(whole_decoder), WorldModel.from_pretrained(base_folder)
    own, (real, simulated) = Path(decoder.card.data), (tmp_path / "real", tmp_path / "simulated")
    simulated.mkdir()
    (simulated / SIMULATION_FILE).write_text("{}")
    ours = replace(decoder, name="builtin:sim-tiny")
    fits = {(decoder, own): True, (decoder, real): False, (ours, real): False, (ours, simulated): True}
    for (one, shown), is_own in fits.items():
        said = one.require_fit(model, DataConfig(path=str(shown)), subject="run")
        learned = SIMULATED if one is ours else str(own)
        warning = f"The decoder {one.name} was trained on {learned}, not on {shown}: its images may be inaccurate."
        assert said == (() if is_own else (warning,))
    monkeypatch.chdir(own.parent)
    assert decoder.require_fit(model, DataConfig(path=own.name), subject="run") == (), "the same folder"


# ---- the network ----

SIZES = ["linear", "tiny"]


def make_decoder_of_size(size: str, seed: int = 0) -> Decoder:
    decoder = Decoder(DecoderShape(size, dim=24, grid=3, patch_size=8))  # type: ignore[arg-type]
    decoder.initialise(torch.Generator().manual_seed(seed))
    return decoder.eval()


def random_latents(*batch: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*batch, 9, 24, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", SIZES)
def test_decoded_image_depends_on_its_own_frame_only(size: str) -> None:
    decoder, latents = make_decoder_of_size(size), random_latents(4)
    images = decoder.decode(latents)
    other = latents.clone()
    other[2] = random_latents(1, seed=2)[0]
    changed = decoder.decode(other)
    same = [torch.equal(one, two) for one, two in zip(images, changed, strict=True)]
    assert same == [True, True, False, True]


@pytest.mark.parametrize("size", SIZES)
def test_decoded_images_are_independent_of_the_chunk_size(size: str) -> None:
    decoder, latents = make_decoder_of_size(size), random_latents(2, 5)
    whole = decoder.decode(latents)
    assert whole.shape == (2, 5, 3, 24, 24)
    for chunk in (1, 3, 4):
        torch.testing.assert_close(decoder.decode(latents, chunk=chunk), whole, atol=1e-5, rtol=0)
    torch.testing.assert_close(decoder.decode(latents[1, 3]), whole[1, 3], atol=1e-5, rtol=0)


def test_decoder_starts_equal_to_the_linear_decoder() -> None:
    linear, decoder, latents = make_decoder_of_size("linear", seed=3), make_decoder_of_size("tiny"), random_latents(3)
    assert not torch.equal(decoder(latents), linear(latents))
    decoder.copy_linear(linear)
    assert torch.equal(decoder(latents), linear(latents))
    loss, _ = decoder_loss(decoder(latents), torch.rand(3, 3, 24, 24, generator=torch.Generator().manual_seed(4)))
    loss.backward()
    last = decoder.further[-2].weight.grad
    assert last.abs().max() > 0, "or it would remain the linear one"


def test_patch_depends_on_one_token_in_the_linear_decoder_and_on_all_in_others() -> None:
    latents = random_latents(1)
    other = latents.clone()
    other[0, 5] += 1.0  # second row, third column
    for size in SIZES:
        decoder = make_decoder_of_size(size)
        moved = (decoder(latents) != decoder(other))[0].any(dim=0)
        inside = torch.zeros_like(moved)
        inside[8:16, 16:24] = True
        assert moved[inside].all()
        assert bool(moved[~inside].any()) == (size != "linear")


def test_loss_of_equal_images_is_zero_and_each_term_detects_its_difference() -> None:
    images = torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    assert float(decoder_loss(images, images)[0]) == pytest.approx(0, abs=1e-6)
    brighter = decoder_loss(images + 0.1, images)[1]
    assert float(brighter["l1"]) == pytest.approx(0.1, abs=1e-5)
    assert float(brighter["edges"]) == pytest.approx(0, abs=1e-5)
    blurred = decoder_loss(torch.nn.functional.avg_pool2d(images, 3, 1, 1), images)[1]
    assert float(blurred["structure"]) > 0.1
    assert float(blurred["edges"]) > 0.1
