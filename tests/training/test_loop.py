"""Properties of the training loop: exact resume, gradient accumulation, checks, and allowed config changes."""

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from run_fixtures import KilledError, dying_reporter, set_up
from same_run import assert_same_run, metrics, trained_weights
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.data import loader
from vjepa2_ac.data.clips import ClipRequest
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.episode import Clip
from vjepa2_ac.errors import InputError
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.runs.checkpoint import checkpoint_name, newest_checkpoint, read_state
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.training import outputs, validation
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.step import iterate_batches, training_step
from vjepa2_ac.training.validation import base_warning

NOT_SHOWN = "Warning: the base model is not shown to rank actions better than chance"


def test_resumed_run_equals_an_uninterrupted_run(make_config, reporter, tmp_path, whole_run) -> None:
    config = make_config(run_dir=str(tmp_path / "broken"))
    with pytest.raises(KilledError):
        train(config, dying_reporter(type(reporter)(), 3))
    train(config, reporter)
    assert_same_run(whole_run, tmp_path / "broken")


MODES = {
    "dora": {"adapter__dora": True, "adapter__dropout": 0.2},
    "whole predictor": {"adapter__kind": "none"},
    "8 bit": {"training__optimizer": "adamw_8bit"},
}


@pytest.mark.parametrize("mode", MODES)
def test_resumed_run_equals_an_uninterrupted_run_for_each_training_mode(
    make_config, reporter, tmp_path, mode: str
) -> None:
    if mode == "8 bit":
        pytest.importorskip("bitsandbytes")
    changes = {"training__steps": 4, **MODES[mode]}
    train(make_config(run_dir=str(tmp_path / "whole"), **changes), reporter)
    config = make_config(run_dir=str(tmp_path / "broken"), **changes)
    with pytest.raises(KilledError):
        train(config, dying_reporter(type(reporter)(), 3))
    reporter.steps.clear()
    train(config, reporter)
    assert reporter.steps == [3, 4]
    assert_same_run(tmp_path / "whole", tmp_path / "broken")


def test_number_of_loader_workers_does_not_change_a_run(make_config, reporter, tmp_path) -> None:
    train(make_config(run_dir=str(tmp_path / "none"), training__steps=2), reporter)
    train(make_config(run_dir=str(tmp_path / "two"), training__steps=2, data__workers=2), reporter)
    assert_same_run(tmp_path / "none", tmp_path / "two")


def test_best_checkpoint_by_validation_is_saved_and_kept(make_config, reporter, tmp_path, monkeypatch) -> None:
    def next_metrics(errors: object) -> dict:
        del errors
        return {"rollout_over_persistence_last": next(values)}

    monkeypatch.setattr(validation, "validation_metrics", next_metrics)
    config = make_config(validation__every=1, checkpoint__every=100, checkpoint__keep=1, checkpoint__keep_best="error")
    values = iter([0.95, 0.9, 0.7, 0.8, 0.75])  # the first error is the base model's
    with pytest.raises(KilledError):
        train(config, dying_reporter(type(reporter)(), 5))
    values = iter([0.71, 0.8, 0.9, 0.72])
    train(config, reporter)
    folder = tmp_path / "run/checkpoints"
    assert [path.name for path in sorted(folder.iterdir())] == [checkpoint_name(2), checkpoint_name(6)]
    state = read_state(newest_checkpoint(folder))
    assert (state.best_step, state.best_error) == (2, 0.7)


def test_accumulated_micro_batches_equal_one_large_batch(make_config, reporter) -> None:
    def gradients(batch_size: int, accumulation: int) -> dict[str, torch.Tensor]:
        config = make_config(
            training__batch_size=batch_size, training__accumulation=accumulation, adapter__dropout=0.0,
            training__max_grad_norm=None,
        )  # fmt: skip
        run = set_up(config, reporter)
        run.optimizer.step = lambda: None
        run.optimizer.zero_grad = lambda **_: None
        training_step(run, iterate_batches(run), 1)
        return {name: p.grad for name, p in run.world_model.named_parameters() if p.grad is not None}

    big, small = gradients(4, 1), gradients(1, 4)
    assert big
    for name, gradient in big.items():
        torch.testing.assert_close(small[name], gradient, rtol=1e-4, atol=1e-7)


def test_training_lowers_the_loss(make_config, reporter) -> None:
    config = make_config(
        training__steps=24, training__accumulation=1, training__learning_rate=5e-3, adapter__rank=16,
        adapter__targets=["q", "k", "v", "o", "fc1", "fc2", "predictor_embed", "predictor_proj"],
        validation__every=24, checkpoint__every=24,
    )  # fmt: skip
    train(config, reporter)
    validations = [row for row in metrics(Path(config.run_dir)) if row["kind"] == "validation"]
    assert [row["step"] for row in validations] == [0, 24]
    assert validations[-1]["error_over_persistence"] < 0.8 * validations[0]["error_over_persistence"]


def test_base_model_not_better_than_persistence_raises(make_config, reporter) -> None:
    config = make_config(training__allow_weak_base=False)
    with pytest.raises(InputError, match="copying the last frame"):
        train(config, reporter)
    assert reporter.steps == []
    assert not Path(config.run_dir).exists(), "a corrected config must be able to use the folder"


@pytest.mark.parametrize(
    ("low", "high", "is_warned"),
    [(0.41, 0.53, True), (0.55, 0.7, True), (0.02, 0.08, False), (math.nan, math.nan, False)],
)
def test_base_model_that_ranks_actions_at_chance_is_reported(low: float, high: float, *, is_warned: bool) -> None:
    ranking = SimpleNamespace(rank=Estimate(0.47, low, high))
    warning = base_warning(SimpleNamespace(ranking=ranking))
    assert warning.startswith(f"{NOT_SHOWN} (action-ranking error 47 % [") == is_warned
    assert bool(warning) == is_warned
    assert base_warning(SimpleNamespace(ranking=None)) == ""


def test_random_weights_as_base_model_are_reported_before_the_first_step(make_config, reporter) -> None:
    train(make_config(validation__clips=12, validation__ranking_clips=12), reporter, check_only=True)
    assert any(note.startswith(NOT_SHOWN) for note in reporter.notes)


def test_check_runs_all_checks_and_writes_nothing(make_config, reporter) -> None:
    config = make_config()
    train(config, reporter, check_only=True)
    assert "All checks passed" in reporter.notes[-1]
    assert not Path(config.run_dir).exists()
    with pytest.raises(InputError, match="copying the last frame"):
        train(make_config(training__allow_weak_base=False), reporter, check_only=True)


def test_an_allowed_config_change_is_written_and_reported(make_config, reporter) -> None:
    train(make_config(), reporter)
    changed = make_config(training__steps=8, training__learning_rate=2e-3)
    train(changed, reporter, check_only=True, allow_config_change=True)
    folder = Path(changed.run_dir)
    assert (folder / "config.yaml").read_text() != config_as_yaml(changed), "--check writes nothing"
    train(changed, reporter, allow_config_change=True)
    reported = ["training.learning_rate: 0.001 -> 0.002", "training.steps: 6 -> 8"]
    assert [note for note in reporter.notes if "Config change" in note][-2:] == [
        f"Config change: {s}" for s in reported
    ]
    assert (folder / "config.yaml").read_text() == config_as_yaml(changed)
    starts = json.loads((folder / "environment.json").read_text())
    assert [start.get("config_changes") for start in starts] == [None, reported]
    assert reporter.steps == [*range(1, 7), 7, 8]
    train(changed, reporter)


def test_allowed_changes_of_the_optimizer_take_effect(make_config, reporter) -> None:
    """The saved state of the optimizer contains the old settings."""
    train(make_config(training__steps=2, training__weight_decay=0.04), reporter)
    run = set_up(make_config(training__weight_decay=0.5), reporter)
    assert [group["weight_decay"] for group in run.optimizer.param_groups] == [0.5]
    assert all(parameter_state["step"] == 2 for parameter_state in run.optimizer.state_dict()["state"].values())


def test_run_resumes_with_moved_data_and_refuses_other_data(make_config, reporter, tmp_path, data_folder) -> None:
    folder = train(make_config(training__steps=2), reporter)
    for name in ("moved", "others"):
        shutil.copytree(data_folder, tmp_path / name)  # copies the modification times of the files
    train(make_config(training__steps=2, data__path=str(tmp_path / "moved")), reporter)
    assert read_run_config(folder).data.path == str(tmp_path / "moved"), "later commands must find the moved data"
    next((tmp_path / "others").rglob("*.tfrecord*")).touch()
    other_config = make_config(training__steps=2, data__path=str(tmp_path / "others"))
    with pytest.raises(InputError, match=r"others: episodes or files that differ from those of the run.*moved\."):
        train(other_config, type(reporter)())
    train(other_config, type(reporter)(), allow_config_change=True)


def test_bf16_run_keeps_trained_weights_in_float32(make_config: object, reporter) -> None:
    config: Config = make_config(training__precision="bf16", model__dtype="bfloat16", training__steps=2)
    train(config, reporter)
    assert all(value.dtype == torch.float32 for value in trained_weights(Path(config.run_dir)).values())


def test_resumed_run_remembers_broken_episodes(make_config, reporter, monkeypatch) -> None:
    read, config = loader.read_clip, make_config(training__steps=2, data__broken_episodes="skip")
    bad = next(iterate_batches(set_up(config, reporter))).episode_ids[0]

    def read_clip_or_raise(dataset: Dataset, request: ClipRequest) -> Clip:
        if dataset.table.identity(request.episode) == bad:
            raise InputError(where="here", found="damaged")
        return read(dataset, request)

    monkeypatch.setattr(loader, "read_clip", read_clip_or_raise)
    train(config, reporter)
    monkeypatch.setattr(loader, "read_clip", read)
    assert set_up(config, reporter).dataset.broken.reasons == {bad: "here: damaged."}


def test_checkpoint_is_saved_at_the_time_limit(make_config, reporter, tmp_path, monkeypatch) -> None:
    for seconds, saved_steps in ((0.0, [1, 2, 3]), (3600.0, [3])):
        monkeypatch.setattr(outputs, "SAVE_EVERY_S", seconds)
        keys = {"run_dir": tmp_path / str(seconds), "checkpoint__every": 100, "checkpoint__keep_best": "off"}
        run = train(make_config(training__steps=3, **keys), reporter)
        assert sorted(int(path.name.split("-")[1]) for path in (run / "checkpoints").glob("step-*")) == saved_steps
