"""A checkpoint of step 0 is called the base model, or an untrained one, before anything is computed with it."""

from pathlib import Path
from typing import Any

import pytest

from run_fixtures import TINY_CONFIG, MakeConfig
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.episode import Widths
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.export import CARD, export_run
from vjepa2_ac.model.adapter_folder import save_trained
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import fit_heads
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.metrics_json import read_metrics
from vjepa2_ac.reports.write import write_evaluation
from vjepa2_ac.runs.checkpoint import ADAPTER, RunState, write_checkpoint
from vjepa2_ac.runs.folder import CONFIG
from vjepa2_ac.runs.subject import load_subject

SELECTED = "The selected checkpoint is the base model: fine-tuning did not improve action ranking."
SCRATCH = {"model__base": "random", "model__sizes": TINY_CONFIG, "adapter__kind": "none"}
FEW = EvaluationOptions(clips=3, probes=ProbeOptions(ranking_clips=0, examples=0))


def untrained_run(config: Config, *, newest: int = 6, rank: float | None = 0.1, widths: Widths | None = None) -> Path:
    """Write a run of which step 0 is selected; its later checkpoint has the same weights."""
    folder = Path(config.run_dir)
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(config_as_yaml(config))
    model = load_base(config.model, seed=config.seed)
    if widths is not None:
        fit_heads(model, widths, seed=1)
    add_adapter(model, config.adapter, seed=0)
    for step in dict.fromkeys((0, newest)):
        state = RunState(step, best_step=0, best_error=0.5, best_rank=rank)
        write_checkpoint(folder / "checkpoints", state, lambda path: save_trained(model, path / ADAPTER), keep=9)
    return folder


@pytest.fixture
def base_run(make_config: MakeConfig) -> Path:
    return untrained_run(make_config())


@pytest.mark.parametrize(
    ("changes", "how", "checkpoint", "note"),
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
            "The selected checkpoint is the untrained model: training did not improve action ranking.",
        ),
        (
            {"adapter__modules_to_save": ["action_encoder", "state_encoder"]}, {"widths": Widths(9, 9)}, "selected",
            SELECTED.replace("base model", "base model with untrained input heads"),
        ),
        (
            {"adapter__peft": {"init_lora_weights": False}}, {}, "selected",
            SELECTED.replace("base model", "base model with an untrained adapter"),
        ),
    ],
)  # fmt: skip
def test_a_checkpoint_before_the_first_step_is_called_what_it_is(
    make_config: MakeConfig, changes: dict[str, Any], how: dict[str, Any], checkpoint: str, note: str
) -> None:
    found = load_subject(untrained_run(make_config(**changes), **how), checkpoint)
    assert found.note == note
    assert found.is_base == ("base model:" in note or "base model." in note)


def test_the_base_is_measured_once_and_its_metrics_say_so(base_run: Path, caplog: pytest.LogCaptureFixture) -> None:
    measured = write_evaluation(evaluate_subject(str(base_run), FEW), base_run)
    assert caplog.messages == [SELECTED]
    assert [(one.name, one.role) for one in measured.evaluation.models.values()] == [("base", "trained")]
    assert SELECTED in measured.evaluation.notes
    assert measured.summary.subject == f"{base_run}, step 0 (the base model)"
    assert SELECTED in measured.report.read_text()
    metrics = read_metrics(base_run)
    assert (metrics.about.is_base, metrics.models, metrics.base) == (True, ("base",), None)
    export_run(base_run, base_run / "hub", "hub")
    assert f"**{SELECTED}**" in (base_run / "hub" / CARD).read_text()
    assert "| base |" in (base_run / "hub" / CARD).read_text()
    asked = EvaluationOptions(clips=3, probes=FEW.probes, checkpoint="newest", out=base_run / "newest")
    later = write_evaluation(evaluate_subject(str(base_run), asked), base_run / "newest").evaluation
    assert (list(later.models), later.about.is_base) == (["base", "adapter"], False)
    assert list(compare([base_run, base_run / "newest"]).measured) == ["run", "newest"]


def test_an_export_says_so_before_it_writes(
    base_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vjepa2_ac.export.merge_adapter", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export_run(base_run, tmp_path / "out")
    assert caplog.messages == [SELECTED]
    assert not (tmp_path / "out").exists()
