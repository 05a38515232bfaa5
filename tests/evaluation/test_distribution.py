"""The spread is a ratio of traces of covariances. The MMD of equal distributions is 0, and smoothing raises it."""

import math

import numpy as np
import pytest
import torch

from vjepa2_ac.evaluation.distribution import (
    LatentSums,
    compare_distributions,
    frechet_distance,
    frechet_distance_of_halves,
    mmd,
    relative_spread,
)

CLIPS, EPISODES = 48, 12
IDS = tuple(f"episode {clip % EPISODES}" for clip in range(CLIPS))


def latents(seed: int, spread: float = 1.0, tokens: int = 9, dim: int = 24) -> torch.Tensor:
    """Return latents that are similar within an episode, with a common mean and a variance proportional to `spread`."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.linspace(-1, 1, tokens * dim).reshape(1, 1, tokens, dim)
    episode_part = torch.randn(EPISODES, 2, tokens, dim, generator=generator).repeat(CLIPS // EPISODES, 1, 1, 1)
    clip_part = torch.randn(CLIPS, 2, tokens, dim, generator=generator)
    return mean + math.sqrt(spread) * (0.6 * episode_part + 0.8 * clip_part)


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
    spreads = relative_spread(summed(predicted), summed(true))
    assert [spread.value for spread in spreads] == pytest.approx(trace(predicted) / trace(true))
    assert not any(spread.has_interval for spread in spreads)


def test_latents_as_varied_as_the_truth_have_spread_1() -> None:
    true = latents(2)
    spreads = relative_spread(summed(latents(3)), summed(true))
    assert [spread.value for spread in spreads] == pytest.approx([1, 1], abs=0.3)
    spreads = relative_spread(summed(true + 5), summed(true))  # the spread does not depend on the mean
    assert [spread.value for spread in spreads] == pytest.approx([1, 1])


def test_mmd_averages_latents_over_tokens_and_fvd_also_over_frames() -> None:
    predicted, true = latents(1, spread=0.5), latents(2)
    distribution = compare_distributions(summed(predicted), summed(true))
    pooled = [values.mean(dim=2).double().numpy() for values in (predicted, true)]
    assert distribution.mmd[1].value == pytest.approx(mmd(pooled[0][:, 1], pooled[1][:, 1], IDS).value, rel=1e-4)
    assert distribution.fvd == pytest.approx(frechet_distance(*(values.mean(axis=1) for values in pooled)), rel=1e-4)
    assert frechet_distance_of_halves(summed(true)) > 0


def test_single_clip_has_no_distribution_and_single_episode_no_mmd() -> None:
    one_clip = LatentSums()
    one_clip.add(latents(1)[:1], IDS[:1])
    distribution = compare_distributions(one_clip, one_clip)
    assert all(math.isnan(estimate.value) for estimate in (*distribution.spread, *distribution.mmd))
    assert math.isnan(distribution.fvd)
    one_episode = LatentSums()
    one_episode.add(latents(1)[:3], ["only"] * 3)
    assert relative_spread(one_episode, one_episode)[0].value == pytest.approx(1)
    assert math.isnan(compare_distributions(one_episode, one_episode).mmd[0].value)


# ---- the Fréchet distance ----


@pytest.mark.parametrize("count", [400, 6])
def test_frechet_distance_equals_the_matrix_root_formula_for_few_and_many_clips(count: int) -> None:
    rng = np.random.default_rng(0)
    first, second = rng.standard_normal((count, 8)), 0.5 + 1.5 * rng.standard_normal((count + 1, 8)) * np.arange(1, 9)
    first_cov, second_cov = (np.cov(values, rowvar=False) for values in (first, second))
    roots = np.sqrt(np.linalg.eigvals(first_cov @ second_cov).real.clip(min=0))
    expected = (
        np.square(first.mean(0) - second.mean(0)).sum() + np.trace(first_cov) + np.trace(second_cov) - 2 * roots.sum()
    )
    assert frechet_distance(first, second) == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(first, first) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(first, first + 2) == pytest.approx(8 * 4)


# ---- the MMD ----

DIM, MMD_EPISODES, MMD_CLIPS = 256, 30, 4
MMD_IDS = tuple(f"episode {number}" for number in range(MMD_EPISODES) for _ in range(MMD_CLIPS))
SCALES = np.arange(1, DIM + 1) ** -0.25  # variances 1/sqrt(k): as in real features, many directions matter
MEAN = 0.2 * np.cos(np.arange(DIM))


def features(rng: np.random.Generator) -> np.ndarray:
    """Return features of clips that are similar within an episode."""
    episode_part = np.repeat(rng.standard_normal((MMD_EPISODES, DIM)), MMD_CLIPS, axis=0)
    return MEAN + SCALES * (0.8 * episode_part + 0.6 * rng.standard_normal((len(MMD_IDS), DIM)))


def equally_spread(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """Return inaccurate predictions with the distribution of the true features, and a correlation of 0.8 with them."""
    return MEAN + 0.8 * (true - MEAN) + 0.6 * (features(rng) - MEAN)


def smoothed(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """Return predictions that are equally inaccurate, with 20 % smaller deviations from the mean."""
    return MEAN + 0.8 * (equally_spread(rng, true) - MEAN)


def test_mmd_of_equal_distributions_has_expectation_zero() -> None:
    values = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true = features(rng)
        values.append(mmd(equally_spread(rng, true), true, MMD_IDS).value)
    assert abs(np.mean(values)) < 3 * np.std(values) / math.sqrt(len(values))


def test_smoothed_predictions_have_a_higher_mmd_than_equally_spread_predictions() -> None:
    values = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        true = features(rng)
        values.append(
            [mmd(predicted, true, MMD_IDS).value for predicted in (smoothed(rng, true), equally_spread(rng, true))]
        )
    smooth, spread = np.mean(values, axis=0)
    assert smooth > spread + 3 * np.std(np.subtract(*np.transpose(values))) / math.sqrt(30)


def test_mmd_interval_of_different_distributions_contains_the_exact_value() -> None:
    rng = np.random.default_rng(0)
    true = features(rng)
    estimate = mmd(0.6 * equally_spread(rng, true), true, MMD_IDS)
    moment = np.diag(SCALES**2) + np.outer(MEAN, MEAN)
    exact = 100 * float(((1 - 0.36) ** 2 * moment**2).sum()) / DIM**2
    assert estimate.low < exact < estimate.high
    assert estimate.low > 0


def test_mmd_equals_the_sum_over_clip_pairs_from_different_episodes() -> None:
    rng = np.random.default_rng(1)
    predicted, true = rng.standard_normal((2, 7, 5))
    ids = ["a", "b", "a", "c", "b", "b", "c"]
    total, count = 0.0, 0
    for i in range(7):
        for j in range(7):
            if ids[i] != ids[j]:
                count += 1
                total += sum(
                    sign * (first[i] @ second[j] / 5) ** 2
                    for sign, first, second in (
                        (1, predicted, predicted),
                        (1, true, true),
                        (-1, predicted, true),
                        (-1, true, predicted),
                    )
                )
    assert mmd(predicted, true, ids).value == pytest.approx(100 * total / count)
