"""A diverging run warns once per cause, also after resuming; other runs do not."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from run_fixtures import TINY
from same_run import assert_same_run
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.runs.metrics_log import read_metrics_log, warnings_of
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.monitoring import Watch, WatchedMetricsLog

HUGE = {
    "adapter__rank": 16, "adapter__alpha": 64, "training__learning_rate": 0.05, "training__accumulation": 1,
    "validation__every": 2,
}  # fmt: skip


def validation(one_step: float, rollout: float | None = None) -> dict[str, float | None]:
    return {
        "error_over_persistence": one_step,
        "rollout_over_persistence_last": one_step if rollout is None else rollout,
    }


def warned(config: Config, *rows: tuple[int, dict[str, Any]]) -> dict[int, list[str]]:
    """Return the warnings of validations, by step."""
    watch = Watch(config)
    found = {step: watch("validation", step, metrics) for step, metrics in rows}
    return {step: texts for step, texts in found.items() if texts}


@pytest.fixture
def make_diverging(make_config: Callable[..., Config], tmp_path: Path) -> Callable[..., Config]:
    """Return configs of a run that leaves a base close to copying for something worse."""
    base = tmp_path / "copying"
    WorldModel.random(ModelSizes.model_validate(TINY), seed=3, at_persistence=True).save_pretrained(base)
    return lambda **changes: make_config(model__base=str(base), **{**HUGE, **changes})


@pytest.fixture
def config(make_config: Callable[..., Config]) -> Config:
    return make_config(training__steps=100)


def test_a_model_that_gets_better_or_stays_is_not_warned_of(config: Config) -> None:
    assert not warned(
        config, (0, validation(0.92)), (3, validation(0.92)), (6, validation(0.925)), (9, validation(0.8))
    )


def test_a_validation_that_is_worse_than_at_the_start_is_reported_once(config: Config) -> None:
    found = warned(config, (0, validation(0.8)), (3, validation(0.85)), (6, validation(0.86)), (9, validation(0.7)))
    assert list(found) == [3]
    (text,) = found[3]
    assert "at step 3 the one-step error is 0.850 (before training 0.800) and the rollout error" in text
    assert "copying" not in text


def test_one_that_is_worse_than_persistence_is_reported_too(config: Config) -> None:
    found = warned(config, (0, validation(0.8)), (3, validation(0.85)), (6, validation(1.34)), (9, validation(1.4)))
    assert list(found) == [3, 6]
    assert "copying the last frame would be better" in found[6][0]


def test_a_rollout_alone_counts(config: Config) -> None:
    (text,) = warned(config, (0, validation(0.8, 0.9)), (3, validation(0.7, 1.0)))[3]
    assert "the rollout error at the last horizon is 1.000 (before training 0.900)" in text
    assert "one-step" not in text


def test_a_start_that_was_no_better_than_persistence_is_not_compared_with_it(config: Config) -> None:
    assert not warned(config, (0, validation(1.3)), (3, validation(1.2)))
    assert "copying" not in warned(config, (0, validation(1.3)), (3, validation(1.5)))[3][0]


def test_the_last_validation_is_reported_again(config: Config) -> None:
    assert list(warned(config, (0, validation(0.8)), (50, validation(0.9)), (100, validation(0.9)))) == [50, 100]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
def test_an_error_that_is_not_finite_is_reported(config: Config, value: float | None) -> None:
    found = warned(config, (0, validation(0.8)), (3, {**validation(0.7), "error_over_persistence": value}))
    assert "not a finite number" in found[3][0]


def test_a_loss_that_rises_far_above_its_lowest_is_reported_between_validations(config: Config) -> None:
    watch = Watch(config)
    losses = [0.3, 0.5, 0.3, 0.4, 0.3] * 4 + [0.9] * 20
    found = {step: texts for step, loss in enumerate(losses) if (texts := watch("train", step, {"loss": loss}))}
    (step,) = found
    assert 20 < step < 30
    assert "the loss is 0.7, and was 0.3 (medians of 10 rows)" in found[step][0]


def ranking(rank: float, low: float, high: float) -> dict[str, float]:
    return {"action_rank": rank, "action_rank_low": low, "action_rank_high": high}


def test_a_model_that_predicts_better_and_plans_worse_is_warned_of_once(config: Config) -> None:
    start = validation(0.9) | ranking(0.03, 0.02, 0.04)
    unsure, sure = validation(0.7) | ranking(0.05, 0.039, 0.07), validation(0.6) | ranking(0.06, 0.05, 0.07)
    found = warned(config, (0, start), (3, unsure), (6, sure), (9, sure))
    assert list(found) == [6]
    assert "the model predicts better and plans worse than the base" in found[6][0]
    assert "rank of the true action among others is 0.060 (before training 0.030" in found[6][0]
    worse = validation(0.95) | ranking(0.06, 0.05, 0.07)
    assert any("the model plans worse than the base" in text for text in warned(config, (0, start), (3, worse))[3])


def test_a_single_loss_that_is_high_or_missing_is_not_reported(config: Config) -> None:
    watch = Watch(config)
    losses = [0.3, 0.5, None, float("nan"), 9.0] * 10
    assert not any(watch("train", step, {"loss": loss}) for step, loss in enumerate(losses))


@pytest.mark.parametrize(
    ("changes", "words", "absent"),
    [
        (
            {},
            ["learning_rate (0.001)", "adapter.alpha (8) or adapter.rank (4)", "best checkpoint is kept"],
            ["grad_norm"],
        ),
        ({"training__max_grad_norm": None}, ["set training.max_grad_norm=1"], []),
        ({"adapter__kind": "none"}, ["raise training.warmup_steps (1)"], ["adapter"]),
        ({"checkpoint__keep_best": False}, ["learning_rate"], ["best"]),
    ],
)
def test_it_says_what_to_turn(make_config, changes: dict, words: list[str], absent: list[str]) -> None:
    text = warned(make_config(**changes), (0, validation(0.8)), (3, validation(0.9)))[3][0]
    assert all(word in text for word in words), text
    assert not any(word in text for word in absent), text


def test_a_run_that_diverges_says_so_and_its_report_does_too(make_diverging, reporter) -> None:
    run = train(make_diverging(), reporter)
    reported = [note for note in reporter.notes if note.startswith("Warning: at step")]
    rows = [row for row in read_metrics_log(run / "metrics.jsonl") if row["kind"] == "warning"]
    assert rows, "it did not diverge: this test tests nothing"
    assert [f"Warning: {row['text']}" for row in rows] == reported
    assert main(["evaluate", str(run), "--clips", "2", "--sensitivity-clips", "0", "--examples", "0"]) == 0
    notes = json.loads((run / "metrics.json").read_text())["notes"]
    assert f"In training, {rows[0]['text']}." in notes
    assert "before training" in (run / "report.html").read_text()


def test_a_resumed_run_reports_the_same_as_an_uninterrupted_one(make_diverging, reporter, tmp_path: Path) -> None:
    whole = train(make_diverging(run_dir=str(tmp_path / "whole")), reporter)
    config = make_diverging(run_dir=str(tmp_path / "halves"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vjepa2_ac.training.loop.save_checkpoint", _stop_behind(3))
        with pytest.raises(KeyboardInterrupt):
            train(config, reporter)
    train(config, reporter)
    assert warnings_of(whole / "metrics.jsonl")
    assert_same_run(whole, tmp_path / "halves")


def _stop_behind(step: int) -> Callable[..., None]:
    from vjepa2_ac.training.resume import save_checkpoint

    def save(run: Any, folder: Path) -> None:
        save_checkpoint(run, folder)
        if run.state.step > step:
            raise KeyboardInterrupt

    return save


def test_rows_that_a_stranger_wrote_do_no_harm(config: Config, reporter, tmp_path: Path) -> None:
    rows: list[dict[str, object]] = [
        {"step": 0}, {"kind": "validation", "step": 0, "error_over_persistence": "bad"},
        {"kind": "warning", "step": 1, "text": 3}, {"kind": ["train"], "step": 1, "loss": {}},
    ]  # fmt: skip
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    with WatchedMetricsLog(tmp_path, config=config, reporter=reporter, first_step=1) as metrics_log:
        metrics_log.write("validation", 2, validation(1.2))
    assert not reporter.notes
    assert not warnings_of(tmp_path / "metrics.jsonl")
