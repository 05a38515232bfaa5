"""Decoder training: it learns to reconstruct frames, and resumes exactly."""

import math
import os
import shutil
import signal
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from decoders import EncodeSplit
from killable import KILLED, ForkServer
from run_fixtures import TINY, MakeConfig, SilentReporter, as_yaml
from vjepa2_ac.config import DecoderConfig, ModelSizes
from vjepa2_ac.decoding import training
from vjepa2_ac.decoding.decoder import CARD, WEIGHTS, load_decoder, read_card, to_images
from vjepa2_ac.decoding.frame_pairs import PairBatch
from vjepa2_ac.decoding.training import DecoderSteps, learning_rate_at, train_decoder
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_similarity import psnr
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.process import StoppedError
from vjepa2_ac.runs.metrics_log import read_metrics_log

FINISHED = {CARD, WEIGHTS, "key.json", "metrics.jsonl", ".lock"}


def assert_same_decoder(folder: Path, expected: Path) -> None:
    weights, expected_weights = load_file(folder / WEIGHTS), load_file(expected / WEIGHTS)
    assert weights.keys() == expected_weights.keys()
    assert all(torch.equal(value, expected_weights[key]) for key, value in weights.items())
    assert read_card(folder).held_out == read_card(expected).held_out
    assert list(read_metrics_log(folder / "metrics.jsonl")) == list(read_metrics_log(expected / "metrics.jsonl"))
    # A killed process may leave partial files.
    assert {path.name for path in folder.iterdir() if path.suffix != ".partial"} == FINISHED


# ---- learning ------------------------------------------------------------------------------------------------------


def test_decoder_memorises_four_frames(make_decoder: MakeConfig, encode_split: EncodeSplit) -> None:
    config = make_decoder(options={"frames": 4, "steps": 80}, data__cache_dtype="fp32")
    pairs = encode_split(config, frames=4).read(range(4))
    decoder = load_decoder(train_decoder(config)).decoder
    assert psnr(decoder.decode(pairs.latents), to_images(pairs.images)).min() > 30


# ---- interruptions -------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("default_signals")
def test_stopped_training_resumes_exactly(
    make_decoder: MakeConfig, whole_decoder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    original_run = DecoderSteps.run

    def run_with_signal(self: object, step: int, pairs: PairBatch) -> dict:
        if step == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return original_run(self, step, pairs)  # type: ignore[arg-type]

    config = make_decoder()
    with monkeypatch.context() as patch:
        patch.setattr(DecoderSteps, "run", run_with_signal)
        with pytest.raises(StoppedError, match="stopped after step 3"):
            train_decoder(config)
    assert not (tmp_path / "decoder" / CARD).exists()
    train_decoder(config)
    assert_same_decoder(tmp_path / "decoder", whole_decoder)


def test_killed_training_resumes_exactly(
    fork_server: ForkServer, make_decoder: MakeConfig, whole_decoder: Path, tmp_path: Path
) -> None:
    (tmp_path / "config.yaml").write_text(as_yaml(make_decoder()))
    out = tmp_path / "decoder"
    command = ("decoder", str(tmp_path / "config.yaml"))
    for die_at in (12, 35):  # while frames are encoded, and between checkpoints
        assert fork_server.start(*command, folder=str(out), die_at=die_at).wait() == KILLED  # type: ignore[arg-type]
    assert fork_server.start(*command, folder=str(out)).wait() == 0  # type: ignore[arg-type]
    assert_same_decoder(out, whole_decoder)


def test_temporary_files_of_a_finished_training_are_removed_but_not_by_check(
    make_decoder: MakeConfig, whole_decoder: Path, tmp_path: Path, reporter: SilentReporter
) -> None:
    shutil.copytree(whole_decoder, tmp_path / "decoder")
    (tmp_path / "decoder" / "pairs").mkdir()
    (tmp_path / "decoder" / "training.pt").touch()
    train_decoder(make_decoder(), check_only=True)
    train_decoder(make_decoder("other"), reporter, check_only=True)
    assert any("GB of disk" in note for note in reporter.notes)
    assert (tmp_path / "decoder" / "pairs").exists(), "--check changes nothing"
    assert not (tmp_path / "other").exists()
    train_decoder(make_decoder())
    assert {path.name for path in (tmp_path / "decoder").iterdir()} == FINISHED


# ---- errors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"options": {"learning_rate": 1e-3}}, r"decoder\.learning_rate: 0\.002, not 0\.001"),
        ({"seed": 1}, "seed: 0, not 1"),
        ({"data__crop": "square"}, "crop"),
        ({"data__test_share": 0.1}, r"data\.test_share: 0\.2, not 0\.1"),
    ],
)
def test_folder_of_another_decoder_raises_with_the_difference(
    make_decoder: MakeConfig, whole_decoder: Path, tmp_path: Path, changes: dict, message: str
) -> None:
    shutil.copytree(whole_decoder, tmp_path / "decoder")
    for is_finished in (True, False):
        if not is_finished:
            (tmp_path / "decoder" / CARD).unlink()
        with pytest.raises(InputError, match=message):
            train_decoder(make_decoder(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data__source": "latents"}, r"data\.source: a latent cache, which has no frames"),
        ({"data__stride": "auto"}, r"data\.stride"),
    ],
)
def test_config_without_frames_or_stride_raises_before_the_data_is_opened(
    make_decoder: MakeConfig, tmp_path: Path, changes: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        train_decoder(make_decoder(data__path=str(tmp_path / "nowhere"), **changes))
    assert not (tmp_path / "decoder").exists()


@pytest.mark.parametrize("sizes", [{"image_size": 28, "patch_size": 14}])
def test_model_with_unsupported_image_or_patch_size_raises(
    make_decoder: MakeConfig, tmp_path: Path, sizes: dict
) -> None:
    WorldModel.random(ModelSizes.model_validate(TINY | sizes), seed=0).save_pretrained(tmp_path / "odd")
    with pytest.raises(InputError, match="px in patches of"):
        train_decoder(make_decoder(model__base=str(tmp_path / "odd")))


def test_diverging_learning_rate_raises_with_its_key(make_decoder: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    def infinite_loss(images: torch.Tensor, targets: torch.Tensor) -> tuple[torch.Tensor, dict]:
        return (images - targets).sum() * math.inf, {}

    monkeypatch.setattr(training, "decoder_loss", infinite_loss)
    with pytest.raises(InputError, match=r"decoder\.learning_rate: .*not finite"):
        train_decoder(make_decoder())


# ---- schedule ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "warmup"), [(150, 10), (10, 0), (20_000, 500)])
def test_learning_rate_warms_up_and_decays_to_zero(steps: int, warmup: int) -> None:
    config = DecoderConfig(steps=steps, learning_rate=0.5)
    rates = [learning_rate_at(step, config) for step in range(1, steps + 1)]
    assert rates[:warmup] == pytest.approx([0.5 * (step + 1) / warmup for step in range(warmup)])
    assert rates[warmup:] == sorted(rates[warmup:], reverse=True)
    assert rates[-1] == pytest.approx(0.0, abs=1e-12)
    assert max(rates) <= 0.5


def test_finished_decoder_is_kept_if_settings_without_effect_change(
    make_decoder: MakeConfig, whole_decoder: Path, tmp_path: Path, reporter: SilentReporter
) -> None:
    shutil.copytree(whole_decoder, tmp_path / "decoder")
    train_decoder(make_decoder(data__workers=1, training__steps=9), reporter)
    assert any("nothing to do" in note for note in reporter.notes)
