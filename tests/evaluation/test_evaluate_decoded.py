"""A run is evaluated with a decoder: a decoder that does not fit is refused."""

from dataclasses import replace
from pathlib import Path

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
from vjepa2_ac.reports.metrics_json import read_metrics
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


def test_a_decoder_adds_rows_and_images_and_changes_nothing_else(
    config: Config, decoder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", config.run_dir, *QUICK]) == 0
    without = read_metrics(Path(config.run_dir))
    assert "Decoded images" not in capsys.readouterr().out
    assert "Decoded images: not measured." in (Path(config.run_dir) / "report.html").read_text()
    assert main(["evaluate", config.run_dir, *QUICK, "--decoder", decoder]) == 0
    metrics = read_metrics(Path(config.run_dir))
    added = [row for row in metrics.rows if row.key.startswith("decoded.")]
    assert tuple(row for row in metrics.rows if row not in added) == without.rows
    assert {row.model for row in added} >= {"decoded truth", "raw persistence", "base", "adapter"}
    assert (metrics.of("decoded.psnr_db.whole.truth.3") or added[0]).value > 0  # type: ignore[operator]
    assert "decoded truth" in capsys.readouterr().out
    page = (Path(config.run_dir) / "report.html").read_text()
    assert "Decoded images against the truth: PSNR (dB), whole image" in page


def test_from_a_cache_the_images_are_those_of_the_frames(config: Config, decoder: str, tmp_path: Path) -> None:
    values = config_as_dict(config)
    values["data"]["cache"] = "auto"
    data = parse_config(values, where="test")
    encode_for(config, load_base(config.model, seed=0), open_dataset(config.data))
    found = []
    for name, config_of_data in (("cached", data), ("frames", config)):
        given = EvaluationOptions(clips=5, data=config_of_data, out=tmp_path / name, decoder=decoder, probes=PROBES)
        evaluate_subject(config.run_dir, given)
        found.append(read_metrics(tmp_path / name))
    assert found[0].of("decoded.ssim.whole.truth.3") is None
    one, other = (each.of("decoded.ssim.whole.decoded_truth.3") for each in found)
    assert one is not None
    assert other is not None
    assert one.value == pytest.approx(other.value, abs=1e-4)


@pytest.mark.parametrize("given", [["--lpips", "a.pth"], ["--decoder", "D", "--lpips-heads", "a.pth"]])
def test_lpips_needs_both_files_and_a_decoder(given: list[str], config: Config, capsys) -> None:
    assert main(["evaluate", config.run_dir, *given]) == 2
    assert "one without the others" in capsys.readouterr().err


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
