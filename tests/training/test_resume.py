"""The best checkpoint is kept only if its validation is comparable: same clips, time span and latents."""

from dataclasses import replace

import pytest

from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.runs.checkpoint import RunState, newest_checkpoint, read_state
from vjepa2_ac.training import validation
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.resume import keep_comparable_best, validation_settings

BEST = RunState(20, best_step=10, best_error=0.5)


def settings_of(config: object) -> dict[str, str]:
    return dict(validation_settings(config, open_dataset(config.data)))  # type: ignore[attr-defined, arg-type]


def test_best_checkpoint_is_discarded_if_the_validation_has_changed(make_config, reporter, monkeypatch) -> None:
    errors = iter([0.9, 0.2, 0.3, 0.8, 0.6])  # the first error is the base model's
    monkeypatch.setattr(validation, "validation_metrics", lambda _: {validation.SELECTION_ERROR: next(errors)})
    options = {"validation__every": 1, "checkpoint__every": 1, "training__steps": 2, "checkpoint__keep_best": "error"}
    folder = train(make_config(**options), reporter) / "checkpoints"
    assert read_state(newest_checkpoint(folder)).best_error == 0.2
    train(make_config(**{**options, "training__steps": 4}, data__frames=5), reporter, allow_config_change=True)
    (reported,) = [note for note in reporter.notes if "is discarded" in note]
    assert reported.startswith(
        "The validation has changed (data.frames, validation clips): the best error so far, 0.2 "
    )
    state = read_state(newest_checkpoint(folder))
    assert (state.best_step, state.best_error) == (4, 0.6), "0.2 was measured at another horizon"


def test_best_checkpoint_is_kept_after_an_unchanged_resume(make_config, reporter) -> None:
    settings = settings_of(make_config(checkpoint__keep_best="error"))
    recorded = replace(BEST, validation_settings=settings)
    moved = make_config(
        checkpoint__keep_best="error",
        training__steps=9,
        training__learning_rate=1e-4,
        data__workers=1,
        validation__every=1,
        validation__batch_size=4,
    )
    assert keep_comparable_best(recorded, settings_of(moved), reporter) == recorded
    assert keep_comparable_best(BEST, settings, reporter) == recorded, "a state without recorded settings is accepted"
    assert reporter.notes == []


def test_ranking_error_selects_the_best_and_rollout_error_breaks_ties() -> None:
    state = RunState(0).with_validation(0.9, 0.3)
    assert (state.best_step, state.best_ranking_error) == (0, 0.3), "the base model is a candidate"
    state = replace(state, step=10)
    assert state.with_validation(0.1, 0.31) == state, "a lower rollout error with a higher ranking error"
    assert state.with_validation(0.9, 0.3) == state
    assert state.with_validation(float("nan"), 0.1) == state
    assert state.with_validation(0.1, float("nan")) == state
    assert state.with_validation(0.8, 0.3).best_step == 10
    assert state.with_validation(0.8, 0.304).best_step == 10, "ranking error within the tolerance, lower rollout error"
    near = state.with_validation(1.0, 0.297)
    assert (near.best_step, near.lowest_ranking_error) == (0, 0.297), (
        "ranking error within the tolerance, higher rollout error"
    )
    assert replace(near, step=20).with_validation(0.8, 0.303).best_step == 0, (
        "outside the tolerance of the lowest ranking error"
    )
    assert replace(near, step=20).with_validation(2.0, 0.294).best_step == 20, (
        "the former best is outside the tolerance"
    )
    assert state.with_validation(1.5, 0.2).best_error == 1.5


@pytest.mark.parametrize(
    ("change", "changed_settings"),
    [
        ({"data__frames": 5}, {"data.frames", "its clips"}),
        ({"data__crop": "square"}, {"data.crop"}),
        ({"data__fields": {"gripper_open": -1.0}}, {"data.fields.gripper_open"}),
        ({"validation__clips": 2}, {"its clips"}),
        ({"checkpoint__keep_best": "off"}, {"checkpoint.keep_best"}),
        ({"data__split_by": r"episode_(\d+)"}, {"its clips"}),
    ],
)
def test_changed_validation_settings_are_listed(
    make_config, reporter, change: dict[str, object], changed_settings: set[str]
) -> None:
    before, settings = settings_of(make_config()), settings_of(make_config(**change))
    assert {key for key in before | settings if before.get(key) != settings.get(key)} == changed_settings
    state = keep_comparable_best(replace(BEST, validation_settings=before), settings, reporter)
    assert (state.best_step, state.best_error, state.validation_settings) == (None, None, settings)
    assert all(name.replace("its", "validation") in reporter.notes[0] for name in changed_settings)
