"""A metric that joins the list appears in every output; whether more of it is better is known there."""

import json
from pathlib import Path

import pytest

from vjepa2_ac.console.evaluation import comparison_table, evaluation_tables
from vjepa2_ac.console.progress import PlainConsole
from vjepa2_ac.evaluation import metrics as the_list
from vjepa2_ac.evaluation.evaluate import Contender, evaluate
from vjepa2_ac.evaluation.metrics import L1, METRICS, Metric
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import MODES, Evaluation
from vjepa2_ac.evaluation.verdict import verdict
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.html.page import report_page
from vjepa2_ac.reports.metrics_json import METRICS_FILE, metrics_as_dict, read_metrics, write_metrics
from worlds import Copier, Halfway, Oracle, about, again, clips_batch

LARGER = Metric("agreement", "agreement", "1 / (1 + L1)", lambda *pair: 1 / (1 + L1.of(*pair)), smaller_is_better=False)
SMALLER = Metric("height", "height", "1 / (1 + L1), taken for an error", LARGER.of)
PROBES = ProbeOptions(sensitivity_clips=0, landscape_clips=0, examples=0)


def evaluated(trained: object, base: object, *more: Metric) -> Evaluation:
    contenders = [Contender("base", "base", base), Contender("adapter", "trained", trained)]  # type: ignore[arg-type]
    return evaluate(contenders, again(clips_batch()), about(), metrics=(*METRICS, *more), probes=PROBES)


def shown(evaluation: Evaluation) -> str:
    console = PlainConsole(width=200)
    with console.capture() as capture:
        console.print(*evaluation_tables(evaluation))
    return capture.get()


def test_an_added_metric_appears_in_tables_report_json_verdict_and_comparison(tmp_path: Path) -> None:
    found = evaluated(Halfway(), Copier(), LARGER)
    assert "1.00 s, agreement (larger is better)" in shown(found)
    html = report_page(found, verdict(found))
    assert "Error over persistence, agreement (larger is better): 1 / (1 + L1)" in html
    assert "agreement (larger is better) over persistence by horizon, open-loop rollout" in html
    metrics = metrics_as_dict(found)
    for mode in MODES:
        of_one = metrics["models"]["adapter"][mode]["agreement"]
        assert of_one.keys() == metrics["models"]["adapter"][mode]["l1"].keys()
        assert all(gain["value"] > 0 for gain in of_one["gain_over_base"])
        assert metrics["persistence"][mode]["agreement"][0]["value"] > 0
    for name, one in (("with", found), ("without", evaluated(Halfway(), Copier()))):
        (tmp_path / name).mkdir()
        write_metrics(one, tmp_path / name / METRICS_FILE)
    both = compare([tmp_path / "with", tmp_path / "without"], found.metrics)
    column = both.columns.index("1.00 s, agreement (larger is better)")
    with_it, without = (row[column] for row in both.rows.values())
    assert isinstance(with_it, Estimate)
    assert with_it.value > 1
    assert without == ""
    assert comparison_table(both).row_count == 2
    assert [both.rows[name][both.columns.index("1.00 s, L2")].value for name in both.rows] == pytest.approx([0.25] * 2)  # type: ignore[union-attr]


def test_more_is_better_where_a_metric_says_so() -> None:
    better, worse = (evaluated(*pair, LARGER) for pair in ((Oracle(), Halfway()), (Copier(), Halfway())))
    assert "another matter" not in verdict(better), "it agrees with L1"
    assert "another matter" not in verdict(worse)
    mistaken = verdict(evaluated(Oracle(), Halfway(), SMALLER))
    assert "By height it is another matter: " in mistaken
    assert "WORSE than the base (gain" in mistaken
    assert "): NOT better." in mistaken
    both = verdict(evaluated(Oracle(), Halfway(), SMALLER, Metric("h", "twin", "", SMALLER.of)))
    assert "By height and twin it is another matter: " in both


def test_a_ratio_is_on_the_side_that_the_metric_says() -> None:
    low, high, unclear = Estimate(0.5, 0.4, 0.6), Estimate(1.5, 1.4, 1.6), Estimate(1.0, 0.9, 1.1)
    assert [L1.side(one) for one in (low, high, unclear)] == [1, -1, 0]
    assert [LARGER.side(one) for one in (low, high, unclear)] == [-1, 1, 0]


def test_the_list_is_what_is_measured_and_nothing_else() -> None:
    found = evaluated(Halfway(), Copier())
    names = [metric.name for metric in the_list.METRICS]
    assert names[0] == "l1", "curves and the verdict are of this one"
    assert len(set(names)) == len(names)
    metrics = metrics_as_dict(found)
    assert list(metrics["persistence"]["rollout"]) == list(metrics["models"]["adapter"]["rollout"]) == names
    everything = json.dumps(metrics) + report_page(found, verdict(found)) + shown(found)
    assert "cosine" not in everything.lower()


def test_files_of_versions_that_measured_cosine_are_compared(tmp_path: Path) -> None:
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        write_metrics(evaluated(Halfway(), Copier()), tmp_path / name / METRICS_FILE)
    old = read_metrics(tmp_path / "old") | {"format": 1}
    for part in (old["persistence"], *old["models"].values()):
        for mode in MODES:
            part[mode]["cosine"] = part[mode]["l2"]
    (tmp_path / "old" / METRICS_FILE).write_text(json.dumps(old))
    found = compare([tmp_path / "old", tmp_path / "new"])
    (ahead, _, *one), (same, _, *other) = found.rows.values()  # but for the gain over the first run
    assert (ahead, *one) == (same, *other)
    assert not [column for column in found.columns if "cosine" in column]
