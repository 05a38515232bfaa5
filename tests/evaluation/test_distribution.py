"""Spread is a ratio of traces of covariances; the MMD is 0 if nothing differs, and does not reward smoothing."""

import math

import numpy as np
import pytest
import torch

from vjepa2_ac.evaluation import distribution as latent_sums
from vjepa2_ac.evaluation.distribution import (
    LatentSums,
    discrepancy,
    distribution_of,
    episode_pairs,
    noise_floor,
    p_of_no_difference,
    spread_of,
)

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
    assert noise_floor(pooled[1], IDS) > 0


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


# ---- the MMD ---------------------------------------------------------------------------------------------------------

DIM, MMD_EPISODES, MMD_CLIPS = 256, 30, 4
MMD_IDS = tuple(f"episode {number}" for number in range(MMD_EPISODES) for _ in range(MMD_CLIPS))
SCALES = np.arange(1, DIM + 1) ** -0.25  # a spectrum of 1/sqrt(k): many directions, as features have
MEAN = 0.2 * np.cos(np.arange(DIM))


def features(rng: np.random.Generator) -> np.ndarray:
    """Return features of clips that are alike within an episode."""
    of_episode = np.repeat(rng.standard_normal((MMD_EPISODES, DIM)), MMD_CLIPS, axis=0)
    return MEAN + SCALES * (0.8 * of_episode + 0.6 * rng.standard_normal((len(MMD_IDS), DIM)))


def equally_spread(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """Return predictions that are off, but distributed as the truth: correlated with it by 0.8."""
    return MEAN + 0.8 * (true - MEAN) + 0.6 * (features(rng) - MEAN)


def smoothed(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """Return predictions that are off as far, with 20 % less spread."""
    return MEAN + 0.8 * (equally_spread(rng, true) - MEAN)


def of_jedi(predicted: np.ndarray, true: np.ndarray) -> float:
    """Return the estimate of JEDi: pairs of a clip with itself, and with its own truth, count."""
    kernels = [((a @ b.T) / DIM) ** 2 for a, b in ((predicted, predicted), (true, true), (predicted, true))]
    return 100 * float(kernels[0].mean() + kernels[1].mean() - 2 * kernels[2].mean())


def statistic(predicted: np.ndarray, true: np.ndarray) -> float:
    """Return the estimate without its interval."""
    ids = np.array(MMD_IDS)
    return 100 * float(episode_pairs(predicted, true, MMD_IDS).sum() / (ids[:, None] != ids).sum())


def test_without_a_difference_the_expectation_is_zero_and_the_test_has_its_size() -> None:
    values, p_values = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        true = features(rng)
        predicted = equally_spread(rng, true)
        values.append(statistic(predicted, true))
        p_values.append(p_of_no_difference(episode_pairs(predicted, true, MMD_IDS), flips=200, seed=1000 + seed))
    error = np.std(values) / math.sqrt(len(values))
    assert abs(np.mean(values)) < 3 * error
    assert 0.02 <= np.mean(np.array(p_values) <= 0.05) <= 0.07


def test_smoothed_predictions_score_worse_than_equally_spread_ones_and_the_estimate_of_jedi_reverses_them() -> None:
    ours, of_theirs = [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        true = features(rng)
        smooth, spread = smoothed(rng, true), equally_spread(rng, true)
        ours.append((statistic(smooth, true), statistic(spread, true)))
        of_theirs.append((of_jedi(smooth, true), of_jedi(spread, true)))
    smooth, spread = np.mean(ours, axis=0)
    assert smooth > spread + 3 * np.std(np.subtract(*np.transpose(ours))) / 10
    smooth, spread = np.mean(of_theirs, axis=0)
    assert smooth < 0.9 * spread


def test_a_real_difference_is_found_and_lies_in_the_interval() -> None:
    rng = np.random.default_rng(0)
    true = features(rng)
    found, p_value = discrepancy(0.6 * equally_spread(rng, true), true, MMD_IDS)
    assert p_value < 0.01
    moment = np.diag(SCALES**2) + np.outer(MEAN, MEAN)
    exact = 100 * float(((1 - 0.36) ** 2 * moment**2).sum()) / DIM**2
    assert found.low < exact < found.high
    assert found.low > 0


def test_the_estimate_is_the_sum_over_pairs_of_clips_of_different_episodes() -> None:
    rng = np.random.default_rng(1)
    predicted, true = rng.standard_normal((2, 7, 5))
    ids = ["a", "b", "a", "c", "b", "b", "c"]
    total, count = 0.0, 0
    for i in range(7):
        for j in range(7):
            if ids[i] != ids[j]:
                count += 1
                total += sum(
                    sign * (one[i] @ other[j] / 5) ** 2
                    for sign, one, other in (
                        (1, predicted, predicted),
                        (1, true, true),
                        (-1, predicted, true),
                        (-1, true, predicted),
                    )
                )
    assert discrepancy(predicted, true, ids)[0].value == pytest.approx(100 * total / count)


def test_two_halves_of_the_truth_stay_below_the_noise_floor_and_another_distribution_does_not() -> None:
    rng = np.random.default_rng(2)
    true = features(rng)
    floor = noise_floor(true, MMD_IDS)
    assert 0 < floor < statistic(2 * true, true)
    assert statistic(true, true) == 0
    order = rng.permutation(MMD_EPISODES)
    clips = (order[:, None] * MMD_CLIPS + np.arange(MMD_CLIPS)).ravel()
    assert noise_floor(true[clips], [MMD_IDS[clip] for clip in clips]) == pytest.approx(floor)


def test_one_episode_says_nothing() -> None:
    values = np.random.default_rng(0).standard_normal((2, 3, 4))
    found, p_value = discrepancy(values[0], values[1], ["only"] * 3)
    assert math.isnan(found.value)
    assert math.isnan(p_value)
    assert math.isnan(noise_floor(values[0], ["a", "b", "c"]))
