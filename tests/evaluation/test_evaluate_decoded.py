"""A run is evaluated with a decoder: in metrics.json, report and console; a decoder that does not fit is refused."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from latent_sets import encode_for
from run_fixtures import one_thread
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, parse_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.decoding.decoder_folder import DecoderCard, save_decoder
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.reports.write import evaluate_subject
from vjepa2_ac.training.loop import train

QUICK = ["--sensitivity-clips", "0", "--examples", "1", "--clips", "5"]
PROBES = ProbeOptions(sensitivity_clips=0, examples=0)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory, data_folder: Path, base_folder: Path) -> Config:
    """Return the config of a tiny run that is trained for one step."""
    folder = tmp_path_factory.mktemp("decoded")
    values = {
        "run_dir": str(folder / "run"),
        "data": {
            "path": str(data_folder), "frames": 4, "stride": 2, "validation_share": 0.3, "test_share": 0.4,
            "workers": 0, "cache_dir": str(folder / "caches"), "cache_dtype": "fp32",
        },
        "model": {"base": str(base_folder), "dtype": "float32"},
        "adapter": {"rank": 4, "alpha": 8},
        "training": {
            "steps": 1, "batch_size": 2, "accumulation": 1, "warmup_steps": 0, "precision": "fp32", "device": "cpu",
            "allow_weak_base": True,
        },
        "validation": {"every": 1, "clips": 4, "batch_size": 3},
        "tracking": {"tensorboard": False},
    }  # fmt: skip
    config = parse_config(values, where="test")
    with one_thread():
        train(config, SILENT)
    return config


def card_of(config: Config) -> DecoderCard:
    model = load_base(config.model, seed=0)
    shape = DecoderShape("linear", model.latent_dim, round(model.num_tokens**0.5), model.sizes.patch_size)
    encoder = model.encoder_fingerprint()
    return DecoderCard("vjepa2-ac decoder 1", shape, encoder, "released", "fp32", "data", ("camera",), 3, 30, 100)


def saved(card: DecoderCard, folder: Path) -> str:
    weights = Decoder(card.shape).state_dict()
    save_decoder(folder, card, weights, weights)
    return str(folder)


@pytest.fixture(scope="module")
def decoder(config: Config, tmp_path_factory: pytest.TempPathFactory) -> str:
    return saved(card_of(config), tmp_path_factory.mktemp("decoder") / "decoder")


def decoded_of(folder: Path | str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((Path(folder) / "metrics.json").read_text())["decoded"]
    return found


def test_a_decoder_adds_one_key_a_section_and_two_lines(
    config: Config, decoder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", config.run_dir, *QUICK]) == 0
    without = json.loads((Path(config.run_dir) / "metrics.json").read_text())
    plain = capsys.readouterr().out
    assert without["decoded"] is None
    assert "Decoded images: not measured." in (Path(config.run_dir) / "report.html").read_text()
    assert main(["evaluate", config.run_dir, *QUICK, "--decoder", decoder]) == 0
    printed = capsys.readouterr().out
    metrics = json.loads((Path(config.run_dir) / "metrics.json").read_text())
    assert {key: one for key, one in metrics.items() if key not in {"decoded", "about"}} == {
        key: one for key, one in without.items() if key not in {"decoded", "about"}
    }
    assert "Decoded, 0.4 s ahead, PSNR against the truth (dB): decoded truth " in printed
    assert "Decoded," not in plain
    found = metrics["decoded"]
    assert list(found["models"]) == ["base", "adapter"]
    assert found["decoder"]["folder"] == decoder
    assert found["models"]["adapter"]["against_truth"]["whole"]["psnr_db"][2]["value"] > 0
    assert found["models"]["adapter"]["cycle_error"][0]["value"] > 0
    assert "were not simulated" in found["hand"]["reason"]
    assert found["video_mmd"]["reason"].startswith("5 clips")
    page = (Path(config.run_dir) / "report.html").read_text()
    assert "decoded truth" in page
    assert "<script" not in page
    assert len(page) < 5_000_000
    assert not list(tmp_path.iterdir())


def test_from_a_cache_nothing_is_said_about_the_truth(config: Config, decoder: str, tmp_path: Path) -> None:
    values = config_as_dict(config)
    values["data"]["cache"] = "auto"
    data = parse_config(values, where="test")
    encode_for(config, load_base(config.model, seed=0), open_dataset(config.data))
    for name, config_of_data in (("cached", data), ("frames", config)):
        out, given = tmp_path / name, {"decoder": decoder, "probes": PROBES}
        evaluate_subject(config.run_dir, EvaluationOptions(clips=5, data=config_of_data, out=out, **given))  # type: ignore[arg-type]
    cached, frames = decoded_of(tmp_path / "cached"), decoded_of(tmp_path / "frames")
    one, other = cached["models"]["adapter"], frames["models"]["adapter"]
    assert one["against_truth"]["whole"]["ssim"][0]["value"] is None
    assert "cache" in one["against_truth"]["whole"]["ssim"][0]["reason"]
    assert "encoder was set aside" in one["cycle_error"][0]["reason"]
    values = [which["against_decoded_truth"]["whole"]["ssim"][2]["value"] for which in (one, other)]
    assert values[0] == pytest.approx(values[1], abs=1e-4)


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"encoder": "another"}, "another encoder"), ({"crop": "square"}, "data.crop square")],
)
def test_a_decoder_that_does_not_fit_is_refused(
    changed: dict[str, str], words: str, config: Config, tmp_path: Path
) -> None:
    folder = saved(replace(card_of(config), **changed), tmp_path / "decoder")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=words):
        evaluate_subject(config.run_dir, EvaluationOptions(clips=5, decoder=folder, probes=PROBES))
