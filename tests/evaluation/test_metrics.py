"""An oracle scores zero, persistence one, and a model that ignores actions is found out."""

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.metrics import one_step_ratios, prediction_errors, ratio, ratios_by_horizon

TIME, TOKENS, DIM = 5, 3, 7


class World:
    """A world where every token moves by the sum of the action: what an oracle can predict exactly."""

    def next(self, latents: Tensor, actions: Tensor) -> Tensor:
        return latents + actions.sum(dim=-1)[:, :, None, None]


class Oracle(World):
    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        del states, extrinsics
        return self.next(latents, actions)

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        del states, extrinsics
        frames = [latents[:, -1:]]
        for step in range(actions.shape[1]):
            frames.append(self.next(frames[-1], actions[:, step : step + 1]))
        return torch.cat(frames[1:], dim=1)


class Copier:
    """Persistence: the last frame that was seen."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        del actions, states, extrinsics
        return latents

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        del states, extrinsics
        return latents[:, -1:].expand(-1, actions.shape[1], -1, -1)


def batches(clips: int = 12, size: int = 4) -> list[LatentBatch]:
    generator = torch.Generator().manual_seed(0)
    actions = torch.randn(clips, TIME - 1, 7, generator=generator)
    start = torch.randn(clips, 1, TOKENS, DIM, generator=generator)
    latents = torch.cat([start, Oracle().rollout(start, actions, actions)], dim=1)
    states = torch.zeros(clips, TIME, 7)
    ids = [f"episode {i // 2}" for i in range(clips)]
    return [
        LatentBatch(
            latents[i : i + size],
            states[i : i + size],
            actions[i : i + size],
            None,
            tuple(ids[i : i + size]),
            (0,) * size,
        )
        for i in range(0, clips, size)
    ]


def test_an_oracle_scores_zero_and_needs_the_true_actions() -> None:
    errors = prediction_errors(Oracle(), batches())
    assert [r.value for r in ratios_by_horizon(errors)] == pytest.approx([0.0] * (TIME - 1), abs=1e-6)
    one_step = one_step_ratios(errors)
    assert one_step["true"].value == pytest.approx(0.0, abs=1e-6)
    assert one_step["zero"].value == pytest.approx(1.0, rel=1e-6)
    assert one_step["shuffled"].value > 0.8


def test_persistence_is_exactly_one_relative_to_itself_and_blind_to_actions() -> None:
    errors = prediction_errors(Copier(), batches())
    assert all((r.value, r.low, r.high) == (1.0, 1.0, 1.0) for r in ratios_by_horizon(errors))
    assert {r.value for r in one_step_ratios(errors).values()} == {1.0}


def test_errors_equal_a_case_computed_by_hand() -> None:
    latents = torch.zeros(1, 3, 2, 2)
    latents[0, 1] = 1.0
    latents[0, 2] = torch.tensor([[3.0, 3.0], [5.0, 5.0]])
    batch = LatentBatch(latents, torch.zeros(1, 3, 7), torch.zeros(1, 2, 7), None, ("e",), (0,))
    errors = prediction_errors(Copier(), [batch])
    assert errors.persistence.tolist() == [[1.0, 4.0]]  # from the first frame
    assert errors.one_step_persistence.tolist() == [(1.0 + 3.0) / 2]  # from the frame before
    assert errors.episode_ids == ("e",)


def test_figures_do_not_depend_on_the_batch_size() -> None:
    small, large = (prediction_errors(Oracle(), batches(size=size)) for size in (3, 12))
    for name in ("rollout", "persistence", "one_step", "one_step_zero_actions", "one_step_shuffled_actions"):
        np.testing.assert_allclose(getattr(small, name), getattr(large, name), atol=1e-6)


def test_no_clips_are_an_error() -> None:
    with pytest.raises(ValueError, match="no clips"):
        prediction_errors(Copier(), [])


def test_ratio_weighs_clips_by_their_motion() -> None:
    result = ratio(np.array([1.0, 0.0]), np.array([1.0, 3.0]), ("a", "b"))
    assert result.value == 0.25


def test_the_interval_covers_the_truth_at_about_the_stated_rate() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(200):
        episode = rng.normal(0.7, 0.1, size=30)  # episodes differ; clips within one are alike
        errors = np.repeat(episode, 4) + rng.normal(0, 0.02, size=120)
        ids = tuple(str(i) for i in np.repeat(np.arange(30), 4))
        interval = ratio(errors, np.ones(120), ids, resamples=400, seed=trial)
        covered += interval.low <= 0.7 <= interval.high
    assert 0.88 <= covered / 200 <= 0.99
