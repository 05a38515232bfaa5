"""The words say what the figures say."""

import json

import numpy as np
import pytest

from vjepa2_ac.evaluation.evaluate import Evaluation, Example
from vjepa2_ac.evaluation.metrics import PredictionErrors
from vjepa2_ac.evaluation.plots import plot_evaluation
from vjepa2_ac.evaluation.report import evaluation_as_dict, improvement, spread, verdict

CLIPS, HORIZON = 24, 3


def errors(level: float, *, noise: float = 0.02, episodes: int = 8) -> PredictionErrors:
    """Return a model whose error is about `level` times persistence."""
    rng = np.random.default_rng(int(level * 1000))
    persistence = np.full((CLIPS, HORIZON), 0.5)
    rollout = persistence * (level + noise * rng.standard_normal((CLIPS, HORIZON)))
    return PredictionErrors(
        rollout=rollout,
        persistence=persistence,
        one_step=rollout[:, 0],
        one_step_zero_actions=rollout[:, 0],
        one_step_shuffled_actions=rollout[:, 0],
        one_step_persistence=persistence[:, 0],
        episode_ids=tuple(f"episode {clip % episodes}" for clip in range(CLIPS)),
    )


def evaluation(**models: PredictionErrors) -> Evaluation:
    example = Example(
        frames=np.zeros((HORIZON + 1, 32, 32, 3), np.uint8),
        errors={name: np.ones((HORIZON, 2, 2)) for name in ("persistence", *models)},
        episode_id="episode 0",
    )
    return Evaluation(models=models, seconds_per_step=0.5, example=example)


def test_a_better_adapter_is_called_better_by_its_share() -> None:
    words = verdict(evaluation(base=errors(1.0), adapter=errors(0.75)))
    assert words.startswith("The adapter predicts 1.5 s ahead 25% better than the base (gain 95 % interval")
    assert "24 clips of 8 held-out episodes" in words
    assert words.endswith(": better.")


def test_a_worse_adapter_is_called_worse() -> None:
    words = verdict(evaluation(base=errors(0.8, noise=0.0), adapter=errors(1.2, noise=0.0)))
    assert "50% WORSE than the base" in words
    assert words.endswith(": NOT better.")


def test_a_difference_within_the_noise_is_not_called_one() -> None:
    words = verdict(evaluation(base=errors(1.0, noise=0.3), adapter=errors(0.999, noise=0.3)))
    assert words.startswith("The adapter did not clearly help")
    assert words.endswith("no clear difference.")


def test_a_model_without_a_base_is_measured_against_doing_nothing_only() -> None:
    words = verdict(evaluation(model=errors(0.5)))
    assert words.startswith("The model was measured on 24 clips")
    assert "than the base" not in words


def test_one_episode_gives_no_interval_and_no_certainty(tmp_path) -> None:
    one = evaluation(base=errors(1.0, episodes=1), adapter=errors(0.5, episodes=1))
    words = verdict(one)
    assert "one episode: no interval" in words
    assert "did not clearly help" in words
    assert plot_evaluation(one, tmp_path / "picture.png").stat().st_size > 1000
    assert json.loads(json.dumps(evaluation_as_dict(one), allow_nan=False))["improvement_over_base"][0]["low"] is None


def test_improvement_is_one_minus_the_ratio_of_errors_and_its_interval_is_turned_round() -> None:
    gain = improvement(evaluation(base=errors(1.0, noise=0.0), adapter=errors(0.75)), horizon=2)
    assert gain is not None
    assert gain.value == pytest.approx(0.25, abs=0.02)
    assert gain.low < gain.value < gain.high


def test_the_spread_names_mean_and_range() -> None:
    words = spread([evaluation(base=errors(1.0, noise=0.0), adapter=errors(a, noise=0.0)) for a in (0.7, 0.8)])
    assert words == (
        "2 runs: error over persistence 0.750 (0.700 to 0.800); better than the base by 25.0% (20.0% to 30.0%)"
    )


def test_every_figure_is_written() -> None:
    values = evaluation_as_dict(evaluation(base=errors(1.0), adapter=errors(0.5)))
    assert list(values["models"]) == ["base", "adapter"]
    assert len(values["models"]["base"]["rollout_over_persistence"]) == HORIZON
    assert set(values["models"]["base"]["one_step_over_persistence"]) == {"true", "zero", "shuffled"}
    assert values["persistence_error"] == [0.5] * HORIZON
