"""The answer agrees with the numbers, and knows what it cannot know."""

import json
from dataclasses import asdict, replace
from pathlib import Path

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
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.evaluation.summary import closed_loop, not_measured, with_closed_loop
from vjepa2_ac.intervals import share_of
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
    )


def asked(*models: ModelResult, episodes: int = 8) -> Answer:
    found = evaluation(*models, episodes=episodes)
    return summarize(found, rows_of(found))


@pytest.mark.parametrize(
    ("base", "adapter", "noise", "word", "says"),
    [
        (1.0, 0.75, 0.02, "yes", "error 25 % lower than the base's, 1.5 s ahead"),
        (0.8, 1.2, 0.0, "no", "error 50 % higher than the base's, 1.5 s ahead"),
        (1.0, 0.998, 0.0, "no", "error 0.2 % lower than the base's, 1.5 s ahead"),
        (1.0, 1.0, 0.0, "no", "error 0.0 % lower than the base's, 1.5 s ahead"),
        (1.0, 0.98, 0.3, "not known yet", "than the base's"),
        (1.6, 1.2, 0.0, "no", "error 20 % higher than doing nothing's, 1.5 s ahead"),
        (None, 0.5, 0.02, "yes", "error 50 % lower than doing nothing's, 1.5 s ahead"),
    ],
)
def test_it_predicts_better_where_it_clearly_beats_the_base_and_doing_nothing(
    base: float | None, adapter: float, noise: float, word: str, says: str
) -> None:
    of_base = [] if base is None else [model("base", base, noise=noise)]
    found = asked(*of_base, model("adapter", adapter, noise=noise))
    assert (found.predicts.word, says in found.predicts.says) == (word, True)
    assert found.rival == ("doing nothing" if base is None else "the base")


def ranked(name: str, level: float, rank: float, **how: float) -> ModelResult:
    """Return a model of an error and a share of moves that look better; the shares differ a little by clip."""
    ids = tuple(f"episode {clip % 8}" for clip in range(CLIPS))
    return replace(model(name, level, **how), ranking=ranking_of(rank + 0.01 * np.sin(np.arange(CLIPS)), ids))


@pytest.mark.parametrize(("rank", "word"), [(0.02, "yes"), (0.05, "no"), (0.1, "no")])
def test_it_plans_better_where_fewer_other_moves_look_better_than_with_the_base(rank: float, word: str) -> None:
    found = asked(ranked("base", 1.0, 0.05), ranked("adapter", 0.7, rank, shuffled=0.9))
    assert (found.plans.word, found.plans.beside) == (word, "(base 5.0 %, chance 50 %)")
    assert found.plans.says.endswith(" % of other moves look better than the true one")
    assert found.plans.share == pytest.approx(rank, abs=0.002)
    assert (found.sentence == "It predicts better than the base, but it does not plan better.") == (word == "no")
    assert asked(ranked("model", 0.7, rank)).plans.word == "yes", "better than chance, where there is no base"
    assert asked(ranked("model", 0.7, 0.6)).plans.word == "no"
    assert asked(model("model", 0.7)).plans == not_measured("plans")


def test_actions_are_used_only_where_wrong_ones_cost_something() -> None:
    deaf, listening = asked(model("model", 0.5)), asked(model("model", 0.5, shuffled=0.9))
    assert (deaf.uses_actions.conclusion, listening.uses_actions.conclusion) == ("no", "yes")
    assert deaf.sentence.startswith("It learned the scene, not the arm")
    assert listening.uses_actions.says == "a wrong action costs 81 %"


@pytest.mark.parametrize("episodes", [1, 4])
def test_of_too_few_episodes_nothing_is_known_but_what_shows_is_said(episodes: int) -> None:
    found = asked(*(model(*one, episodes=episodes) for one in (("base", 1.0), ("adapter", 0.5))), episodes=episodes)
    assert {one.word for one in found.questions} == {"not known yet"}
    assert f"{episodes} held-out episode" in found.sentence
    assert "5 would do" in found.sentence
    assert "error 50 % lower" in found.sentence
    assert "learned the scene, not the arm" in found.sentence
    assert "[" not in str(found), "no interval that means nothing"


def by(l1: float, others: float, *, noise: float = 0.02) -> dict[Metric, np.ndarray]:
    """Return errors for which L1 differs from L2 relative to persistence."""
    return {L1: errors(l1, noise), L2: errors(others, noise)}


def with_errors(found: Evaluation, name: str, true: dict[Metric, np.ndarray]) -> Evaluation:
    before = found.models[name].errors
    given = {(way, mode, metric.name): values for metric, values in true.items()
             for way, mode in (("true", "teacher_forced"), ("true", "rollout"))}  # fmt: skip
    changed = replace(found.models[name], errors=replace(before, arrays={**before.arrays, **given}))
    return replace(found, models={**found.models, name: changed})


def test_it_is_said_where_l2_contradicts_l1() -> None:
    found = evaluation(model("base", 0.95), model("adapter", 0.8))
    assert not summarize(found, rows_of(found)).predicts.reference
    denied = with_errors(found, "adapter", by(0.8, 1.25))
    assert summarize(denied, rows_of(denied)).predicts.reference == "(by l2 32 % higher)"


@pytest.mark.parametrize(
    ("solved", "problems", "oracle", "word", "why"),
    [
        (45, 50, 50, "yes", ""),
        (2, 50, 50, "no", ""),
        (5, 50, 50, "not known yet", ""),
        (45, 50, 3, "not known yet", "The oracle itself solves 6.0 %"),
        (1, 1, 1, "not known yet", "1 episode of reach cannot show anything"),
    ],
)
def test_a_closed_loop_is_held_against_chance_and_knows_when_it_shows_nothing(
    solved: int, problems: int, oracle: int, word: str, why: str
) -> None:
    counts = {"adapter": solved, "do nothing": 0, "random": min(2, problems - 1), "oracle": oracle}
    shares = {name: share_of(count, problems) for name, count in counts.items()}
    found = closed_loop(shares, "adapter", "oracle", problems, "reach")
    assert (found.word, found.why.startswith(why), bool(found.why)) == (word, True, bool(why))
    assert f"of {problems} problems of reach" in found.says


def test_a_closed_loop_of_the_same_checkpoint_answers_for_the_plans(tmp_path: Path) -> None:
    found = asked(model("model", 0.5))
    shares = {name: share_of(count, 50) for name, count in {"m": 45, "random": 2, "oracle": 50}.items()}
    measured = closed_loop(shares, "m", "oracle", 50, "reach")
    (tmp_path / "closed_loop" / "reach-B").mkdir(parents=True)
    file = tmp_path / "closed_loop" / "reach-B" / "closed_loop.json"
    file.write_text(json.dumps({"about": {"checkpoint": "step 8"}, "plans": asdict(measured)}))
    assert with_closed_loop(found, tmp_path, "step 8").plans == measured
    assert with_closed_loop(found, tmp_path, "step 9") == with_closed_loop(found, tmp_path / "no", "step 8") == found


@pytest.mark.parametrize("episodes", [1, 8])
@pytest.mark.parametrize("others", [0.6, 0.9])
@pytest.mark.parametrize("rank", [0.02, 0.1])
def test_an_answer_fits_a_screen_whatever_it_is(episodes: int, others: float, rank: float) -> None:
    pair = ranked("base", 1.0, 0.05), ranked("adapter", 0.6, rank, shuffled=others)
    found = evaluation(*pair, episodes=episodes)
    found = replace(found, about=replace(found.about, subject="runs/a-kitchen-with-a-name-that-is-long-enough-to-wrap"))
    text = summarize(found, rows_of(found))
    lines = str(text).splitlines()
    assert len(lines) <= 12
    assert max(map(len, lines)) <= 80
    assert len(text.sentence.split()) <= 40
