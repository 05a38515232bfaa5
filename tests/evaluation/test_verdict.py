"""The verdict agrees with the metrics."""

from dataclasses import replace

import numpy as np
import pytest

from evaluation_results import ranking_of
from vjepa2_ac.evaluation.evaluate import clips_of
from vjepa2_ac.evaluation.result import (
    L1,
    L2,
    MODES,
    Evaluation,
    Metric,
    ModelResult,
    PredictionErrors,
)
from vjepa2_ac.evaluation.verdict import uses_actions, verdict
from vjepa2_ac.spaces import POSE_CHANGE
from worlds import about

CLIPS, HORIZON = 24, 3


def errors(level: float, noise: float = 0.0) -> np.ndarray:
    """Return errors of about `level` times those of persistence, 0.5."""
    rng = np.random.default_rng(int(level * 1000))
    return 0.5 * (level + noise * rng.standard_normal((CLIPS, HORIZON)))


def predicted(episodes: int = 8, **ways: dict[Metric, np.ndarray]) -> PredictionErrors:
    """Return errors of each way of predicting, by metric, in either mode."""
    ids = tuple(f"episode {clip % episodes}" for clip in range(CLIPS))
    ways = {"persistence": dict.fromkeys((L1, L2), errors(1.0)), **ways}
    arrays = {
        (way, mode, metric.name): values
        for way, by_metric in ways.items()
        for metric, values in by_metric.items()
        for mode in MODES
    }
    return PredictionErrors(ids, arrays)  # type: ignore[arg-type]


def model(
    name: str, level: float, *, noise: float = 0.02, shuffled: float | None = None, episodes: int = 8
) -> ModelResult:
    of_true, others = (
        dict.fromkeys((L1, L2), errors(one, noise)) for one in (level, level if shuffled is None else shuffled)
    )
    found = predicted(episodes, true=of_true, zero=others, shuffled=others)
    return ModelResult(name, "base" if name == "base" else "trained", found)


def evaluation(*models: ModelResult, episodes: int = 8) -> Evaluation:
    ids = tuple(f"episode {clip % episodes}" for clip in range(CLIPS))
    actions = np.full((CLIPS, HORIZON, 7), 0.01)
    return Evaluation(
        about=about(frames=HORIZON + 1, seconds_per_step=0.5),
        clips=clips_of(actions, ids, tuple(range(CLIPS)), space=POSE_CHANGE, seconds_per_step=0.5),
        models={each.name: each for each in models},
        strata=(),
        episodes=(),
        examples=(),
    )


@pytest.mark.parametrize(
    ("base", "adapter", "noise", "words"),
    [
        (1.0, 0.75, 0.02, "The adapter predicts 1.5 s ahead 25% better than the base (gain 95 % interval"),
        (0.8, 1.2, 0.0, "The adapter predicts 1.5 s ahead 50% WORSE than the base"),
        (1.0, 0.998, 0.0, "The adapter predicts 1.5 s ahead 0.20% better than the base (gain 95 % interval 0.20% to"),
        (1.0, 0.999, 0.3, "The adapter did not clearly help"),
        (None, 0.5, 0.02, "The adapter was measured on 24 clips of 8 held-out episodes"),
    ],
)
def test_an_adapter_is_compared_with_the_base_by_its_share_and_the_noise(
    base: float | None, adapter: float, noise: float, words: str
) -> None:
    of_base = [] if base is None else [model("base", base, noise=noise)]
    found = verdict(evaluation(*of_base, model("adapter", adapter, noise=noise)))
    assert found.startswith(words)
    assert ("than the base" in found) == (base is not None)


@pytest.mark.parametrize("episodes", [8, 1])
def test_a_run_whose_checkpoint_is_the_base_is_neither_better_nor_worse(episodes: int) -> None:
    both = (model(name, 1.0, noise=0.0, episodes=episodes) for name in ("base", "adapter"))
    words = verdict(evaluation(*both, episodes=episodes))
    assert words.startswith("The adapter predicts exactly as the base does, on 24 clips of")


def ranked(name: str, level: float, rank: float) -> ModelResult:
    """Return a model of an error and a mean rank of the true action; the ranks differ a little by clip."""
    ids = tuple(f"episode {clip % 8}" for clip in range(CLIPS))
    return replace(model(name, level), ranking=ranking_of(rank + 0.01 * np.sin(np.arange(CLIPS)), ids))


@pytest.mark.parametrize(
    ("rank", "words"), [(0.02, "better to plan with"), (0.05, "no clear difference"), (0.1, "WORSE")]
)
def test_a_ranking_is_compared_with_that_of_the_base(rank: float, words: str) -> None:
    found = verdict(evaluation(ranked("base", 1.0, 0.05), ranked("adapter", 1.1, rank)))
    assert f"that of the base 0.050: {words}" in found
    assert "predicts better, but" not in found
    assert "that of the base" not in verdict(evaluation(ranked("model", 1.0, rank)))
    better = verdict(evaluation(ranked("base", 1.0, 0.05), ranked("adapter", 0.7, rank)))
    assert ("It predicts better, but PLANS WORSE than the base." in better) == (words == "WORSE")


def test_actions_are_called_used_only_where_wrong_ones_are_clearly_worse() -> None:
    deaf = evaluation(model("model", 0.5))
    assert not uses_actions(deaf)
    assert "It does NOT clearly use the actions" in verdict(deaf)
    listening = evaluation(model("model", 0.5, shuffled=0.9))
    assert uses_actions(listening)
    assert (
        "It uses the actions: with another clip's its one-step error is 0.90 of doing nothing, with its own 0.50"
        in (verdict(listening))
    )


def by(l1: float, others: float, *, noise: float = 0.02) -> dict[Metric, np.ndarray]:
    """Return errors for which L1 differs from L2 relative to persistence."""
    return {L1: errors(l1, noise), L2: errors(others, noise)}


def with_errors(found: Evaluation, name: str, true: dict[Metric, np.ndarray]) -> Evaluation:
    before = found.models[name].errors
    given = {(way, mode, metric.name): values for metric, values in true.items()
             for way, mode in (("true", "teacher_forced"), ("true", "rollout"))}  # fmt: skip
    changed = replace(found.models[name], errors=replace(before, arrays={**before.arrays, **given}))
    return replace(found, models={**found.models, name: changed})


def test_the_words_say_where_l2_contradicts_l1() -> None:
    found = evaluation(model("base", 0.95), model("adapter", 0.8))
    assert "another matter" not in verdict(found)
    denied = verdict(with_errors(found, "adapter", by(0.8, 1.25)))
    assert denied.startswith("The adapter predicts 1.5 s ahead 16% better than the base")
    assert "By L2 it is another matter: 32% WORSE than the base (gain 95 % interval -3" in denied
    assert " and 1.25 of doing nothing (95 % interval 1.2" in denied
    assert "): NOT better. It does NOT" in denied


def test_one_episode_gives_no_interval_and_no_certainty() -> None:
    one = evaluation(*(model(name, level, episodes=1) for name, level in (("base", 1.0), ("adapter", 0.5))), episodes=1)
    words = verdict(one)
    assert "one episode: no interval" in words
    assert "did not clearly help" in words
