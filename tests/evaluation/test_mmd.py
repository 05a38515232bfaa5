"""The MMD is 0 in expectation if nothing differs, its test has its size, and it does not reward smoothing."""

import math

import numpy as np
import pytest

from vjepa2_ac.evaluation.distribution import discrepancy, episode_pairs, noise_floor, p_of_no_difference

DIM, EPISODES, CLIPS = 256, 30, 4
IDS = tuple(f"episode {number}" for number in range(EPISODES) for _ in range(CLIPS))
SCALES = np.arange(1, DIM + 1) ** -0.25  # a spectrum of 1/sqrt(k): many directions, as features have
MEAN = 0.2 * np.cos(np.arange(DIM))


def features(rng: np.random.Generator) -> np.ndarray:
    """Return features of clips that are alike within an episode."""
    of_episode = np.repeat(rng.standard_normal((EPISODES, DIM)), CLIPS, axis=0)
    return MEAN + SCALES * (0.8 * of_episode + 0.6 * rng.standard_normal((len(IDS), DIM)))


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
    pairs = episode_pairs(predicted, true, IDS)
    return 100 * float((pairs.both.sum()) / pairs.counts.sum())


def test_without_a_difference_the_expectation_is_zero_and_the_test_has_its_size() -> None:
    values, p_values = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        true = features(rng)
        predicted = equally_spread(rng, true)
        values.append(statistic(predicted, true))
        p_values.append(p_of_no_difference(episode_pairs(predicted, true, IDS), flips=200, seed=1000 + seed))
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
    found, p_value = discrepancy(0.6 * equally_spread(rng, true), true, IDS)
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
    floor = noise_floor(true, IDS)
    assert 0 < floor < statistic(2 * true, true)
    assert statistic(true, true) == 0
    order = rng.permutation(EPISODES)
    clips = (order[:, None] * CLIPS + np.arange(CLIPS)).ravel()
    assert noise_floor(true[clips], [IDS[clip] for clip in clips]) == pytest.approx(floor)


def test_one_episode_says_nothing() -> None:
    values = np.random.default_rng(0).standard_normal((2, 3, 4))
    found, p_value = discrepancy(values[0], values[1], ["only"] * 3)
    assert math.isnan(found.value)
    assert math.isnan(p_value)
    assert math.isnan(noise_floor(values[0], ["a", "b", "c"]))
