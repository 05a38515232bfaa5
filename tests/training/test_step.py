"""A step weights all readable clips equally, and ignores unreadable ones."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from clips import some_clips
from run_fixtures import set_up
from vjepa2_ac.config import Config
from vjepa2_ac.data import loader
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import get_extrinsics
from vjepa2_ac.episode import Batch, Clip
from vjepa2_ac.errors import InputError
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.resume import save_checkpoint
from vjepa2_ac.training.step import Gradients, Run, compute_gradients, iterate_batches, training_step


def prepared(make_config: Any, reporter: Any, batch_size: int, accumulation: int, **changes: Any) -> Run:
    config: Config = make_config(
        training__batch_size=batch_size, training__accumulation=accumulation, adapter__dropout=0.0,
        training__max_grad_norm=None, **changes,
    )  # fmt: skip
    return set_up(config, reporter)


def step_gradients(run: Run, batches: list[Batch]) -> tuple[Gradients, dict[str, torch.Tensor]]:
    run.optimizer.zero_grad(set_to_none=True)
    metrics = compute_gradients(run, iter(batches))
    return metrics, {n: p.grad.clone() for n, p in run.world_model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("read", [[[], [1, 2, 3]]])
def test_skipped_clips_give_the_mean_over_the_remaining_clips(make_config, reporter, read: list[list[int]]) -> None:
    run = prepared(make_config, reporter, 4, 2)
    batch = next(training_loader(run.dataset, seed=0, batch_size=4))
    metrics, gradient = step_gradients(run, [some_clips(batch, chosen) for chosen in read])
    clips = [clip for chosen in read for clip in chosen]
    reference_run = prepared(make_config, reporter, len(clips), 1)
    expected, expected_gradient = step_gradients(reference_run, [some_clips(batch, clips)])
    assert metrics.clips == len(clips)
    assert metrics.forced_loss == pytest.approx(expected.forced_loss, rel=1e-5)
    assert metrics.rollout_loss == pytest.approx(expected.rollout_loss, rel=1e-5)
    assert metrics.norm == pytest.approx(expected.norm, rel=1e-4)
    assert gradient
    for name, value in expected_gradient.items():
        torch.testing.assert_close(gradient[name], value, rtol=1e-4, atol=1e-7)


def test_step_without_clips_changes_no_weight_and_is_logged(make_config, reporter) -> None:
    run = prepared(make_config, reporter, 2, 2, data__broken_episodes="skip")
    batches = training_loader(run.dataset, seed=0, batch_size=2)
    training_step(run, batches, 1)  # the optimizer has momentum now
    before = [parameter.detach().clone() for parameter in run.world_model.parameters()]
    metrics = training_step(run, iter([some_clips(batch, []) for batch in itertools.islice(batches, 2)]), 2)
    assert math.isnan(metrics["loss"])
    assert metrics["clips_left_out"] == 4
    assert all(torch.equal(old, new) for old, new in zip(before, run.world_model.parameters(), strict=True))


def test_camera_poses_are_passed_only_to_a_model_that_needs_them(make_config, reporter) -> None:
    run = prepared(make_config, reporter, 2, 1)
    batch = next(training_loader(run.dataset, seed=0, batch_size=2))
    with_poses = replace(batch, extrinsics=torch.ones(2, 4, 6))
    assert get_extrinsics(run.world_model, with_poses) is None
    with_extrinsics = run.world_model.sizes.predictor.model_copy(update={"use_extrinsics": True})
    run.world_model.sizes = run.world_model.sizes.model_copy(update={"predictor": with_extrinsics})
    assert get_extrinsics(run.world_model, with_poses) is with_poses.extrinsics
    with pytest.raises(InputError, match=r"use_extrinsics: no camera pose in some of these episodes: /data/LAB"):
        get_extrinsics(run.world_model, batch)


def with_loss_scale(run: Run, scale: float) -> Run:
    """Enable loss scaling as in fp16; it also works in fp32 on a CPU."""
    run.scaler = torch.amp.GradScaler("cpu", init_scale=scale, growth_interval=2)
    return run


def test_loss_scale_of_a_power_of_two_changes_nothing(make_config, reporter) -> None:
    plain, scaled = prepared(make_config, reporter, 2, 2), prepared(make_config, reporter, 2, 2)
    with_loss_scale(scaled, 1024.0)
    rows: list[list[dict[str, float]]] = []
    for run in (plain, scaled):
        batches = training_loader(run.dataset, seed=0, batch_size=2)
        rows.append([training_step(run, batches, step) for step in (1, 2, 3)])
    assert [row["grad_norm"] for row in rows[0]] == [row["grad_norm"] for row in rows[1]], (
        "the norm must be computed from unscaled gradients"
    )
    assert rows[1][-1]["loss_scale"] == 2048.0, "the scale doubles after two finite steps"
    weights = zip(plain.world_model.parameters(), scaled.world_model.parameters(), strict=True)
    assert all(torch.equal(value, reference) for value, reference in weights)


def test_overflow_skips_the_update_and_halves_the_loss_scale(make_config, reporter) -> None:
    run = with_loss_scale(prepared(make_config, reporter, 2, 2), 2.0**127)
    batches = training_loader(run.dataset, seed=0, batch_size=2)
    before = [parameter.detach().clone() for parameter in run.world_model.parameters()]
    row = training_step(run, batches, 1)
    assert math.isfinite(row["loss"])
    assert not math.isfinite(row["grad_norm"])
    assert row["loss_scale"] == 2.0**126
    assert all(torch.equal(old, new) for old, new in zip(before, run.world_model.parameters(), strict=True))
    assert all(state["step"] == 0 and not state["exp_avg"].any() for state in run.optimizer.state.values())


def test_overflow_at_the_smallest_loss_scale_raises(make_config, reporter) -> None:
    run = with_loss_scale(prepared(make_config, reporter, 2, 1), 0.5)
    parameter = next(p for p in run.world_model.parameters() if p.requires_grad)
    parameter.register_hook(lambda gradient: gradient * math.inf)
    with pytest.raises(InputError, match=r"not finite.*training\.precision to bf16 or fp32"):
        training_step(run, training_loader(run.dataset, seed=0, batch_size=2), 1)


def test_loss_scale_is_restored_from_a_checkpoint(make_config, reporter, tmp_path) -> None:
    config = make_config(training__max_grad_norm=None, training__precision="fp16")
    on_cpu = make_accelerator(make_config())  # fp16 on a CPU is an error in `make_accelerator`
    run = with_loss_scale(set_up(config, reporter, accelerator=on_cpu), 64.0)
    training_step(run, training_loader(run.dataset, seed=0, batch_size=2), 1)
    save_checkpoint(run, tmp_path / "run")
    other = set_up(config, reporter, accelerator=on_cpu)
    assert other.scaler.state_dict() == run.scaler.state_dict()
    assert other.scaler.state_dict()["_growth_tracker"] == 1


# A loss that is not finite


@pytest.fixture
def bad_clip(make_config: Any, reporter: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
    """Replace a state of the second clip of a run by NaN when it is read."""
    read, batch = loader.read_clip, next(iterate_batches(set_up(make_config(), reporter)))
    bad = (batch.episode_ids[1], batch.starts[1])

    def read_with_nan(*arguments: Any) -> Clip:
        clip = read(*arguments)
        if (clip.episode_id, clip.start) == bad:
            clip.states[1, 0] = np.nan
        return clip

    monkeypatch.setattr(loader, "read_clip", read_with_nan)
    return bad


def test_nan_loss_raises_with_the_names_of_the_clips(make_config, reporter, bad_clip) -> None:
    with pytest.raises(InputError, match="not finite") as caught:
        train(make_config(), reporter)
    assert reporter.steps == []
    assert f"{bad_clip[0]} from step {bad_clip[1]}" in str(caught.value)
