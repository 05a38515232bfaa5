"""A metric that joins the list appears in every output; whether more of it is better is known there."""

from pathlib import Path

import pytest

from vjepa2_ac.evaluation.evaluate import Contender, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import L1, L2, Evaluation, Metric
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.evaluation.summary import summarize
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.metrics_json import METRICS_FILE, write_metrics
from worlds import Copier, Halfway, Oracle, about, again, clips_batch

LARGER = Metric("agreement", "agreement", "1 / (1 + L1)", lambda *pair: 1 / (1 + L1.of(*pair)), smaller_is_better=False)
SMALLER = Metric("height", "height", "1 / (1 + L1), taken for an error", LARGER.of)
PROBES = ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0)


def evaluated(trained: object, base: object, *more: Metric) -> Evaluation:
    contenders = [Contender("base", "base", base), Contender("adapter", "trained", trained)]  # type: ignore[arg-type]
    return evaluate(contenders, again(clips_batch()), about(), metrics=(L1, L2, *more), probes=PROBES)


def test_an_added_metric_appears_in_rows_verdict_and_comparison(tmp_path: Path) -> None:
    found = evaluated(Halfway(), Copier(), LARGER)
    rows = {(row.key, row.model): row for row in rows_of(found)}
    ratio, gain = (rows[f"rollout.agreement.{what}.1", "adapter"] for what in ("over_persistence", "gain_over_base"))
    assert ratio.better == gain.better == "higher"
    assert gain.value > 0
    for name, one in (("with", found), ("without", evaluated(Halfway(), Copier()))):
        (tmp_path / name).mkdir()
        write_metrics(one, tmp_path / name / METRICS_FILE)
    both = {(row.key, row.model): row for row in compare([tmp_path / "with", tmp_path / "without"]).rows}
    assert both["rollout.agreement.over_persistence.4", "with"].value > 1
    assert ("rollout.agreement.over_persistence.4", "without") not in both
    for run in ("with", "without"):
        assert both["rollout.l2.over_persistence.4", run].value == pytest.approx(0.25)


def test_more_is_better_where_a_metric_says_so() -> None:
    better, worse = (evaluated(*pair, LARGER) for pair in ((Oracle(), Halfway()), (Copier(), Halfway())))
    assert not summarize(better, rows_of(better)).predicts.reference, "it agrees with L1"
    assert not summarize(worse, rows_of(worse)).predicts.reference
    mistaken = evaluated(Oracle(), Halfway(), SMALLER)
    assert "(by height " in summarize(mistaken, rows_of(mistaken)).predicts.reference
