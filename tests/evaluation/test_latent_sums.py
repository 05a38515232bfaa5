"""Spread is the ratio of traces of covariances, from sums alone; its interval survives the sketch."""

import math

import numpy as np
import pytest
import torch

from vjepa2_ac.evaluation import distribution as latent_sums
from vjepa2_ac.evaluation.distribution import LatentSums, discrepancy, distribution_of, latent_noise_floor, spread_of

CLIPS, EPISODES = 48, 12
IDS = tuple(f"episode {clip % EPISODES}" for clip in range(CLIPS))


def latents(seed: int, spread: float = 1.0, tokens: int = 9, dim: int = 24) -> torch.Tensor:
    """Return latents about a common mean, alike within an episode, as varied as `spread` says."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.linspace(-1, 1, tokens * dim).reshape(1, 1, tokens, dim)
    of_episode = torch.randn(EPISODES, 2, tokens, dim, generator=generator).repeat(CLIPS // EPISODES, 1, 1, 1)
    own = torch.randn(CLIPS, 2, tokens, dim, generator=generator)
    return mean + math.sqrt(spread) * (0.6 * of_episode + 0.8 * own)


def summed(values: torch.Tensor, batch: int = 5) -> LatentSums:
    sums = LatentSums()
    for first in range(0, len(values), batch):
        sums.add(values[first : first + batch], IDS[first : first + batch])
    return sums


def trace(values: torch.Tensor) -> np.ndarray:
    """Return the trace of the covariance over clips, by horizon."""
    return values.double().var(dim=0, correction=0).sum(dim=(1, 2)).numpy()


def test_spread_is_the_ratio_of_the_traces_of_the_covariances() -> None:
    predicted, true = latents(1, spread=0.5), latents(2)
    found = spread_of(summed(predicted), summed(true))
    assert [one.value for one in found] == pytest.approx(trace(predicted) / trace(true))
    assert all(one.low < one.value < one.high < 1 for one in found)


def test_latents_as_varied_as_the_truth_have_spread_1() -> None:
    true = latents(2)
    assert all(one.low < 1 < one.high for one in spread_of(summed(latents(3)), summed(true)))
    (one, other) = spread_of(summed(true + 5), summed(true))  # where their mean is does not matter
    assert (one.value, other.value) == pytest.approx((1, 1))


def test_its_interval_is_that_of_resampled_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    predicted, true = latents(1, spread=0.5), latents(2)
    sums = [summed(values) for values in (predicted, true)]
    seen: list[np.ndarray] = []
    monkeypatch.setattr(
        latent_sums, "bootstrapped_by_weights", lambda of, count: seen.append(of(np.arange(count)[None] % 3.0))
    )
    spread_of(*sums)
    weight = {name: place % 3 for place, name in enumerate(sorted(set(IDS)))}
    rows = [clip for clip, name in enumerate(IDS) for _ in range(weight[name])]
    assert seen[0][0] == pytest.approx(trace(predicted[rows]) / trace(true[rows]))


def test_a_sketch_changes_no_estimate_and_hardly_an_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    predicted, true = latents(1, 0.5, 36, 64), latents(2, 1.0, 36, 64)
    predicted *= torch.linspace(0.7, 1.3, EPISODES).repeat(CLIPS // EPISODES)[:, None, None, None]  # unlike episodes
    exact = spread_of(summed(predicted), summed(true))
    monkeypatch.setattr(latent_sums, "MOST_SKETCHED", 512)
    latent_sums._hashes.cache_clear()
    sketched = spread_of(summed(predicted), summed(true))
    latent_sums._hashes.cache_clear()
    for one, other in zip(exact, sketched, strict=True):
        assert other.value == pytest.approx(one.value, rel=1e-9)
        assert other.low != one.low
        assert other.high - other.low == pytest.approx(one.high - one.low, rel=0.15)


def test_discrepancy_is_of_latents_averaged_over_tokens() -> None:
    predicted, true = latents(1, spread=0.5), latents(2)
    found = distribution_of(summed(predicted), summed(true))
    pooled = [values[:, 1].mean(dim=1).double().numpy() for values in (predicted, true)]
    expected, p_value = discrepancy(pooled[0], pooled[1], IDS)
    assert found.mmd[1].value == pytest.approx(expected.value, rel=1e-4)
    assert found.p_values[1] == pytest.approx(p_value, abs=0.01)
    assert all(floor > 0 for floor in latent_noise_floor(summed(true)))


def test_one_clip_has_no_spread_and_one_episode_no_interval() -> None:
    alone = LatentSums()
    alone.add(latents(1)[:1], IDS[:1])
    found = distribution_of(alone, alone)
    assert all(math.isnan(one.value) for one in found.spread)
    assert all(math.isnan(one.value) for one in found.mmd)
    same = LatentSums()
    same.add(latents(1)[:3], ["only"] * 3)
    assert spread_of(same, same)[0].value == pytest.approx(1)
    assert not spread_of(same, same)[0].has_interval
