"""Runs that were measured on the same clips are compared pair by pair; others are refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate import Contender, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.figures.evaluation import plot_comparison
from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics, write_metrics
from worlds import Copier, Halfway, Oracle, about, again, clips_batch

PROBES = ProbeOptions(sensitivity_clips=4, samples=10, landscape_clips=2, nodes=3, examples=0)


def written(folder: Path, model: object, *, clips: int = 12, seed: int = 0, **changes: object) -> Path:
    folder.mkdir()
    contenders = [Contender("base", "base", Copier()), Contender("adapter", "trained", model)]  # type: ignore[arg-type]
    found = evaluate(contenders, again(clips_batch(clips, seed)), about(**changes), probes=PROBES)
    write_metrics(found, folder / METRICS_FILE)
    return folder


def test_runs_are_compared_with_the_first_one_pair_by_pair(tmp_path: Path) -> None:
    found = compare([written(tmp_path / "half", Halfway()), written(tmp_path / "nothing", Copier())])
    assert list(found.rows) == ["half", "nothing"]
    half, nothing = (dict(zip(found.columns, row, strict=True)) for row in found.rows.values())
    assert half["1.00 s ahead"].value == pytest.approx(0.5, rel=1e-4)  # type: ignore[union-attr]
    assert half["gain over half"] == ""
    gain = nothing["gain over half"]
    assert isinstance(gain, Estimate)
    assert (gain.low, gain.value, gain.high) == pytest.approx((-1.0, -1.0, -1.0), rel=1e-4)
    assert found.notes == ()
    assert found.title.endswith(" episodes")
    assert plot_comparison(found, tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"clips": 8}, "clips: 12 and 8"),
        ({"split": "validation"}, "split: test and validation"),
        ({"stride": 8}, "stride: 4 and 8"),
    ],
)
def test_different_clips_are_not_compared(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    one, other = written(tmp_path / "one", Oracle()), written(tmp_path / "other", Oracle(), **changes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=f"measured on different clips.*{words}"):
        compare([one, other])


def test_a_run_beside_itself_is_refused(tmp_path: Path) -> None:
    run = written(tmp_path / "run", Oracle())
    with pytest.raises(InputError, match="named twice"):
        compare([run, tmp_path / "other" / ".." / "run"])


def test_other_starts_are_different_clips(tmp_path: Path) -> None:
    one, other = written(tmp_path / "one", Oracle()), written(tmp_path / "other", Oracle())
    text = (other / METRICS_FILE).read_text()
    metrics = json.loads(text)
    metrics["clips"]["fingerprint"] = "0"
    (other / METRICS_FILE).write_text(json.dumps(metrics))
    with pytest.raises(InputError, match="other episodes or starts"):
        compare([one, other])


def test_other_latents_are_pointed_out(tmp_path: Path) -> None:
    one, other = written(tmp_path / "one", Halfway()), written(tmp_path / "other", Halfway(), seed=5)
    assert "another encoder or crop" in compare([one, other]).notes[0]


def test_a_run_that_was_not_evaluated_is_named_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no metrics\.json.*vjepa2-ac evaluate"):
        compare([written(tmp_path / "one", Oracle()), tmp_path])
    with pytest.raises(InputError, match="no such folder"):
        compare([tmp_path / "one", tmp_path / "nowhere"])
    with pytest.raises(InputError, match="two or more"):
        compare([tmp_path / "one"])


def test_metrics_of_other_shapes_are_named(tmp_path: Path) -> None:
    one, other = written(tmp_path / "one", Oracle()), written(tmp_path / "other", Oracle())
    metrics = json.loads((other / METRICS_FILE).read_text())
    metrics["by_clip"]["persistence"] = 0.5
    (other / METRICS_FILE).write_text(json.dumps(metrics))
    with pytest.raises(InputError, match="metrics that cannot be used"):
        compare([one, other])


def test_damaged_metrics_are_named(tmp_path: Path) -> None:
    one, other = written(tmp_path / "one", Oracle()), written(tmp_path / "other", Oracle())
    metrics = json.loads((other / METRICS_FILE).read_text())
    del metrics["by_clip"]
    (other / METRICS_FILE).write_text(json.dumps(metrics))
    with pytest.raises(InputError, match="metrics that cannot be used"):
        compare([one, other])
    (other / METRICS_FILE).write_text('{"format": 99}')
    with pytest.raises(InputError, match="format 99"):
        compare([one, other])


def test_what_is_written_is_what_is_read_and_lists_of_numbers_stand_on_a_line(tmp_path: Path) -> None:
    folder = written(tmp_path / "one", Halfway())
    metrics = read_metrics(folder)
    rollout = metrics["models"]["adapter"]["rollout"]
    assert [one["value"] for one in rollout["l1"]["over_persistence"]] == pytest.approx([0.5] * 4, rel=1e-4)
    assert [one["value"] for one in rollout["l2"]["over_persistence"]] == pytest.approx([0.25] * 4, rel=1e-4)
    assert np.array(metrics["by_clip"]["models"]["adapter"]).shape == (12, 4)
    assert np.array(metrics["models"]["adapter"]["landscapes"]["maps"][0]["energy"]).shape == (3, 3, 3)
    assert "gain_over_base" not in metrics["models"]["base"]["rollout"]["l1"]
    text = (folder / METRICS_FILE).read_text()
    assert max(map(len, text.splitlines())) > 40
    assert len(text.splitlines()) < 4000
