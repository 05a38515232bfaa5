"""Runs and models are evaluated on any data, compared with other models, and decoded; invalid input raises."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from adapted_run import write_adapted_run
from latent_sets import encode_for
from run_fixtures import TINY_CONFIG, MakeConfig, one_thread, tiny_config
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.decoding.decoder import Decoder, DecoderCard, DecoderShape, save_decoder
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject, load_models
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions, resolve_config
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.reports.metrics_json import read_metrics
from vjepa2_ac.reports.write import WrittenEvaluation, write_evaluation
from vjepa2_ac.runs.checkpoint import select_checkpoint
from vjepa2_ac.training.loop import train

PROBES = ProbeOptions(ranking_clips=3, samples=6, landscape_clips=1, nodes=3, examples=1)
NO_PROBES = ProbeOptions(ranking_clips=0, examples=0)
FEW = ["--ranking-clips", "0", "--examples", "1", "--clips", "5"]
QUICK = ["--ranking-clips=3", "--samples=6", "--landscapes=1", "--nodes=3", "--examples=1"]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory, data_folder: Path, base_folder: Path) -> Config:
    """Return the config of a tiny run that is trained for two steps."""
    folder = tmp_path_factory.mktemp("evaluation")
    config = tiny_config(
        folder / "run", data_folder, base_folder,
        data__test_share=0.4, data__cache_dir=str(folder / "caches"), data__cache_dtype="fp32",
        training__steps=2, training__accumulation=1, training__learning_rate=1e-2, training__warmup_steps=0,
        validation__every=2, validation__batch_size=3, checkpoint__keep_best="off",
    )  # fmt: skip
    train(config, SILENT)
    return config


@pytest.fixture
def run(config: Config) -> str:
    return config.run_dir


def make_options(**changes: Any) -> EvaluationOptions:
    return EvaluationOptions(**({"clips": 5, "probes": PROBES} | changes))


def measure(subject: str, options: EvaluationOptions) -> WrittenEvaluation:
    """Evaluate and write the files, like the command."""
    return write_evaluation(evaluate_subject(subject, options), options.out or Path(subject))


@pytest.fixture(scope="module")
def measured(config: Config) -> WrittenEvaluation:
    """Evaluate the run; the files are in the folder of the run, and tests must not change them."""
    with one_thread():
        return measure(config.run_dir, make_options())


def write_config(config: Config, folder: Path, **data: object) -> str:
    """Write a config with changed keys of `data`, and return the path."""
    values = config_as_dict(config)
    values["data"] |= data
    path = folder / "data_config.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


def rollout_ratios(metrics: dict[str, Any], name: str) -> list[float]:
    ratios = [row for row in metrics["rows"] if row["key"].startswith("rollout.l1.over_persistence.")]
    return [row["value"] for row in ratios if row["model"] == name]


def read_json(folder: Path | str) -> dict[str, Any]:
    return json.loads((Path(folder) / "metrics.json").read_text())


def test_run_is_compared_with_its_base_model_in_all_measurements(measured: WrittenEvaluation) -> None:
    evaluation = measured.evaluation
    assert list(evaluation.models) == ["base", "adapter"]
    assert (evaluation.base, evaluation.trained) == ("base", "adapter")
    assert {path.suffix for path in measured.files} == {".png", ".json", ".csv", ".html"}
    assert evaluation.about.checkpoint == str(select_checkpoint(Path(evaluation.about.subject)))
    assert (evaluation.about.stride, evaluation.about.frames) == (2, 4)
    assert evaluation.about.seconds_per_step == pytest.approx(2 / 15)
    assert evaluation.examples[0].frames is not None
    assert evaluation.examples[0].frames.shape == (4, 32, 32, 3)


@pytest.mark.usefixtures("measured")
def test_metrics_do_not_depend_on_the_batch_size(config: Config, run: str, tmp_path: Path) -> None:
    changed = config.model_copy(update={"validation": config.validation.model_copy(update={"batch_size": 2})})
    path = Path(run) / "config.yaml"
    before = path.read_text()
    try:
        path.write_text(yaml.safe_dump(config_as_dict(changed)))
        measure(run, make_options(out=tmp_path / "b"))
    finally:
        path.write_text(before)
    three_at_once, two_at_once = read_json(run), read_json(tmp_path / "b")
    for name in ("base", "adapter"):
        assert rollout_ratios(three_at_once, name) == pytest.approx(rollout_ratios(two_at_once, name), rel=1e-5)
        ranks = [metrics["models"][name]["ranking"]["ranks"] for metrics in (three_at_once, two_at_once)]
        assert ranks[0] == ranks[1]
    assert three_at_once["clips"] == two_at_once["clips"]


@pytest.mark.usefixtures("measured")
def test_a_model_is_measured_on_the_data_of_a_config_and_equals_the_base_of_a_run(
    config: Config, run: str, tmp_path: Path, base_folder: Path
) -> None:
    path = write_config(config, tmp_path)
    arguments = ["evaluate", str(base_folder), "--data", path, "--out", str(tmp_path / "model"), "--clips", "5", *QUICK]
    assert main(arguments) == 0
    model_metrics = read_json(tmp_path / "model")
    assert list(model_metrics["models"]) == ["model"]
    assert model_metrics["base"] is None
    assert model_metrics["about"]["checkpoint"] == ""
    assert rollout_ratios(model_metrics, "model") == pytest.approx(rollout_ratios(read_json(run), "base"), rel=1e-5)


def test_other_runs_are_measured_on_the_same_latents(run: str, tmp_path: Path, base_folder: Path) -> None:
    result = measure(run, make_options(against=("base", run, str(base_folder)), out=tmp_path))
    assert list(result.evaluation.models) == ["base", "run", "model", "adapter"]
    assert [model.role for model in result.evaluation.models.values()] == ["base", "other", "other", "trained"]
    metrics = read_json(tmp_path)
    assert rollout_ratios(metrics, "run") == pytest.approx(rollout_ratios(metrics, "adapter"), rel=1e-6)
    assert rollout_ratios(metrics, "model") == pytest.approx(rollout_ratios(metrics, "base"), rel=1e-6)
    assert rollout_ratios(metrics, "base") != rollout_ratios(metrics, "adapter")
    options = make_options(against=(str(base_folder),), out=tmp_path, probes=NO_PROBES)
    assert evaluate_subject(run, options).base is None


def test_comparing_with_a_model_that_has_another_encoder_raises(run: str, tmp_path: Path, base_folder: Path) -> None:
    model = WorldModel.from_pretrained(base_folder)
    WorldModel.random(model.sizes, seed=9).save_pretrained(tmp_path / "other")
    with pytest.raises(InputError, match=r"an encoder that differs from that of.*vjepa2-ac compare"):
        evaluate_subject(run, make_options(against=(str(tmp_path / "other"),)))


@pytest.mark.usefixtures("measured")
def test_cached_latents_give_the_metrics_of_frames(config: Config, run: str, tmp_path: Path) -> None:
    encode_for(config, load_base(config.model, seed=0), open_dataset(config.data))
    path = write_config(config, tmp_path, cache="require")
    assert main(["evaluate", run, "--data", path, "--out", str(tmp_path / "cached"), "--clips", "5", *QUICK]) == 0
    from_frames, cached = read_json(run), read_json(tmp_path / "cached")
    assert (from_frames["models"], from_frames["rows"]) == (cached["models"], cached["rows"])
    assert from_frames["clips"] == cached["clips"]


def test_run_without_base_model_is_measured_alone_or_raises_if_base_is_requested(
    make_config: MakeConfig,
) -> None:
    config = make_config(model__base="random", model__sizes=TINY_CONFIG, adapter__kind="none")
    folder, dataset = write_adapted_run(config), open_dataset(config.data)
    assert [model.role for model in load_models(str(folder), config, make_options(), dataset).evaluated_models] == [
        "trained"
    ]
    with pytest.raises(InputError, match=r"--against base: a model without a base"):
        load_models(str(folder), config, make_options(against=("base",)), dataset)


def changed(config: Config, **data: object) -> Config:
    """Return a config with changed keys of `data`."""
    return config.model_copy(update={"data": config.data.model_copy(update=data)})


INVALID_INPUT: dict[str, tuple[Callable[[Config], EvaluationOptions], str]] = {
    "other data without a folder": (lambda config: make_options(data=config), "--data without --out"),
    "an automatic stride": (
        lambda config: make_options(data=changed(config, stride="auto"), out=Path("unused")),
        "data.stride: auto",
    ),
    "an empty split": (
        lambda config: make_options(data=changed(config, test_share=0.0), out=Path(config.run_dir) / "out"),
        "no test episodes",
    ),
    "clips longer than episodes": (
        lambda config: make_options(data=changed(config, frames=30), out=Path(config.run_dir) / "out"),
        "shorter than a clip",
    ),
    "no such checkpoint": (lambda _: make_options(checkpoint="7"), "no checkpoint of step 7"),
}


@pytest.mark.parametrize(("make", "words"), INVALID_INPUT.values(), ids=INVALID_INPUT)
def test_invalid_input_is_reported_before_a_model_is_loaded(
    config: Config, run: str, make: Callable[[Config], EvaluationOptions], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vjepa2_ac.evaluation.evaluate_run.load_subject", lambda *_, **__: pytest.fail("loaded"))
    with pytest.raises(InputError, match=words):
        evaluate_subject(run, make(config))


def test_model_without_data_missing_checkpoint_and_file_as_output_folder_raise(
    run: str, tmp_path: Path, base_folder: Path
) -> None:
    with pytest.raises(InputError, match=r"a model, or a folder without config\.yaml.*--data CONFIG"):
        evaluate_subject(str(base_folder), make_options())
    with pytest.raises(InputError, match="no such folder"):
        evaluate_subject(str(tmp_path / "nowhere"), make_options())
    (tmp_path / "config.yaml").touch()
    with pytest.raises(InputError, match=r"a config file\. Expected the folder of a run"):
        evaluate_subject(str(tmp_path / "config.yaml"), make_options())
    with pytest.raises(InputError, match=r"no checkpoint of step 17\. Expected"):
        resolve_config(run, make_options(checkpoint="17"))
    (tmp_path / "file").touch()
    with pytest.raises((InputError, OSError), match="file"):
        evaluate_subject(run, make_options(out=tmp_path / "file"))


def test_model_without_data_is_called_a_model() -> None:
    with pytest.raises(InputError, match=r"builtin:sim-tiny: a model.* add --data CONFIG"):
        evaluate_subject("builtin:sim-tiny", EvaluationOptions())


# ---- with a decoder ----


def card_of(config: Config) -> DecoderCard:
    model = load_base(config.model, seed=0)
    shape = DecoderShape("linear", model.latent_dim, round(model.num_tokens**0.5), model.sizes.patch_size)
    encoder = model.encoder_fingerprint()
    return DecoderCard("vjepa2-ac decoder 1", shape, encoder, "released", "fp32", "data", ("camera",), 3, 30, 100)


def write_decoder(card: DecoderCard, folder: Path) -> str:
    weights = Decoder(card.shape).state_dict()
    save_decoder(folder, card, weights)
    return str(folder)


@pytest.fixture(scope="module")
def decoder(config: Config, tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_decoder(card_of(config), tmp_path_factory.mktemp("decoder") / "decoder")


def test_a_decoder_adds_rows_and_images_and_changes_nothing_else(
    run: str, decoder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["evaluate", run, *FEW, "--out", str(tmp_path)]
    assert main(arguments) == 0
    without = read_metrics(tmp_path)
    assert "Decoded images" not in capsys.readouterr().out
    assert "Decoded images: not measured." in (tmp_path / "report.html").read_text()
    assert main([*arguments, "--decoder", decoder]) == 0
    metrics = read_metrics(tmp_path)
    added = [row for row in metrics.rows if row.key.startswith(("decoded.", "fvd.decoded"))]
    assert tuple(row for row in metrics.rows if row not in added) == without.rows
    assert {row.model for row in added} >= {"decoded truth", "raw persistence", "base", "adapter"}
    assert (metrics.of("decoded.psnr_db.whole.truth.3") or added[0]).value > 0  # type: ignore[operator]
    assert "decoded truth" not in capsys.readouterr().out, "these rows need --all"
    page = (tmp_path / "report.html").read_text()
    assert "Decoded images compared with the truth: PSNR (dB), whole image" in page


def test_decoded_images_from_a_latent_cache_are_compared_with_decoded_truth(
    config: Config, decoder: str, tmp_path: Path
) -> None:
    encode_for(config, load_base(config.model, seed=0), open_dataset(config.data))
    data = changed(config, cache="auto")
    measure(config.run_dir, EvaluationOptions(clips=5, data=data, out=tmp_path, decoder=decoder, probes=NO_PROBES))
    metrics = read_metrics(tmp_path)
    assert metrics.of("decoded.ssim.whole.truth.3") is None
    for key in ("decoded.ssim.whole.decoded_truth.3", "fvd.decoded"):
        assert (metrics.of(key) or metrics.rows[0]).key == key
