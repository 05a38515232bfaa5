"""Every number is a row, and console, page, metrics.json and comparison show the same rows."""

from pathlib import Path

from evaluation_results import evaluation, page_of
from vjepa2_ac.cli.progress import PlainConsole
from vjepa2_ac.cli.tables import row_tables
from vjepa2_ac.evaluation.result import gain_over, over_persistence, rank_difference
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics, write_metrics

WHOLE = evaluation(others=("runs/other",))


def test_a_key_and_a_model_name_one_row_and_a_key_one_line() -> None:
    rows = rows_of(WHOLE)
    assert len({(row.key, row.model) for row in rows}) == len(rows)
    names = {row.key: (row.group, row.name, row.form, row.better) for row in rows}
    assert all((row.group, row.name, row.form, row.better) == names[row.key] for row in rows)
    assert len(set(names.values())) == len(names), "a line says what it is"


def test_rows_are_the_estimates() -> None:
    rows = {(row.key, row.model): row.estimate for row in rows_of(WHOLE)}
    base, adapter = (WHOLE.models[name] for name in ("base", "adapter"))
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
    rows = rows_of(WHOLE)
    console = PlainConsole(width=250)
    with console.capture() as capture:
        console.print(*row_tables(rows, "Held-out episodes"))
    shown, page = capture.get(), page_of(WHOLE)
    for row in rows:
        assert str(row) in page, row
        assert row.detail or str(row) in shown, row
    write_metrics(WHOLE, tmp_path / METRICS_FILE)
    written = read_metrics(tmp_path)
    assert [(row.key, row.model) for row in written.rows] == [(row.key, row.model) for row in rows]
    found = written.of("rollout.l1.over_persistence.3")
    assert found is not None
    row = next(row for row in rows if (row.key, row.model) == (found.key, found.model))
    assert Estimate(found.value or 0, found.low or 0, found.high or 0) == row.estimate
