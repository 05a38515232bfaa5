"""A step counts every clip that could be read alike, and none that could not."""

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from vjepa2_ac.config import Config
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.latents import extrinsics_for
from vjepa2_ac.training.assembly import Run, assemble
from vjepa2_ac.training.step import Gradients, gradients, training_step


def some_clips(batch: Batch, chosen: list[int]) -> Batch:
    """Return a batch with some of its clips; the others could not be read."""
    return replace(
        batch,
        frames=batch.frames[chosen],
        states=batch.states[chosen],
        actions=batch.actions[chosen],
        episode_ids=tuple(batch.episode_ids[place] for place in chosen),
        starts=tuple(batch.starts[place] for place in chosen),
    )


def prepared(make_config: Any, reporter: Any, batch_size: int, accumulation: int, **changes: Any) -> Run:
    config: Config = make_config(
        training__batch_size=batch_size, training__accumulation=accumulation, adapter__dropout=0.0,
        training__max_grad_norm=None, **changes,
    )  # fmt: skip
    return assemble(config, reporter.note)


def taken(run: Run, batches: list[Batch]) -> tuple[Gradients, dict[str, torch.Tensor]]:
    run.optimizer.zero_grad(set_to_none=True)
    figures = gradients(run, iter(batches))
    return figures, {n: p.grad.clone() for n, p in run.world_model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("read", [[[0, 1], [2]], [[], [1, 2, 3]], [[3], []]])
def test_clips_left_out_leave_the_mean_over_the_others(make_config, reporter, read: list[list[int]]) -> None:
    run = prepared(make_config, reporter, 4, 2)
    whole = next(training_loader(run.dataset, seed=0, batch_size=4))
    figures, gradient = taken(run, [some_clips(whole, chosen) for chosen in read])
    clips = [clip for chosen in read for clip in chosen]
    alone = prepared(make_config, reporter, len(clips), 1)
    expected, expected_gradient = taken(alone, [some_clips(whole, clips)])
    assert figures.clips == len(clips)
    assert figures.forced_loss == pytest.approx(expected.forced_loss, rel=1e-5)
    assert figures.rollout_loss == pytest.approx(expected.rollout_loss, rel=1e-5)
    assert figures.norm == pytest.approx(expected.norm, rel=1e-4)
    assert gradient
    for name, one in expected_gradient.items():
        torch.testing.assert_close(gradient[name], one, rtol=1e-4, atol=1e-7)


def test_a_step_without_a_clip_moves_nothing_and_says_so(make_config, reporter) -> None:
    run = prepared(make_config, reporter, 2, 2, data__broken_episodes="skip")
    batches = training_loader(run.dataset, seed=0, batch_size=2)
    training_step(run, batches, 1)  # the optimizer has momentum now
    before = [parameter.detach().clone() for parameter in run.world_model.parameters()]
    figures = training_step(run, iter([some_clips(batch, []) for batch in itertools.islice(batches, 2)]), 2)
    assert math.isnan(figures["loss"])
    assert figures["clips_left_out"] == 4
    assert all(torch.equal(old, new) for old, new in zip(before, run.world_model.parameters(), strict=True))


def test_bytes_per_clip_are_told_of_data_that_lies_elsewhere(make_config, reporter) -> None:
    run = prepared(make_config, reporter, 2, 2)
    batches = [
        replace(batch, bytes_fetched=500)
        for batch in itertools.islice(training_loader(run.dataset, seed=0, batch_size=2), 2)
    ]
    assert "bytes_per_clip" not in training_step(run, iter(batches), 1)
    data = run.config.data.model_copy(update={"path": "gs://bucket/set"})
    run.config = run.config.model_copy(update={"data": data})
    assert training_step(run, iter(batches), 1)["bytes_per_clip"] == 250


def test_camera_poses_go_to_the_model_that_wants_them_only(make_config, reporter) -> None:
    run = prepared(make_config, reporter, 2, 1)
    batch = next(training_loader(run.dataset, seed=0, batch_size=2))
    posed = replace(batch, extrinsics=torch.ones(2, 4, 6))
    assert extrinsics_for(run.world_model, posed) is None
    wanting = run.world_model.sizes.predictor.model_copy(update={"use_extrinsics": True})
    run.world_model.sizes = run.world_model.sizes.model_copy(update={"predictor": wanting})
    assert extrinsics_for(run.world_model, posed) is posed.extrinsics
    with pytest.raises(InputError, match=r"use_extrinsics: no pose of the camera in some of these episodes: /data/LAB"):
        extrinsics_for(run.world_model, batch)
