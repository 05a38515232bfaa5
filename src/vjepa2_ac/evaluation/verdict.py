"""The verdict as text: did training help, how certain is that, and are the actions used?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjepa2_ac.evaluation.action_score import differences_of, metrics_of
from vjepa2_ac.evaluation.estimates import (
    gain_over,
    gap_of_actions,
    one_step_over_persistence,
    over_persistence,
    rank_difference,
)
from vjepa2_ac.evaluation.request import BEST_SCORE, STEPS
from vjepa2_ac.evaluation.result import L1, Evaluation, Metric
from vjepa2_ac.intervals import Estimate

_SIDES = {1: "better", 0: "no clear difference", -1: "NOT better"}  # of an error over persistence
_PLANS = {-1: "better to plan with", 0: "no clear difference", 1: "WORSE to plan with"}  # of a difference of ranks
_NEARER = {-1: "nearer than", 0: "no clear difference to", 1: "FARTHER than"}  # of a difference


def verdict(evaluation: Evaluation) -> str:
    """Return whether training helped, at the longest horizon by L1, and where other metrics disagree."""
    error = over_persistence(evaluation.errors, "rollout")[-1]
    ahead = f"{evaluation.seconds_ahead:.1f} s ahead"
    absolute = f"Its error {ahead} is {_over_nothing(error, L1)}."
    parts = [f"{_compared(evaluation, ahead)}.", absolute, *_disagreements(evaluation)]
    parts += [_ranking(evaluation), _actions(evaluation)]
    return " ".join(part for part in (*parts, _planned(evaluation), *evaluation.notes) if part)


def improvement(evaluation: Evaluation) -> Estimate | None:
    """Return the share by which the trained error is below the base's at the last horizon, paired; None: no base."""
    base = evaluation.base_errors
    return None if base is None else gain_over(evaluation.errors, base)[-1]


def uses_actions(evaluation: Evaluation) -> bool:
    """Return whether the true actions are clearly better than another clip's, and clearly rank first by energy."""
    sensitivity = evaluation.models[evaluation.trained].sensitivity
    rankings = () if sensitivity is None else sensitivity.rankings
    gap = gap_of_actions(evaluation.errors, "shuffled")
    return gap.side(of=0.0) == 1 and all(ranking.mean_rank.side(of=0.5) == -1 for ranking in rankings)


def spread(evaluations: Sequence[Evaluation]) -> str:
    """Return as text how much the results of several runs differ, at the longest horizon."""
    errors = [over_persistence(one.errors, "rollout")[-1].value for one in evaluations]
    gains = [gain.value for one in evaluations if (gain := improvement(one)) is not None]
    words = f"{len(evaluations)} runs: error over persistence {_mean_and_range(errors, '.3f')}"
    return words + (f"; better than the base by {_mean_and_range(gains, '.1%')}" if gains else "")


def interval(value: Estimate, form: str) -> str:
    """Return the interval of an estimate as text."""
    if not value.has_interval:
        return "one episode: no interval"
    return f"95 % interval {value.low:{form}} to {value.high:{form}}"


def _compared(evaluation: Evaluation, ahead: str) -> str:
    episodes = evaluation.clips.episodes
    where = f"on {len(evaluation.clips)} clips of {episodes} held-out episode{'s' * (episodes > 1)}"
    gain = improvement(evaluation)
    if gain is None:
        return f"The {evaluation.trained} was measured {where}"
    if gain.value == gain.low == gain.high == 0 or (gain.value == 0 and not gain.has_interval):
        return f"The {evaluation.trained} predicts exactly as the base does, {where}"
    direction, form = "better" if gain.value > 0 else "WORSE", _digits(gain)
    compared = f"{abs(gain.value):{form}} {direction} than the base (gain {interval(gain, form)}), {where}"
    if gain.side(of=0.0) == 0:
        return f"The {evaluation.trained} did not clearly help: it predicts {ahead} {compared}"
    return f"The {evaluation.trained} predicts {ahead} {compared}"


def _digits(gain: Estimate) -> str:
    """Return the number format of a gain: 0 % better or worse would say nothing."""
    return ".0%" if abs(gain.value) >= 0.01 else ".2%"


def _disagreements(evaluation: Evaluation) -> tuple[str, ...]:
    """Return sentences on how other metrics differ from L1: better, worse, or uncertain."""
    found: dict[str, list[str]] = {}
    errors, base = evaluation.errors, evaluation.base_errors
    for metric in evaluation.metrics[1:]:
        words = []
        if base is not None:
            by_l1, by_other = (gain_over(errors, base, metric=each)[-1] for each in (L1, metric))
            if (side := by_other.side(of=0.0)) != by_l1.side(of=0.0):
                form = _digits(by_other)
                share = f"{abs(by_other.value):{form}}"
                how = {-1: f"{share} WORSE than", 0: "no clear difference to", 1: f"{share} better than"}[side]
                words.append(f"{how} the base (gain {interval(by_other, form)})")
        by_l1, by_other = (over_persistence(errors, "rollout", each)[-1] for each in (L1, metric))
        if metric.side(by_other) != L1.side(by_l1):
            words.append(_over_nothing(by_other, metric))
        if words:
            found.setdefault(" and ".join(words), []).append(metric.label)
    return tuple(f"By {' and '.join(metrics)} it is another matter: {words}." for words, metrics in found.items())


def _over_nothing(error: Estimate, metric: Metric) -> str:
    return f"{error.value:.2f} of doing nothing ({interval(error, '.2f')}): {_SIDES[metric.side(error)]}"


def _ranking(evaluation: Evaluation) -> str:
    """Return what the ranking of actions says about planning, and where it disagrees with the error."""
    found = evaluation.models[evaluation.trained].ranking
    base = None if evaluation.base is None else evaluation.models[evaluation.base].ranking
    if found is None:
        return ""
    words = f"For moves as large as plans the true action's mean rank is {found.rank.value:.3f}"
    words += f" ({interval(found.rank, '.3f')}; 0 is best, chance 0.5)"
    if base is None:
        return f"{words}."
    beside, gain = rank_difference(found, base), improvement(evaluation)
    words += f", that of the base {base.rank.value:.3f}: {_PLANS[beside.side(of=0.0)]}"
    if beside.side(of=0.0) == 1 and gain is not None and gain.side(of=0.0) == 1:
        return f"It predicts better, but PLANS WORSE than the base. {words}."
    return f"{words}."


def _actions(evaluation: Evaluation) -> str:
    errors = evaluation.errors
    own, others = (one_step_over_persistence(errors, actions).value for actions in ("true", "shuffled"))
    gap = gap_of_actions(errors, "shuffled")
    words = "It uses the actions" if uses_actions(evaluation) else "It does NOT clearly use the actions"
    words += f": with another clip's its one-step error is {others:.2f} of doing nothing, with its own {own:.2f}"
    words += f" (difference: {interval(gap, '.2f')})"
    if (sensitivity := evaluation.models[evaluation.trained].sensitivity) is None:
        return f"{words}."
    rank = sensitivity.rankings[0].mean_rank
    beside = f"{rank.value:.0%} of other actions fit better than the true one ({interval(rank, '.0%')}; chance 50%)"
    return f"{words}, and {beside}."


def _planned(evaluation: Evaluation) -> str:
    study, plans = evaluation.planning, evaluation.models[evaluation.trained].plans
    if study is None or plans is None:
        return ""
    found, nothing = metrics_of(study, plans), metrics_of(study, study.zero)["missed_cm"].value
    side = _NEARER[found["missed_over_zero"].side(of=1.0)]
    words = f"Its plans of {STEPS} steps end {found['missed_cm'].value:.1f} cm from where the demonstrations do"
    words += f" ({interval(found['missed_cm'], '.1f')}): {side} doing nothing ({nothing:.1f} cm)"
    base = None if evaluation.base is None else evaluation.models[evaluation.base].plans
    if base is not None:
        beside, its = differences_of(study, plans, base)["missed_cm"], metrics_of(study, base)["missed_cm"].value
        words += f", {_NEARER[beside.side(of=0.0)]} the base ({its:.1f} cm)"
    return f"{words}; the Action Score is {found['score'].value:.0f} of {BEST_SCORE:.0f}."


def _mean_and_range(values: list[float], form: str) -> str:
    return f"{np.mean(values):{form}} ({min(values):{form}} to {max(values):{form}})"
