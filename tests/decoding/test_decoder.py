"""The decoder: saving, loading, errors for unsuitable models, and properties of the network."""

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


def test_saved_decoder_gives_bit_exact_images_after_loading(whole_decoder: Path, tmp_path: Path) -> None:
    original = load_decoder(whole_decoder)
    save_decoder(tmp_path / "copy", original.card, original.decoder.state_dict())
    loaded = load_decoder(tmp_path / "copy")
    assert loaded.card == original.card
    assert not original.decoder.training
    assert not any(weight.requires_grad for weight in original.decoder.parameters())
    latents = torch.randn(2, 4, 24, generator=torch.Generator().manual_seed(0))
    assert torch.equal(original.decoder.decode(latents), loaded.decoder.decode(latents))
    assert sorted(path.name for path in (tmp_path / "copy").iterdir()) == sorted([CARD, WEIGHTS])


@pytest.mark.parametrize(
    ("damage", "message"), [(Path.unlink, "No such file"), (truncate, "not a complete safetensors file")]
)
def test_damaged_weights_raise_with_the_file_name(folder: Path, damage: Callable[[Path], None], message: str) -> None:
    damage(folder / WEIGHTS)
    with pytest.raises(InputError, match=message) as caught:
        load_decoder(folder)
    assert WEIGHTS in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "vjepa2-ac decoder 2"}, "format"),
        ({"more": 1}, "more: unknown"),
        ({"shape": {"size": "huge", "dim": 24, "grid": 2, "patch_size": 16}}, "shape.size"),
        ({"shape": {"size": "tiny", "dim": 10**12, "grid": 2, "patch_size": 16}}, "shape.dim"),
    ],
)
def test_invalid_card_values_raise_with_their_names(folder: Path, changes: dict, message: str) -> None:
    values = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(values | changes))
    with pytest.raises(InputError, match=re.escape(message)) as caught:
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
    assert decoder.require_compatible(model, data, subject="run") == ()
    other_encoder = WorldModel.random(ModelSizes.model_validate(TINY), seed=4)
    with pytest.raises(InputError, match=r"does not fit the encoder and crop of run.*vjepa2-ac decoder CONFIG"):
        decoder.require_compatible(other_encoder, data, subject="run")
    with pytest.raises(InputError, match=r"data\.crop released, the model's is square"):
        decoder.require_compatible(model, square, subject="run")
    larger = WorldModel.random(ModelSizes.model_validate(TINY | {"image_size": 64}), seed=3)
    same_encoder = replace(decoder, card=replace(decoder.card, encoder=larger.encoder_fingerprint()))
    with pytest.raises(InputError, match="image size 32, the model's is 64"):
        same_encoder.require_compatible(larger, data, subject="run")


def test_decoder_trained_on_other_data_warns_with_both_data_sets(
    whole_decoder: Path, base_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder, model = load_decoder(whole_decoder), WorldModel.from_pretrained(base_folder)
    training_data, real, simulated = Path(decoder.card.data), tmp_path / "real", tmp_path / "simulated"
    simulated.mkdir()
    (simulated / SIMULATION_FILE).write_text("{}")
    builtin = replace(decoder, name="builtin:sim-tiny")
    cases = {(decoder, training_data): True, (decoder, real): False, (builtin, real): False, (builtin, simulated): True}
    for (trained, data), is_same_data in cases.items():
        warnings = trained.require_compatible(model, DataConfig(path=str(data)), subject="run")
        trained_on = SIMULATED if trained is builtin else str(training_data)
        warning = (
            f"The decoder {trained.name} was trained on {trained_on}, not on {data}: its images may be inaccurate."
        )
        assert warnings == (() if is_same_data else (warning,))
    monkeypatch.chdir(training_data.parent)
    assert decoder.require_compatible(model, DataConfig(path=training_data.name), subject="run") == (), (
        "the same folder"
    )


# ---- the network ----

SIZES = ["linear", "tiny"]


def make_decoder_of_size(size: str, seed: int = 0) -> Decoder:
    decoder = Decoder(DecoderShape(size, dim=24, grid=3, patch_size=8))  # type: ignore[arg-type]
    decoder.initialise(torch.Generator().manual_seed(seed))
    return decoder.eval()


def random_latents(*batch: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*batch, 9, 24, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", SIZES)
def test_decoded_image_depends_only_on_the_latents_of_its_frame(size: str) -> None:
    decoder, latents = make_decoder_of_size(size), random_latents(4)
    images = decoder.decode(latents)
    changed_latents = latents.clone()
    changed_latents[2] = random_latents(1, seed=2)[0]
    changed_images = decoder.decode(changed_latents)
    are_equal = [torch.equal(image, changed) for image, changed in zip(images, changed_images, strict=True)]
    assert are_equal == [True, True, False, True]


@pytest.mark.parametrize("size", SIZES)
def test_decoded_images_are_independent_of_the_chunk_size(size: str) -> None:
    decoder, latents = make_decoder_of_size(size), random_latents(2, 5)
    expected = decoder.decode(latents)
    assert expected.shape == (2, 5, 3, 24, 24)
    for chunk in (1, 3, 4):
        torch.testing.assert_close(decoder.decode(latents, chunk=chunk), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(decoder.decode(latents[1, 3]), expected[1, 3], atol=1e-5, rtol=0)


def test_decoder_starts_equal_to_the_linear_decoder() -> None:
    linear, decoder, latents = make_decoder_of_size("linear", seed=3), make_decoder_of_size("tiny"), random_latents(3)
    assert not torch.equal(decoder(latents), linear(latents))
    decoder.copy_linear(linear)
    assert torch.equal(decoder(latents), linear(latents))
    loss, _ = decoder_loss(decoder(latents), torch.rand(3, 3, 24, 24, generator=torch.Generator().manual_seed(4)))
    loss.backward()
    gradient = decoder.further[-2].weight.grad
    assert gradient.abs().max() > 0, "without a gradient the decoder would stay linear"


def test_patch_depends_on_one_token_in_the_linear_decoder_and_on_all_in_others() -> None:
    latents = random_latents(1)
    changed_latents = latents.clone()
    changed_latents[0, 5] += 1.0  # second row, third column
    for size in SIZES:
        decoder = make_decoder_of_size(size)
        has_changed = (decoder(latents) != decoder(changed_latents))[0].any(dim=0)
        is_in_patch = torch.zeros_like(has_changed)
        is_in_patch[8:16, 16:24] = True
        assert has_changed[is_in_patch].all()
        assert bool(has_changed[~is_in_patch].any()) == (size != "linear")


def test_loss_of_equal_images_is_zero_and_each_term_detects_its_difference() -> None:
    images = torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    assert float(decoder_loss(images, images)[0]) == pytest.approx(0, abs=1e-6)
    brighter = decoder_loss(images + 0.1, images)[1]
    assert float(brighter["l1"]) == pytest.approx(0.1, abs=1e-5)
    assert float(brighter["edges"]) == pytest.approx(0, abs=1e-5)
    blurred = decoder_loss(torch.nn.functional.avg_pool2d(images, 3, 1, 1), images)[1]
    assert float(blurred["structure"]) > 0.1
    assert float(blurred["edges"]) > 0.1
