"""Console, page, metrics.json and comparison show the same rows, which include those of third-party metrics."""

from pathlib import Path

import pytest

from evaluation_results import evaluation, page_of
from vjepa2_ac.cli.progress import PlainConsole
from vjepa2_ac.cli.tables import row_tables
from vjepa2_ac.evaluation.evaluate import EvaluatedModel, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import L1, L2, Evaluation, Metric, gain_over, over_persistence, rank_difference
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.evaluation.summary import summarize
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics, write_metrics
from worlds import Copier, Halfway, Oracle, about, clips_batch, repeatable_clips

EVALUATION = evaluation(others=("runs/other",))


def test_key_and_model_identify_a_row() -> None:
    rows = make_rows(EVALUATION)
    assert len({(row.key, row.model) for row in rows}) == len(rows)
    names = {row.key: (row.group, row.name, row.form, row.better) for row in rows}
    assert all((row.group, row.name, row.form, row.better) == names[row.key] for row in rows)
    assert len(set(names.values())) == len(names), "lines have different labels"


def test_rows_equal_the_estimates() -> None:
    rows = {(row.key, row.model): row.estimate for row in make_rows(EVALUATION)}
    base, adapter = (EVALUATION.models[name] for name in ("base", "adapter"))
    assert rows["rollout.l1.over_persistence.3", "adapter"] == over_persistence(adapter.errors, "rollout")[2]
    assert rows["rollout.l1.gain_over_base.3", "adapter"] == gain_over(adapter.errors, base.errors)[2]
    assert ("rollout.l1.gain_over_base.3", "base") not in rows
    assert adapter.ranking is not None
    assert base.ranking is not None
    assert rows["ranking.rank", "adapter"] == adapter.ranking.rank
    assert rows["ranking.change", "adapter"] == adapter.ranking.change
    assert rows["ranking.difference_to_base", "adapter"] == rank_difference(adapter.ranking, base.ranking)
    assert adapter.landscapes is not None
    assert base.landscapes is not None
    for measure in ("distance", "rank", "sharpness"):
        assert rows[f"landscapes.{measure}", "base"] == base.landscapes.mean(measure)
        difference = adapter.landscapes.difference(base.landscapes, measure)
        assert rows[f"landscapes.{measure}.difference_to_base", "adapter"] == difference
    assert {"spread.3", "latent_mmd.3", "fvd.predicted", "one_step.moving"} <= {key for key, _ in rows}


def test_console_page_and_file_show_the_same_rows(tmp_path: Path) -> None:
    rows = make_rows(EVALUATION)
    console = PlainConsole(width=250)
    with console.capture() as capture:
        console.print(*row_tables(rows, "Held-out episodes"))
    shown, page = capture.get(), page_of(EVALUATION)
    for row in rows:
        assert str(row) in page, row
        assert row.detail or str(row) in shown, row
    write_metrics(EVALUATION, tmp_path / METRICS_FILE)
    stored_metrics = read_metrics(tmp_path)
    assert [(row.key, row.model) for row in stored_metrics.rows] == [(row.key, row.model) for row in rows]
    stored_row = stored_metrics.of("rollout.l1.over_persistence.3")
    assert stored_row is not None
    row = next(row for row in rows if (row.key, row.model) == (stored_row.key, stored_row.model))
    assert Estimate(stored_row.value or 0, stored_row.low or 0, stored_row.high or 0) == row.estimate


# ---- a third-party metric ----

LARGER = Metric("agreement", "agreement", "1 / (1 + L1)", lambda *pair: 1 / (1 + L1.of(*pair)), smaller_is_better=False)
SMALLER = Metric("height", "height", "1 / (1 + L1), with the wrong direction", LARGER.of)
PROBES = ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0)


def evaluated(trained: object, base: object, *metrics: Metric) -> Evaluation:
    evaluated_models = [EvaluatedModel("base", "base", base), EvaluatedModel("adapter", "trained", trained)]  # type: ignore[arg-type]
    return evaluate(
        evaluated_models, repeatable_clips(clips_batch()), about(), metrics=(L1, L2, *metrics), probes=PROBES
    )


def test_a_third_party_metric_appears_in_rows_and_comparison(tmp_path: Path) -> None:
    evaluation_with_metric = evaluated(Halfway(), Copier(), LARGER)
    rows = {(row.key, row.model): row for row in make_rows(evaluation_with_metric)}
    ratio, gain = (
        rows[f"rollout.agreement.{statistic}.1", "adapter"] for statistic in ("over_persistence", "gain_over_base")
    )
    assert ratio.better == gain.better == "higher"
    assert gain.value > 0
    for name, result in (("with", evaluation_with_metric), ("without", evaluated(Halfway(), Copier()))):
        (tmp_path / name).mkdir()
        write_metrics(result, tmp_path / name / METRICS_FILE)
    compared_rows = {(row.key, row.model): row for row in compare([tmp_path / "with", tmp_path / "without"]).rows}
    assert compared_rows["rollout.agreement.over_persistence.4", "with"].value > 1
    assert ("rollout.agreement.over_persistence.4", "without") not in compared_rows
    for run in ("with", "without"):
        assert compared_rows["rollout.l2.over_persistence.4", run].value == pytest.approx(0.25)


def test_metric_direction_decides_what_is_better() -> None:
    better, worse = (evaluated(*pair, LARGER) for pair in ((Oracle(), Halfway()), (Copier(), Halfway())))
    assert not summarize(better, make_rows(better)).prediction.reference, "the metric agrees with L1"
    assert not summarize(worse, make_rows(worse)).prediction.reference
    wrong_direction = evaluated(Oracle(), Halfway(), SMALLER)
    assert "(by height " in summarize(wrong_direction, make_rows(wrong_direction)).prediction.reference
