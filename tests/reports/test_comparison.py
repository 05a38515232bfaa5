"""Runs on the same clips are compared in pairs of clips; runs on different clips raise."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate import EvaluatedModel, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.summary import Conclusion
from vjepa2_ac.reports.comparison import Comparison, compare
from vjepa2_ac.reports.evaluation_figures import plot_comparison
from vjepa2_ac.reports.metrics_json import METRICS_FILE, write_csv, write_metrics
from worlds import Copier, Halfway, Oracle, about, clips_batch, repeatable_clips

PROBES = ProbeOptions(ranking_clips=4, samples=10, landscape_clips=2, nodes=3, examples=0)


def write_evaluation(
    folder: Path,
    model: object,
    *,
    clips: int = 12,
    seed: int = 0,
    base: object = Copier(),
    probes: ProbeOptions = PROBES,
    ranking_seed: int = 0,
    **changes: object,
) -> Path:
    folder.mkdir()
    evaluated_models = [EvaluatedModel("base", "base", base), EvaluatedModel("adapter", "trained", model)]  # type: ignore[arg-type]
    comparison = evaluate(
        evaluated_models, repeatable_clips(clips_batch(clips, seed)), about(seed=ranking_seed, **changes), probes=probes
    )
    write_metrics(comparison, folder / METRICS_FILE)
    return folder


def test_runs_with_different_base_models_are_compared_with_persistence(tmp_path: Path) -> None:
    folders = [
        write_evaluation(tmp_path / name, Oracle(), base=base) for name, base in (("a", Copier()), ("b", Halfway()))
    ]
    comparison = compare(folders)
    assert any("different base models" in note for note in comparison.notes)
    assert "base model" not in str(comparison).splitlines()[2]
    same = compare([folders[0], write_evaluation(tmp_path / "c", Halfway())])
    assert not same.notes
    assert "base model" in str(same).splitlines()[2]


def test_different_action_ranking_settings_give_no_recommendation(tmp_path: Path) -> None:
    more_samples = replace(PROBES, samples=12)
    comparison = compare(
        [write_evaluation(tmp_path / "a", Halfway()), write_evaluation(tmp_path / "b", Halfway(), probes=more_samples)]
    )
    assert any("measured with different settings" in note for note in comparison.notes)
    assert comparison.next_command == "No run is recommended: the actions were ranked with different settings."
    other_seed = compare([tmp_path / "a", write_evaluation(tmp_path / "c", Halfway(), ranking_seed=1)])
    assert not other_seed.notes


def test_gain_over_the_first_run_is_paired_by_clip(tmp_path: Path) -> None:
    comparison = compare(
        [write_evaluation(tmp_path / "half", Halfway()), write_evaluation(tmp_path / "nothing", Copier())]
    )
    rows = {(row.key, row.model): row for row in comparison.rows}
    assert rows["rollout.l1.over_persistence.4", "half"].value == pytest.approx(0.5, rel=1e-4)
    assert ("gain_over_first", "half") not in rows
    gain = rows["gain_over_first", "nothing"]
    assert (gain.low, gain.value, gain.high) == pytest.approx((-1.0, -1.0, -1.0), rel=1e-4)
    assert (gain.better, gain.chance) == ("higher", 0.0)
    assert {row.model for row in comparison.rows} == {"half", "nothing"}
    assert [estimate.value for estimate in comparison.curves["half"]] == pytest.approx([0.5] * 4, rel=1e-4)
    assert comparison.notes == ()
    assert comparison.title.endswith(" episodes")
    shown = str(comparison).splitlines()
    assert shown[0].startswith("2 runs on the same 12 clips, ")
    assert shown[-1].startswith("The error of nothing is 100 % higher than that of half (95 % CI 100 to 100 %, n = ")
    assert plot_comparison(comparison, tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def with_runs(
    comparison: Comparison, conclusion: Conclusion = "yes", **runs: tuple[float | None, float, int]
) -> Comparison:
    """Return a comparison of runs with these action-ranking errors, last errors over persistence, and steps."""
    run, curve = next(iter(comparison.measured.items()))[1], next(iter(comparison.curves.values()))
    measured, curves = {}, {}
    for name, (rank, error, step) in runs.items():
        ranks = replace(run.summary.ranking, value=rank, conclusion=conclusion)
        about = replace(
            run.about,
            checkpoint=f"step-{step:08d} (as requested)",
            checkpoint_path=f"run/step-{step:08d}",
            is_base=not step,
        )
        measured[name] = replace(run, summary=replace(run.summary, ranking=ranks), about=about)
        curves[name] = (*curve[:-1], replace(curve[-1], value=error))
    rows = [row for row in comparison.rows if row.key == "gain_over_first"]
    gains = tuple(replace(rows[0], model=name) for name in list(runs)[1:])
    return replace(
        comparison, measured=measured, curves=curves, rows=gains, folders={name: Path("my runs", name) for name in runs}
    )


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    folder = tmp_path_factory.mktemp("two")
    return compare([write_evaluation(folder / "half", Halfway()), write_evaluation(folder / "nothing", Copier())])


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((0.40, 0.7, 100), (0.30, 0.9, 200), "export 'my runs/b' b-merged --checkpoint 200"),  # ranking decides
        ((0.30, 0.9, 100), (0.304, 0.7, 200), "export 'my runs/b' b-merged --checkpoint 200"),  # within the tolerance
        ((0.30, 0.9, 100), (0.306, 0.7, 200), "export 'my runs/a' a-merged --checkpoint 100"),
        ((0.40, 0.7, 100), (0.30, 0.9, 0), "No run is recommended: b, with the lowest action-ranking error, was not"),
        ((0.40, 0.7, 100), (None, 0.9, 200), "No run is recommended: the action-ranking error of b was not measured."),
    ],
)
def test_recommendation_uses_the_rule_of_checkpoint_selection(two: Comparison, first, second, expected: str) -> None:
    assert expected in with_runs(two, a=first, b=second).next_command


@pytest.mark.parametrize(
    ("conclusion", "reason"), [("no", "is not better than"), ("inconclusive", "is not known to be better than")]
)
def test_run_without_better_action_ranking_is_not_recommended(two: Comparison, conclusion, reason: str) -> None:
    comparison = with_runs(two, conclusion, a=(0.4, 0.7, 100), b=(0.3, 0.9, 200))
    assert comparison.next_command.startswith(f"No run is recommended: the action ranking of b {reason} ")


def test_too_few_episodes_give_no_recommendation_and_no_difference(two: Comparison) -> None:
    comparison = with_runs(two, a=(0.4, 0.7, 100), b=(0.3, 0.9, 200))
    reason = "1 held-out episode is too few for a conclusion; at least 5 are needed"
    summaries = {name: run.summary for name, run in comparison.measured.items()}
    summaries = {
        name: replace(run, prediction=replace(run.prediction, needs=f"{reason}. So far: error 1 % lower."))
        for name, run in summaries.items()
    }
    measured = {name: replace(run, summary=summaries[name]) for name, run in comparison.measured.items()}
    rows = tuple(replace(row, low=math.nan, high=math.nan) for row in comparison.rows)
    comparison = replace(comparison, measured=measured, rows=rows)
    assert comparison.next_command == f"No run is recommended: {reason}."
    assert f"Whether the errors differ is not measured: {reason}." in " ".join(str(comparison).split())


@pytest.mark.parametrize(
    ("gain", "sentence"),
    [
        ((0.04, 0.01, 0.07), "The error of b is 4.0 % lower than that of a (95 % CI 1.0 to 7.0 %, n = "),
        ((-0.24, -0.26, -0.22), "The error of b is 24 % higher than that of a (95 % CI 22 to 26 %, n = "),
        ((0.04, -0.01, 0.07), "The errors of b and a do not differ significantly."),
    ],
)
def test_comparison_sentence_has_gain_interval_and_reference(two: Comparison, gain: tuple, sentence: str) -> None:
    comparison = with_runs(two, a=(0.4, 0.7, 100), b=(0.3, 0.9, 200))
    value, low, high = gain
    rows = tuple(replace(row, value=value, low=low, high=high) for row in comparison.rows)
    assert str(replace(comparison, rows=rows)).splitlines()[-1].startswith(sentence)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"clips": 8}, "clips: 12 and 8"),
        ({"split": "validation"}, "split: test and validation"),
        ({"stride": 8}, "stride: 4 and 8"),
    ],
)
def test_comparing_different_clips_raises(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    run, other_run = (
        write_evaluation(tmp_path / "one", Oracle()),
        write_evaluation(tmp_path / "other", Oracle(), **changes),
    )  # type: ignore[arg-type]
    with pytest.raises(InputError, match=f"measured on different clips.*{words}"):
        compare([run, other_run])


def test_different_latents_give_a_note(tmp_path: Path) -> None:
    run, other_run = (
        write_evaluation(tmp_path / "one", Halfway()),
        write_evaluation(tmp_path / "other", Halfway(), seed=5),
    )
    assert "another encoder or crop" in compare([run, other_run]).notes[0]


def test_unevaluated_run_raises_with_the_command_that_evaluates_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no metrics\.json.*vjepa2-ac evaluate"):
        compare([write_evaluation(tmp_path / "one", Oracle()), tmp_path])
    with pytest.raises(InputError, match="no such folder"):
        compare([tmp_path / "one", tmp_path / "nowhere"])
    with pytest.raises(InputError, match="two or more"):
        compare([tmp_path / "one"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"by_clip": {"persistence": 0.5, "models": {}}}, "by_clip.persistence"),
        ({"rows": [{"key": 1}]}, "metrics that cannot be read"),
        ({"format": 99}, "format: Input should be 6"),
    ],
)
def test_damaged_metrics_file_raises_with_its_path(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    run, other_run = write_evaluation(tmp_path / "one", Oracle()), write_evaluation(tmp_path / "other", Oracle())
    metrics = json.loads((other_run / METRICS_FILE).read_text())
    (other_run / METRICS_FILE).write_text(json.dumps(metrics | changes))
    with pytest.raises(InputError, match=words):
        compare([run, other_run])


def test_comparison_table_has_every_row(tmp_path: Path) -> None:
    comparison = compare(
        [write_evaluation(tmp_path / "half_1", Halfway()), write_evaluation(tmp_path / "100%", Copier())]
    )
    with write_csv(comparison.rows, tmp_path / "comparison.csv").open(newline="") as file:
        rows = [(row["key"], row["model"], float(row["value"])) for row in csv.DictReader(file)]
    assert rows == [(row.key, row.model, pytest.approx(row.value, nan_ok=True)) for row in comparison.rows]
