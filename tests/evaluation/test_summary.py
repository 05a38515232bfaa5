"""The summary has the measured numbers and the conclusions that follow from them, and fits a screen."""

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation_results import ranking_of
from vjepa2_ac.evaluation.evaluate import describe_clips
from vjepa2_ac.evaluation.result import (
    L1,
    L2,
    MODES,
    Evaluation,
    Landscape,
    Landscapes,
    LatentDistribution,
    Metric,
    ModelResult,
    PredictionErrors,
)
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.evaluation.summary import (
    PLANNING,
    PREDICTION,
    RANKING,
    SENSITIVITY,
    Summary,
    closed_loop_verdict,
    not_measured_verdict,
    summarize,
    with_closed_loop,
)
from vjepa2_ac.intervals import Estimate, estimate_share
from vjepa2_ac.spaces import POSE_CHANGE
from worlds import about

CLIPS, HORIZON = 24, 3


def errors(level: float, noise: float = 0.0) -> np.ndarray:
    """Return errors of about `level` times those of persistence, which are 0.5."""
    rng = np.random.default_rng(int(level * 1000))
    return 0.5 * (level + noise * rng.standard_normal((CLIPS, HORIZON)))


def prediction_errors(episodes: int = 8, **by_actions: dict[Metric, np.ndarray]) -> PredictionErrors:
    """Return errors by actions and metric, equal for both modes."""
    ids = tuple(f"episode {clip % episodes}" for clip in range(CLIPS))
    by_actions = {"persistence": dict.fromkeys((L1, L2), errors(1.0)), **by_actions}
    arrays = {
        (actions, mode, metric.name): values
        for actions, by_metric in by_actions.items()
        for metric, values in by_metric.items()
        for mode in MODES
    }
    return PredictionErrors(ids, arrays)  # type: ignore[arg-type]


def model(
    name: str, level: float, *, noise: float = 0.02, shuffled: float | None = None, episodes: int = 8
) -> ModelResult:
    true, wrong = (
        dict.fromkeys((L1, L2), errors(error_level, noise))
        for error_level in (level, level if shuffled is None else shuffled)
    )
    by_actions = prediction_errors(episodes, true=true, zero=wrong, shuffled=wrong)
    return ModelResult(name, "base" if name == "base" else "trained", by_actions)


def evaluation(*models: ModelResult, episodes: int = 8) -> Evaluation:
    ids = tuple(f"episode {clip % episodes}" for clip in range(CLIPS))
    actions = np.full((CLIPS, HORIZON, 7), 0.01)
    return Evaluation(
        about=about(frames=HORIZON + 1, seconds_per_step=0.5),
        clips=describe_clips(
            actions, list(zip(ids, range(CLIPS), strict=True)), space=POSE_CHANGE, seconds_per_step=0.5
        ),
        models={model.name: model for model in models},
    )


def summary_of(*models: ModelResult, episodes: int = 8, **changes: Any) -> Summary:
    measured = replace(evaluation(*models, episodes=episodes), **changes)
    return summarize(measured, make_rows(measured))


@pytest.mark.parametrize(
    ("base", "adapter", "noise", "conclusion", "statement"),
    [
        (1.0, 0.75, 0.02, "yes", "1.5 s ahead, error 25 % lower than the base model's"),
        (0.8, 1.2, 0.0, "no", "1.5 s ahead, error 50 % higher than the base model's"),
        (1.0, 0.998, 0.0, "no", "1.5 s ahead, error 0.2 % lower than the base model's"),
        (1.0, 1.0, 0.0, "no", "1.5 s ahead, error 0.0 % lower than the base model's"),
        (1.0, 0.98, 0.3, "inconclusive", "than the base model's"),
        (1.6, 1.2, 0.0, "no", "1.5 s ahead, error 20 % higher than that of persistence"),
        (None, 0.5, 0.02, "yes", "1.5 s ahead, error 50 % lower than that of persistence"),
    ],
)
def test_better_prediction_needs_a_lower_error_than_the_base_model_and_persistence(
    base: float | None, adapter: float, noise: float, conclusion: str, statement: str
) -> None:
    base_model = [] if base is None else [model("base", base, noise=noise)]
    summary = summary_of(*base_model, model("adapter", adapter, noise=noise))
    assert summary.prediction.conclusion == conclusion
    assert statement in summary.prediction.statement
    assert summary.prediction.compared_with in summary.prediction.statement
    denied = f"Prediction is not better than {summary.prediction.compared_with}. Check data, axes and stride first."
    assert (summary.sentence == denied) == (conclusion == "no")


def test_interval_has_the_sign_of_the_statement() -> None:
    for adapter, word in ((0.9, "lower"), (1.1, "higher")):
        prediction = summary_of(model("base", 1.0), model("adapter", adapter)).prediction
        low, high = map(float, prediction.interval.strip("[]").split(","))
        assert word in prediction.statement
        assert 0 < low <= float(prediction.statement.split("error ")[1].split()[0]) <= high


RATES = {"adapter": estimate_share(45, 50), "random": estimate_share(0, 50), "oracle": estimate_share(50, 50)}


def test_printed_interval_follows_its_number_and_one_line_explains_intervals() -> None:
    summary = summary_of(ranked("base", 1.0, 0.2), ranked("adapter", 0.75, 0.02))
    printed = str(summary)
    ranking = summary.ranking
    assert f"{ranking.statement} {ranking.interval} (base model" in printed
    assert "  Brackets: 95 % intervals over episodes\n" in printed
    rate = closed_loop_verdict(RATES, "adapter", "oracle", 50, "reach")
    text = " ".join(str(replace(summary, planning=rate)).split())
    assert f"success rate 90 % {rate.interval} on 50 reach problems" in text
    assert "Brackets: 95 % intervals over episodes and (success rate) problems" in text


def ranked(name: str, level: float, rank: float, **changes: Any) -> ModelResult:
    """Return a model with an error level and an action-ranking error that differs slightly between clips."""
    ids = tuple(f"episode {clip % 8}" for clip in range(CLIPS))
    return replace(model(name, level, **changes), ranking=ranking_of(rank + 0.01 * np.sin(np.arange(CLIPS)), ids))


@pytest.mark.parametrize(
    ("base", "rank", "conclusion", "compared_with"),
    [
        (0.05, 0.02, "yes", "the base model"),
        (0.05, 0.05, "no", "the base model"),
        (0.05, 0.1, "no", "the base model"),
        (0.7, 0.6, "no", "chance"),
        (None, 0.1, "yes", "chance"),
        (None, 0.6, "no", "chance"),
    ],
)
def test_better_action_ranking_needs_a_lower_error_than_chance_and_the_base_model(
    base: float | None, rank: float, conclusion: str, compared_with: str
) -> None:
    base_model = [] if base is None else [ranked("base", 1.0, base)]
    summary = summary_of(*base_model, ranked("adapter", 0.7, rank, shuffled=0.9))
    ranking = summary.ranking
    assert (ranking.conclusion, ranking.compared_with) == (conclusion, compared_with)
    assert ranking.value == pytest.approx(rank, abs=0.002)
    if rank > 0.5:
        assert summary.sensitivity.conclusion == "no", "action ranking is worse than chance"
        assert summary.sentence == "Action ranking is worse than chance, so the model cannot be used for planning."
    elif conclusion == "no":
        assert summary.sentence == "Action ranking is not better than the base model."
    else:
        assert summary.sentence.endswith(f"better action ranking than {compared_with}. Planning was not measured.")


def test_the_third_line_is_planning_if_a_closed_loop_was_measured_and_action_ranking_otherwise(tmp_path: Path) -> None:
    bare, measured = summary_of(model("model", 0.5)), summary_of(ranked("model", 0.5, 0.02, shuffled=0.9))
    assert bare.ranking == not_measured_verdict(RANKING, "`vjepa2-ac evaluate --ranking-clips 32`")
    rates = {name: estimate_share(count, 50) for name, count in {"m": 45, "random": 2, "oracle": 50}.items()}
    planning = closed_loop_verdict(rates, "m", "oracle", 50, "reach")
    (tmp_path / "closed_loop" / "reach-B").mkdir(parents=True)
    file = tmp_path / "closed_loop" / "reach-B" / "closed_loop.json"
    file.write_text(json.dumps({"about": {"checkpoint": "step-8 (the newest)"}, "verdict": asdict(planning)}))
    for summary in (bare, measured):
        with_planning = with_closed_loop(summary, tmp_path, "step-8 (the newest)")
        assert [verdict.name for verdict in summary.verdicts] == [PREDICTION, SENSITIVITY, RANKING]
        assert with_planning.verdicts == (*summary.verdicts[:2], planning)
        assert with_closed_loop(summary, tmp_path, "step-9 (the newest)") == summary
        assert with_closed_loop(summary, tmp_path / "no", "step-8 (the newest)") == summary
        assert PLANNING not in str(summary)
    assert with_closed_loop(measured, tmp_path, "step-8 (the newest)").sentence.endswith(
        "a higher success rate than the zero action and random actions."
    )


def test_sensitivity_to_actions_needs_a_higher_error_with_shuffled_actions() -> None:
    ignoring, sensitive = summary_of(model("model", 0.5)), summary_of(model("model", 0.5, shuffled=0.9))
    assert (ignoring.sensitivity.conclusion, sensitive.sensitivity.conclusion) == ("no", "yes")
    assert ignoring.sentence.startswith("The model predicts typical motion and ignores the actions")
    inverse = summary_of(model("model", 0.9, shuffled=0.5))
    assert inverse.sensitivity.statement == "one-step error 45 % lower with shuffled actions"
    assert inverse.sentence.startswith("The error is lower with shuffled actions than with true ones.")
    assert sensitive.sensitivity.statement == "one-step error 81 % higher with shuffled actions"


@pytest.mark.parametrize("episodes", [1, 4])
def test_too_few_episodes_give_numbers_without_conclusions(episodes: int) -> None:
    models = [model(name, level, episodes=episodes) for name, level in (("base", 1.0), ("adapter", 0.5))]
    summary = summary_of(*models, episodes=episodes)
    assert [verdict.conclusion for verdict in summary.verdicts] == ["inconclusive", "inconclusive", "not measured"]
    verb = "episode is" if episodes == 1 else "episodes are"
    assert summary.sentence.startswith(f"{episodes} held-out {verb} too few for a conclusion; at least 5 are needed.")
    assert summary.sentence.endswith("than the base model's; one-step error 0.0 % higher with shuffled actions.")
    assert "[" not in str(summary), "an interval over so few episodes means nothing"


def test_measurement_on_too_few_episodes_has_no_conclusion() -> None:
    adapter = ranked("adapter", 0.7, 0.6, shuffled=0.9)
    adapter = replace(adapter, ranking=ranking_of(np.array([0.6, 0.6]), ("episode 1", "episode 2")))
    summary = summary_of(adapter, episodes=8)
    assert (summary.ranking.conclusion, summary.ranking.interval) == ("inconclusive", "")
    assert summary.ranking.reference == "(chance 50 %; 2 episodes are too few for a conclusion)"
    assert summary.sensitivity.conclusion == "yes"
    assert summary.sentence == "Inconclusive: better action ranking. Measure more clips, with --ranking-clips."
    summary = replace(summary, prediction=replace(summary.prediction, conclusion="inconclusive"))
    sentence = "Inconclusive: better prediction, better action ranking. Measure more clips, with --ranking-clips."
    assert summary.sentence == sentence


def with_spread(result: ModelResult, spread: float) -> ModelResult:
    estimates = (Estimate(spread, spread, spread),) * HORIZON
    distribution = LatentDistribution(estimates, estimates, 0.5, (spread,) * HORIZON, (1.0,) * HORIZON)
    return replace(result, distribution=distribution)


@pytest.mark.parametrize("with_base", [True, False])
@pytest.mark.parametrize("level", [0.5, 0.995, 1.2])
@pytest.mark.parametrize("spread", [0.5, 0.895, 0.9, 0.95, 1.1])
def test_blur_is_reported_only_if_error_and_spread_both_decrease(with_base: bool, level: float, spread: float) -> None:
    adapter = with_spread(model("adapter", level, noise=0.0), spread)
    base_model = [with_spread(model("base", 1.0, noise=0.0), 0.9)] * with_base
    summary = summary_of(*base_model, adapter, copies=adapter.distribution)
    reference, name = (0.9, "base model") if with_base else (1.0, "true latents")
    has_decreased = level < 0.99 and spread < 0.99 * reference
    remark = f"(part of the gain may be blur: spread {spread:.2f}, {name} {reference:.2f})"
    assert summary.prediction.reference == (remark if has_decreased else "")
    without_spread = with_spread(model("adapter", level, noise=0.0), math.nan)
    assert not summary_of(*base_model, without_spread, copies=adapter.distribution).prediction.reference


def with_landscape(result: ModelResult, distance: float, sharpness: float, episodes: int = 8) -> ModelResult:
    """Return a model with landscapes of a sharpness, and of a mean distance that differs slightly between clips."""
    rng, ids = np.random.default_rng(0), [f"episode {number}" for number in range(episodes)]
    distances = distance + rng.uniform(-0.5, 0.5, episodes)
    energy = np.full((2, 2, 2), 1.0)
    energy[0, 0, 0], energy[1, 1, 1] = 1 - sharpness / 2, 1 + sharpness / 2
    maps = tuple(
        Landscape(name, 0, np.zeros((3, 2)), energy, np.zeros(3), np.array([offset, 0.0, 0.0]))
        for name, offset in zip(ids, distances, strict=True)
    )
    return replace(result, landscapes=Landscapes(("dx", "dy", "dz"), "cm", maps, 25.0))


@pytest.mark.parametrize(
    ("base", "adapter", "conclusion"),
    [
        ((13.8, 0.072), (20.3, 0.0086), "no"),  # measured with a released model and its adapter
        ((20.3, 0.0086), (13.8, 0.072), "yes"),
        ((30.0, 0.07), (27.0, 0.07), "no"),  # better than the base model, and worse than a random grid point
        (None, (13.8, 0.072), "yes"),
        (None, (27.0, 0.072), "no"),
    ],
)
def test_a_better_landscape_needs_a_nearer_minimum_than_the_base_model_and_a_random_point(
    base: tuple[float, float] | None, adapter: tuple[float, float], conclusion: str
) -> None:
    base_model = [] if base is None else [with_landscape(model("base", 1.0), *base)]
    summary = summary_of(*base_model, with_landscape(model("adapter", 0.7, shuffled=0.9), *adapter))
    verdict = summary.landscape
    assert verdict is not None
    assert summary.verdicts[3] == verdict
    assert (verdict.conclusion, verdict.unit, verdict.baseline) == (conclusion, "cm", 25.0)
    assert verdict.value == pytest.approx(adapter[0], abs=0.5)
    single_episode = summary_of(with_landscape(model("adapter", 0.7), *adapter, episodes=1)).landscape
    assert single_episode is not None
    assert single_episode.conclusion == "inconclusive"
    assert single_episode.reference.endswith("; 1 episode is too few for a conclusion)")


def test_predictions_that_are_not_finite_have_no_conclusion() -> None:
    adapter = model("adapter", 1.0)
    broken = {
        actions: math.nan * values for actions, values in adapter.errors.arrays.items() if actions[0] != "persistence"
    }
    adapter = replace(adapter, errors=replace(adapter.errors, arrays=adapter.errors.arrays | broken))
    summary = summary_of(model("base", 1.0), adapter)
    assert (summary.prediction.conclusion, summary.prediction.value) == ("not measured", None)
    assert "nan" not in str(summary)


@pytest.mark.parametrize("distance", [10.0, 20.3])
def test_sentence_mentions_a_landscape_that_is_not_better(distance: float) -> None:
    base = with_landscape(ranked("base", 1.0, 0.05), 13.8, 0.072)
    sentence = summary_of(base, with_landscape(ranked("adapter", 0.7, 0.02, shuffled=0.9), distance, 0.0086)).sentence
    assert sentence.startswith("Better prediction than the base model")
    denied = "But the energy minimum is not nearer to the true action than that of the base model."
    assert sentence.endswith(denied) == (distance > 13.8)
    assert len(sentence.split()) <= 40


def errors_by_metric(l1: float, l2: float, *, noise: float = 0.02) -> dict[Metric, np.ndarray]:
    """Return errors whose levels relative to persistence differ between L1 and L2."""
    return {L1: errors(l1, noise), L2: errors(l2, noise)}


def with_errors(measured: Evaluation, name: str, true: dict[Metric, np.ndarray]) -> Evaluation:
    errors = measured.models[name].errors
    changes = {(actions, mode, metric.name): values for metric, values in true.items()
             for actions, mode in (("true", "teacher_forced"), ("true", "rollout"))}  # fmt: skip
    changed = replace(measured.models[name], errors=replace(errors, arrays={**errors.arrays, **changes}))
    return replace(measured, models={**measured.models, name: changed})


def test_metric_that_contradicts_l1_is_reported() -> None:
    agreed = evaluation(model("base", 0.95), model("adapter", 0.8))
    assert not summarize(agreed, make_rows(agreed)).prediction.reference
    denied = with_errors(agreed, "adapter", errors_by_metric(0.8, 1.25))
    assert re.fullmatch(r"\(by L2 32 % worse \[\d+, \d+\]\)", summarize(denied, make_rows(denied)).prediction.reference)


@pytest.mark.parametrize(
    ("solved", "problems", "oracle", "conclusion", "needs"),
    [
        (45, 50, 50, "yes", ""),
        (2, 50, 50, "no", ""),
        (5, 50, 50, "inconclusive", ""),
        (45, 50, 3, "inconclusive", "The oracle solves only 6.0 % of these problems"),
        (1, 1, 1, "inconclusive", "1 problem is too few for a conclusion"),
        (2, 2, 2, "inconclusive", "2 problems are too few for a conclusion"),
    ],
)
def test_better_planning_needs_a_higher_success_rate_than_policies_without_images(
    solved: int, problems: int, oracle: int, conclusion: str, needs: str
) -> None:
    counts = {"adapter": solved, "zero action": 0, "random": min(2, problems - 1), "oracle": oracle}
    rates = {name: estimate_share(count, problems) for name, count in counts.items()}
    planning = closed_loop_verdict(rates, "adapter", "oracle", problems, "reach")
    assert planning.conclusion == conclusion
    assert planning.needs.startswith(needs)
    assert bool(planning.needs) == bool(needs)
    assert planning.statement.endswith(f"on {problems} reach problem{'s' * (problems > 1)}")


def test_measured_planning_removes_the_consequence_for_planning() -> None:
    summary = summary_of(model("adapter", 0.5))
    assert summary.sentence.endswith("ignores the actions, so the model cannot be used for planning.")
    measured = replace(summary, planning=closed_loop_verdict(RATES, "adapter", "oracle", 50, "reach"))
    assert measured.sentence == "The model predicts typical motion and ignores the actions."


@pytest.mark.parametrize("episodes", [1, 8])
@pytest.mark.parametrize("with_base", [True, False])
@pytest.mark.parametrize(
    ("level", "shuffled", "rank", "distance"), [(2.7, 0.6, 0.02, 1.0), (0.6, 0.9, 0.7, 12.3), (0.6, 4.0, 0.1, 123.4)]
)
def test_summary_fits_a_screen_and_has_complete_sentences(
    episodes: int, with_base: bool, level: float, shuffled: float, rank: float, distance: float
) -> None:
    models = [ranked("base", 1.0, 0.05)] * with_base + [ranked("adapter", level, rank, shuffled=shuffled, noise=0.1)]
    models = [with_spread(result, 0.9 if result.role == "base" else 0.8) for result in models]
    measured = evaluation(*(with_landscape(result, distance, 0.0086, episodes) for result in models), episodes=episodes)
    subject = f"runs/{'a-kitchen-with-a-name-that-is-long-enough-to-wrap-' * 2}"
    measured = replace(measured, about=replace(measured.about, subject=subject), copies=models[0].distribution)
    measured = with_errors(measured, "adapter", errors_by_metric(level, abs(2 - level)))
    summary = summarize(measured, make_rows(measured))
    lines = str(summary).splitlines()
    assert len(lines) <= 18, "three lines are the long name and the clips"
    assert max(map(len, lines)) <= 90
    assert lines[2] == f"24 clips, {episodes} held-out episode{'s' * (episodes > 1)}"
    assert len(summary.sentence.split()) <= 40
    assert re.fullmatch(r"[A-Z0-9].*\.", summary.sentence)
    assert not any(re.match(r" *(%|cm|s)( |$)", line) for line in lines), "a unit without its number"
    assert "-0.0" not in str(summary).replace("-0.0086", "")
    assert "nan" not in str(summary)
