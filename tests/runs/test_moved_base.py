"""The base model of a run is found at a new path; a checkpoint of step 0 is reported as the base model."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from adapted_run import write_adapted_run
from run_fixtures import TINY, TINY_CONFIG, MakeConfig
from same_run import assert_same_run
from vjepa2_ac.api import load_run
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject, load_models
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions, resolve_config
from vjepa2_ac.export import CARD, export_run
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.model_setup import load_for_planning
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.metrics_json import read_metrics
from vjepa2_ac.reports.write import write_evaluation
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.training import setup


@pytest.fixture
def run(make_config, base_folder: Path, tmp_path: Path) -> str:
    """Return a run whose base model was moved."""
    folder = write_adapted_run(make_config(base_folder=shutil.copytree(base_folder, tmp_path / "gone")))
    shutil.rmtree(tmp_path / "gone")
    return str(folder)


@pytest.fixture(scope="module")
def another(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a base model of the same sizes with other weights."""
    folder = tmp_path_factory.mktemp("another") / "base"
    WorldModel.random(ModelSizes.model_validate(TINY), seed=4).save_pretrained(folder)
    return str(folder)


@torch.no_grad()
def prediction(model: WorldModel) -> torch.Tensor:
    latents = torch.randn(1, 1, model.num_tokens, model.latent_dim, generator=torch.Generator().manual_seed(0))
    return model.predict(latents, torch.full((1, 1, 7), 0.1), torch.full((1, 1, 7), 0.2))


def exported(run: str, overrides: list[str]) -> WorldModel:
    target = Path(run).parent / "exported"
    return WorldModel.from_pretrained(export_run(Path(run), target, overrides=overrides).path)


def evaluated(run: str, overrides: list[str]) -> WorldModel:
    options = EvaluationOptions(overrides=tuple(overrides))
    config = resolve_config(run, options)
    return load_models(run, config, options, open_dataset(config.data)).world_model


@pytest.mark.parametrize(
    "load",
    [
        lambda run, overrides: load_run(run, overrides=overrides).world_model,
        lambda run, overrides: load_for_planning(run, overrides=overrides).world_model,
        exported,
        evaluated,
    ],
    ids=["load_run", "plan", "export", "evaluate"],
)
def test_run_accepts_its_moved_base_model_and_no_other(
    run: str, base_folder: Path, another: str, load: Callable[[str, list[str]], WorldModel]
) -> None:
    with pytest.raises(InputError, match=rf"gone: no such .* run `vjepa2-ac train {run} --resume model\.base=PATH`"):
        load(run, [])
    with pytest.raises(InputError, match="an adapter trained on another predictor"):
        load(run, [f"model.base={another}"])
    moved = prediction(load(run, [f"model.base={base_folder}"]))
    base = prediction(WorldModel.from_pretrained(base_folder))
    assert not torch.allclose(moved, base, atol=1e-4), "the adapter must change the predictions"


def test_other_overrides_raise_when_a_run_is_loaded(run: str, base_folder: Path) -> None:
    with pytest.raises(InputError, match=r"adapter\.rank=8: a key that cannot be changed when a run is loaded"):
        load_run(run, overrides=["adapter.rank=8"])
    with pytest.raises(InputError, match="not the folder of a run"):
        load_for_planning(str(base_folder), overrides=["model.base=elsewhere"])
    options = EvaluationOptions(overrides=(f"model.base={base_folder}", "planning.samples=30"))
    config = resolve_config(run, options)
    assert (config.model.base, config.planning.samples) == (str(base_folder), 30)
    with pytest.raises(InputError, match=r"override: model\.dtype"):
        resolve_config(run, EvaluationOptions(overrides=("model.dtype=bfloat16",)))


STATE = "0.4,0,0.3,3.1,0,0.1,0.2"


@pytest.mark.parametrize(
    "command",
    [
        "evaluate RUN --clips 4",
        "export RUN exported",
        "plan RUN --start a.png --goal a.png --state STATE",
        "train RUN --resume",
    ],
)
def test_missing_base_model_raises_with_the_command_for_a_new_path(
    run: str, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    arguments = command.replace("RUN", run).replace("STATE", STATE)
    assert main(arguments.split()) == 2
    assert f"run `vjepa2-ac {arguments} model.base=PATH`" in capsys.readouterr().err


def test_resume_with_a_moved_base_model_stores_the_new_path(
    whole_run: Path, base_folder: Path, another: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    run, moved = shutil.copytree(whole_run, tmp_path / "run"), shutil.copytree(base_folder, tmp_path / "moved")
    shutil.rmtree(run / "checkpoints/step-00000006")
    with monkeypatch.context() as patched:
        patched.setattr(setup, "use_latent_cache", lambda *_, **__: pytest.fail("encodes with another encoder"))
        assert main(["train", str(run), "--resume", f"model.base={another}"]) == 2
    assert "an adapter trained on another predictor" in capsys.readouterr().err
    assert read_run_config(run).model.base == str(base_folder)
    assert main(["train", str(run), "--resume", f"model.base={moved}"]) == 0
    assert read_run_config(run).model.base == str(moved)
    assert_same_run(whole_run, run)
    assert main(["train", str(run), "--resume", "run_dir=elsewhere"]) == 2


SELECTED = "The selected checkpoint is the base model: fine-tuning is not shown to improve action ranking."
SCRATCH = {"model__base": "random", "model__sizes": TINY_CONFIG, "adapter__kind": "none"}
FEW = EvaluationOptions(clips=3, probes=ProbeOptions(ranking_clips=0, examples=0))


def untrained_run(config: Config, *, newest: int = 6, rank: float | None = 0.1, widths: Widths | None = None) -> Path:
    """Write a run whose selected checkpoint is step 0; the later checkpoint has the same weights."""
    return write_adapted_run(config, tuple(dict.fromkeys((0, newest))), 0, change=0.0, rank=rank, widths=widths)


@pytest.fixture
def base_run(make_config: MakeConfig) -> Path:
    return untrained_run(make_config())


@pytest.mark.parametrize(
    ("changes", "run_options", "checkpoint", "note"),
    [
        ({}, {}, "selected", SELECTED),
        ({"adapter__kind": "none"}, {}, "selected", SELECTED),
        ({}, {"rank": None}, "selected", SELECTED.replace("action ranking", "the prediction error")),
        ({}, {}, "0", "Checkpoint 0 is the base model."),
        (
            {}, {"newest": 2}, "selected",
            "The selected checkpoint is the base model: no later checkpoint has been validated.",
        ),
        ({}, {}, "newest", ""),
        (SCRATCH, {}, "0", "Checkpoint 0 is the untrained model."),
        (
            SCRATCH, {}, "selected",
            "The selected checkpoint is the untrained model: training is not shown to improve action ranking.",
        ),
        (
            {"adapter__modules_to_save": ["action_encoder", "state_encoder"]}, {"widths": Widths(9, 9)}, "selected",
            SELECTED.replace("base model", "base model with untrained input projections"),
        ),
        (
            {"adapter__peft": {"init_lora_weights": False}}, {}, "selected",
            SELECTED.replace("base model", "base model with an untrained adapter"),
        ),
    ],
)  # fmt: skip
def test_checkpoint_of_step_0_is_described_as_untrained(
    make_config: MakeConfig, changes: dict[str, Any], run_options: dict[str, Any], checkpoint: str, note: str
) -> None:
    subject = load_subject(untrained_run(make_config(**changes), **run_options), checkpoint)
    assert subject.note == note
    assert subject.is_base == ("base model:" in note or "base model." in note)


def test_checkpoint_of_step_0_is_evaluated_once_as_base_model(base_run: Path, caplog: pytest.LogCaptureFixture) -> None:
    report = write_evaluation(evaluate_subject(str(base_run), FEW), base_run)
    assert caplog.messages == [SELECTED]
    assert [(model.name, model.role) for model in report.evaluation.models.values()] == [("base", "trained")]
    assert SELECTED in report.evaluation.notes
    assert report.summary.subject == f"{base_run}, step 0 (the base model)"
    assert SELECTED in report.report.read_text()
    metrics = read_metrics(base_run)
    assert (metrics.about.is_base, metrics.models, metrics.base) == (True, ("base",), None)
    export_run(base_run, base_run / "hub", "hub")
    assert f"**{SELECTED}**" in (base_run / "hub" / CARD).read_text()
    assert "| base |" in (base_run / "hub" / CARD).read_text()
    options = EvaluationOptions(clips=3, probes=FEW.probes, checkpoint="newest", out=base_run / "newest")
    later = write_evaluation(evaluate_subject(str(base_run), options), base_run / "newest").evaluation
    assert (list(later.models), later.about.is_base) == (["base", "adapter"], False)
    assert list(compare([base_run, base_run / "newest"]).measured) == ["run", "newest"]


def test_export_of_a_checkpoint_of_step_0_warns(
    base_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vjepa2_ac.export.merge_adapter", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export_run(base_run, tmp_path / "out")
    assert caplog.messages == [SELECTED]
    assert not (tmp_path / "out").exists()
