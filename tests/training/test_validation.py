"""Validation: action ranking, selection of the best checkpoint, and early stopping."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from run_fixtures import set_up
from same_run import assert_same_run
from vjepa2_ac.data import loader
from vjepa2_ac.data.windows import spread_indices
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.action_use import Transition
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.runs.checkpoint import RunState, SelectedCheckpoint, checkpoint_name, newest_checkpoint, read_state
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.subject import describe_selection, note_on_warmup
from vjepa2_ac.training import loop, validation
from vjepa2_ac.training.loop import train

EVERY_STEP = {"validation__every": 1, "checkpoint__every": 100, "training__steps": 6}


def validations(folder: Path) -> list[dict[str, Any]]:
    return [row for row in read_metrics_log(folder / "metrics.jsonl") if row["kind"] == "validation"]


@pytest.fixture
def set_validation_errors(monkeypatch):
    """Return a function that sets the (rollout error, ranking error) of validations, the base model's first.

    The interval of each ranking error ends at `error + half_width`; NaN: there is no interval.
    """

    def use(*errors: tuple[float, float], half_width: float = math.nan) -> None:
        values = iter(errors)

        def metrics(_: object) -> dict[str, float]:
            error, rank = next(values)
            key = validation.RANKING_ERROR
            interval = {key: rank, f"{key}_low": rank - half_width, f"{key}_high": rank + half_width}
            return {validation.SELECTION_ERROR: error, **interval}

        monkeypatch.setattr(validation, "validation_metrics", metrics)

    return use


def test_each_validation_logs_the_ranking_with_intervals(make_config, reporter) -> None:
    rows = validations(train(make_config(**EVERY_STEP, validation__ranking_samples=8), reporter))
    assert [row["step"] for row in rows] == list(range(7))
    for row in rows:
        assert 0.0 <= row["action_ranking_error"] <= 1.0
        assert row["action_ranking_error"] == pytest.approx(
            (row["action_ranking_error_box"] + row["action_ranking_error_shell"]) / 2
        )
        assert row["energy_spread"] > 0.0
    assert len({row["action_ranking_error"] for row in rows}) > 1


def test_unreadable_clips_are_replaced_in_the_ranking(make_config, reporter, monkeypatch) -> None:
    clips = {"validation__clips": 8, "validation__ranking_clips": 3, "data__broken_episodes": "skip"}
    run = set_up(make_config(**clips), reporter)
    names = [
        (run.dataset.table.identity(episode), start)
        for episode, start in loader.validation_windows(run.dataset, "validation", clips=8)
    ]
    chosen = [names[index] for index in spread_indices(8, 3)]
    unused = [name for name in names if name not in chosen]
    ranked, broken, read = [], {*chosen[1:], unused[0]}, loader.read_clip

    def read_or_raise(dataset: object, request: loader.ClipRequest) -> object:
        if (run.dataset.table.identity(request.episode), request.start) in broken:
            raise InputError(where="a clip", found="its image is damaged")
        return read(dataset, request)

    def record_ranked_clips(_model: object, moves: list[Transition], *_: object, **__: object) -> None:
        ranked.extend((move.episode_id, move.first_step) for move in moves)

    monkeypatch.setattr(loader, "read_clip", read_or_raise)
    monkeypatch.setattr(validation, "rank_actions", record_ranked_clips)
    validation.validate(run, reporter)
    assert ranked == [name for name in (chosen[0], unused[1], unused[2]) for _ in range(2)], "two motions per clip"
    broken.update(names)
    with pytest.raises(InputError, match="4 of 8 episodes are broken"):
        validation.validate(run, reporter)


def test_lowest_ranking_error_is_selected_while_the_rollout_error_decreases(
    make_config, reporter, set_validation_errors
) -> None:
    set_validation_errors((0.9, 0.10), (0.8, 0.05), (0.7, 0.06), (0.6, 0.07), (0.5, 0.08), (0.4, 0.2), (0.3, 0.3))
    folder = train(make_config(**EVERY_STEP, checkpoint__keep=1), reporter)
    assert {path.name for path in (folder / "checkpoints").iterdir()} == {checkpoint_name(1), checkpoint_name(6)}
    assert describe_selection(folder) == (
        "Selected checkpoint: step 1, the best by action ranking.\n"
        "Action-ranking error in validation: 5.0 % (base model 10.0 %, chance 50 %)."
    )


@pytest.mark.parametrize(
    ("errors", "half_width", "selected"),
    [
        ([(0.9, 0.51), (0.5, 0.44), (0.4, 0.41)], 0.1, 0),
        ([(0.9, 0.51), (0.5, 0.44), (0.4, 0.45)], 0.055, 1),
        ([(0.9, 0.51), (0.5, 0.44), (0.4, 0.41)], math.nan, 2),
        ([(0.9, 0.51), (0.5, 0.52), (0.4, 0.53)], math.nan, 0),
        ([(0.9, 0.55), (0.5, 0.53), (0.4, 0.40)], 0.05, 2),
    ],
)
def test_fine_tuned_checkpoint_is_selected_only_if_it_is_shown_to_rank_actions_better_than_chance(
    make_config, reporter, set_validation_errors, errors, half_width, selected
) -> None:
    set_validation_errors(*errors, half_width=half_width)
    folder = train(make_config(**{**EVERY_STEP, "training__steps": 2}), reporter)
    assert read_state(newest_checkpoint(folder / "checkpoints")).best_step == selected
    note = "The selected checkpoint is the base model: fine-tuning is not shown to improve action ranking."
    assert (note in describe_selection(folder)) == (selected == 0)


def test_predictor_with_random_weights_is_selected_even_if_it_ranks_actions_at_chance(
    make_config, reporter, set_validation_errors
) -> None:
    set_validation_errors((0.9, 0.51), (0.5, 0.49), half_width=0.1)
    sizes = {"encoder": {"width": 24, "depth": 1, "heads": 2}, "predictor": {"width": 24, "depth": 1, "heads": 2}}
    model = {"model__base": "random", "model__sizes": {"image_size": 32, **sizes}, "adapter__kind": "none"}
    folder = train(make_config(**{**EVERY_STEP, "training__steps": 1}, **model), reporter)
    assert read_state(newest_checkpoint(folder / "checkpoints")).best_step == 1


def test_resume_after_saving_the_base_is_exact(make_config, reporter, tmp_path, monkeypatch) -> None:
    full_run = train(make_config(run_dir=str(tmp_path / "whole")), reporter)
    interrupted_config = make_config(run_dir=str(tmp_path / "halted"))
    monkeypatch.setattr(loop, "_optimize", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train(interrupted_config, reporter)
    monkeypatch.undo()
    assert read_state(newest_checkpoint(tmp_path / "halted/checkpoints")).step == 0
    assert_same_run(full_run, train(interrupted_config, reporter))


def test_run_without_improvement_ends_after_patience(make_config, reporter, set_validation_errors) -> None:
    set_validation_errors((0.9, 0.10), (0.8, 0.05), *[(0.85, 0.06)] * 5)
    config = make_config(**EVERY_STEP, training__patience=2, checkpoint__keep_best="ranking")
    folder = train(config, reporter)
    assert [row["step"] for row in validations(folder)] == [0, 1, 2, 3]
    assert read_state(newest_checkpoint(folder / "checkpoints")).step == 3
    assert any(note.startswith("Training stops at step 3: no improvement since step 1") for note in reporter.notes)
    train(config, reporter)
    assert read_state(newest_checkpoint(folder / "checkpoints")).step == 3, "a run that has ended must not continue"


def test_ignored_actions_are_reported_after_warm_up_and_at_the_end(make_config, reporter) -> None:
    sizes = {
        "image_size": 32,
        "encoder": {"width": 24, "depth": 1, "heads": 2},
        "predictor": {"width": 24, "depth": 1, "heads": 2},
    }
    copying_model = {"model__base": "random", "model__sizes": sizes, "adapter__kind": "none"}
    train(make_config(**EVERY_STEP, **copying_model, training__learning_rate=1e-12, training__warmup_steps=2), reporter)
    assert sum("ignores its actions" in note for note in reporter.notes) == 2


@pytest.mark.parametrize(
    ("high", "words"),
    [
        (0.3, "uses its actions little (action-ranking error 21 % [17, 30], chance 50 %)"),
        (0.6, "ignores its actions"),
        (math.nan, "ignores its actions"),
    ],
)
def test_weak_effect_of_actions_is_described_by_the_action_ranking(
    high: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validation, "cost_of_actions", lambda *_: Estimate(0.012, 0.0, 0.02))
    ranking = SimpleNamespace(rank=Estimate(0.21, math.nan if math.isnan(high) else 0.17, high))
    assert words in validation.action_warning(SimpleNamespace(errors=None, ranking=ranking))


@pytest.mark.parametrize(("step", "is_noted"), [(0, False), (223, True), (250, False)])
def test_checkpoint_within_the_warm_up_has_a_note(make_config, step: int, *, is_noted: bool) -> None:
    config = make_config(training__steps=2_000, training__warmup_steps=250)
    selected = SelectedCheckpoint(Path(checkpoint_name(step)), "", "newest", RunState(step=step))
    note = note_on_warmup(config, selected)
    assert note.startswith("The checkpoint of step 223 is within the warm-up (250 steps)") == is_noted == bool(note)
