"""The summary of an evaluation: verdicts on prediction, use of the actions, action ranking or planning, and landscape.

A verdict is yes, no, inconclusive or not measured. It names what was measured, with one number and its 95 % interval
over episodes. PyTorch is not imported.
"""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from vjepa2_ac.evaluation.estimates import over_persistence
from vjepa2_ac.evaluation.result import L1, Evaluation, Row
from vjepa2_ac.intervals import ENOUGH_EPISODES, Estimate

Conclusion = Literal["yes", "no", "inconclusive", "not measured"]

SAME_ERROR = 0.01  # relative; errors this close count as equal, whatever their interval
SAME_RANK = 0.005  # absolute; likewise for action-ranking errors
CHANCE = 0.5  # action-ranking error of a model that ignores its actions
CLOSED_LOOP_FILE = "closed_loop.json"  # in RUN/closed_loop/TASK-DOMAIN
BASE, PERSISTENCE, ZERO_ACTION = "the base model", "persistence", "the zero action"  # what a verdict compares with
_COLUMNS = 80
_IGNORES_ACTIONS = "it predicts typical motion and ignores the actions"


@dataclass(frozen=True)
class Verdict:
    """One line of the summary."""

    name: str
    conclusion: Conclusion
    statement: str  # what was measured, with one number
    value: float | None = None  # this number; None: not measured
    low: float | None = None  # 95 % interval over episodes; None: there is none
    high: float | None = None
    unit: Literal["%", "cm", ""] = "%"  # of the number: % shows a fraction
    reference: str = ""  # numbers to compare with
    leaning: Literal["yes", "no", ""] = ""  # the conclusion that the number alone, without its interval, would give
    needs: str = ""  # a sentence: why there is no conclusion, and what it needs
    baseline: float = 0.0  # value of a model that has learned nothing, or of the best competitor

    @property
    def interval(self) -> str:
        """The interval as text, with as many digits as the number; empty without an interval."""
        if self.value is None or self.low is None or self.high is None:
            return ""
        if self.unit == "%":
            return interval_of(Estimate(self.value, self.low, self.high))
        return f"[{self.low:.1f}, {self.high:.1f}]"


@dataclass(frozen=True)
class Summary:
    """The verdicts on a run or a model."""

    subject: str  # with its checkpoint, as text
    measured: str  # number of clips and episodes, or the problems of a closed loop
    compared_with: str  # BASE, PERSISTENCE or ZERO_ACTION
    predicts: Verdict
    uses_actions: Verdict
    ranks_actions: Verdict
    plans: Verdict | None = None  # None: there is no closed loop of this checkpoint
    landscape: Verdict | None = None  # None: no energy landscapes were measured

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """The lines of the summary: the third one is action ranking until a closed loop has measured planning."""
        third = self.ranks_actions if self.plans is None else self.plans
        return self.predicts, self.uses_actions, third, *(() if self.landscape is None else (self.landscape,))

    @property
    def sentence(self) -> str:
        """The verdicts in words, at most 40 of them."""
        if needs := next((verdict.needs for verdict in self.verdicts if verdict.needs), ""):
            return needs
        third = "planning" if self.plans else "action ranking"
        claims = {"prediction": self.predicts, "the use of the actions": self.uses_actions, third: self.verdicts[2]}
        missing = [name for name, verdict in claims.items() if verdict.conclusion == "not measured"]
        unclear = [name for name, verdict in claims.items() if verdict.conclusion == "inconclusive"]
        if self.predicts.conclusion == "no":
            return f"Prediction is not better than with {self.compared_with}. Check data, axes and stride first."
        if self.uses_actions.conclusion == "no":
            return f"{_IGNORES_ACTIONS.capitalize()}, so it cannot be used for planning."
        if self.verdicts[2].conclusion == "no":
            return f"{third.capitalize()} is not better than with {self._competitor}."
        if unclear:
            return f"Inconclusive: {' and '.join(unclear)}. Measure more held-out episodes or more problems."
        if missing:
            return f"Not measured: {' and '.join(missing)}."
        better = f"Better prediction than with {self.compared_with}, sensitive to the actions"
        if self.plans is None:
            return f"{better}, better action ranking. Planning was not measured."
        return f"{better}, and it solves more problems than {self._competitor}."

    @property
    def _competitor(self) -> str:
        """What the third verdict compares with."""
        if self.plans is not None:
            return "the zero action and random actions"
        return "chance" if self.compared_with == PERSISTENCE else self.compared_with

    def __str__(self) -> str:
        gap = _COLUMNS - len(self.subject) - len(self.measured)
        lines = [f"{self.subject}{' ' * gap if gap > 1 else chr(10)}{self.measured}"]
        width = max(len(verdict.conclusion) for verdict in self.verdicts)
        for verdict in self.verdicts:
            label = f"  {verdict.name:<13}  {verdict.conclusion:<{width}}  "
            room = _COLUMNS - len(label) - len(verdict.interval) - 1
            statement, *more = textwrap.wrap(f"{verdict.statement} {verdict.reference}", room)
            lines.append(f"{label}{statement:<{room}} {verdict.interval}".rstrip())
            lines += (" " * len(label) + text for text in more)
        return "\n".join([*lines, *textwrap.wrap(self.sentence, _COLUMNS)])


def summarize(evaluation: Evaluation, rows: Sequence[Row]) -> Summary:
    """Return the summary of an evaluation from its rows (`rows.rows_of`)."""
    clips, base = evaluation.clips, evaluation.base
    trained_rows = {row.key: row for row in rows if row.model == evaluation.trained}
    base_rows = {row.key: row for row in rows if row.model == base}
    summary = Summary(
        subject=evaluation.title,
        measured=f"{len(clips)} clips, {clips.episodes} held-out episode{'s' * (clips.episodes != 1)}",
        compared_with=PERSISTENCE if base is None else BASE,
        predicts=_predicts(trained_rows, base_rows, evaluation.horizon, f"{evaluation.seconds_ahead:.1f} s ahead"),
        uses_actions=_uses_actions(trained_rows),
        ranks_actions=_ranks_actions(trained_rows, base_rows),
        landscape=_landscape(trained_rows, base_rows),
    )
    return summary if clips.episodes >= ENOUGH_EPISODES else _too_few(summary, clips.episodes)


def _too_few(summary: Summary, episodes: int) -> Summary:
    """Return a summary without conclusions, which states what the numbers alone show."""
    shown = summary.predicts.statement
    if summary.predicts.leaning == "yes" and summary.uses_actions.leaning == "no":
        shown += f"; {_IGNORES_ACTIONS}"
    few = f"{episodes} held-out episode{'s are' if episodes > 1 else ' is'} too few for a conclusion"
    needs = f"{few}; at least {ENOUGH_EPISODES} are needed. So far: {shown}."

    def without_conclusion(verdict: Verdict) -> Verdict:
        conclusion: Conclusion = "inconclusive" if verdict.value is not None else "not measured"
        return replace(verdict, conclusion=conclusion, low=None, high=None, needs=needs)

    return replace(
        summary,
        predicts=without_conclusion(summary.predicts),
        uses_actions=without_conclusion(summary.uses_actions),
        ranks_actions=without_conclusion(summary.ranks_actions),
        landscape=None if summary.landscape is None else without_conclusion(summary.landscape),
    )


def not_measured(name: str, how: str) -> Verdict:
    """Return the verdict on what was not measured, with what measures it."""
    return Verdict(name, "not measured", f"measured by {how}")


def with_closed_loop(summary: Summary, run: Path, checkpoint: str) -> Summary:
    """Return a summary whose planning verdict is that of the run's newest closed loop of this checkpoint, if any."""
    files = sorted(run.glob(f"closed_loop/*/{CLOSED_LOOP_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in files:
        written = json.loads(file.read_bytes())
        if written["about"]["checkpoint"] == checkpoint and "verdict" in written:
            return replace(summary, plans=Verdict(**written["verdict"]))
    return summary


def spread_of_errors(evaluations: Sequence[Evaluation]) -> str:
    """Return as text how much the errors of several runs differ, at the longest horizon."""
    errors = [over_persistence(one.errors, "rollout")[-1].value for one in evaluations]
    mean = f"{np.mean(errors):.3f} (range {min(errors):.3f} to {max(errors):.3f})"
    return f"{len(evaluations)} runs: mean error relative to persistence {mean}"


def percent(share: float) -> str:
    """Return a share in percent, with a digit more below 10."""
    return f"{100 * share:.0f}" if abs(share) >= 0.0995 else f"{100 * share:.1f}"


def interval_of(share: Estimate) -> str:
    """Return the interval of a share in percent, with as many digits as the share; empty without an interval."""
    form = ".0f" if abs(share.value) >= 0.0995 else ".1f"
    return f"[{100 * share.low:{form}}, {100 * share.high:{form}}]" if share.has_interval else ""


def conclusion_of(gain: Estimate, same: float) -> Conclusion:
    """Return yes or no if the interval of a gain lies on one side of 0 or within `same` of 0, else inconclusive."""
    if max(abs(gain.low), abs(gain.high)) < same:
        return "no"
    conclusions: dict[int, Conclusion] = {-1: "no", 0: "inconclusive", 1: "yes"}
    return conclusions[gain.side(of=0.0)]


def _verdict(name: str, conclusion: Conclusion, statement: str, estimate: Estimate) -> Verdict:
    low, high = (estimate.low, estimate.high) if estimate.has_interval else (None, None)
    return Verdict(name, conclusion, statement, estimate.value, low, high)


def _predicts(rows: Mapping[str, Row], base_rows: Mapping[str, Row], horizon: int, ahead: str) -> Verdict:
    """Conclude from the L1 error of the longest rollout: yes needs less than the base model's and than persistence's.

    The reference names a falling spread (smoother predictions also have a lower error), and other metrics that
    disagree.
    """
    error = rows[f"rollout.{L1.name}.over_persistence.{horizon}"].estimate
    against_persistence = _verdict_on_gain(error.below(1.0), PERSISTENCE, ahead)
    gain = rows.get(f"rollout.{L1.name}.gain_over_base.{horizon}")
    blur = _blur(rows, base_rows, horizon)
    if gain is None:
        is_lower = against_persistence.leaning == "yes"
        return replace(against_persistence, reference=f"({blur})" if blur and is_lower else "")
    verdict = _verdict_on_gain(gain.estimate, BASE, ahead)
    if verdict.conclusion == "yes" and against_persistence.conclusion != "yes":
        return replace(against_persistence, reference=f"({verdict.statement} {verdict.interval})")
    remarks = [
        f"by {name} {_lower(row.estimate)}"
        for name in dict.fromkeys(key.split(".")[1] for key in rows if key.startswith("rollout."))
        if (row := rows.get(f"rollout.{name}.gain_over_base.{horizon}"))
        and row.estimate.side(of=0.0) != gain.estimate.side(of=0.0)
    ]
    remarks += [blur] * (bool(blur) and verdict.leaning == "yes")
    return replace(verdict, reference=f"({'; '.join(remarks)})" if remarks else "")


def _blur(rows: Mapping[str, Row], base_rows: Mapping[str, Row], horizon: int) -> str:
    """Return a remark if the predictions vary less than the base model's, or without one less than the truth."""
    key = f"spread.{horizon}"
    if key not in rows or math.isnan(rows[key].value):
        return ""
    spread, before = rows[key].value, base_rows[key].value if key in base_rows else 1.0
    if spread >= before * (1 - SAME_ERROR):
        return ""
    whose = "base model" if key in base_rows else "true latents"
    return f"part of the gain may be blur: spread {spread:.2f}, {whose} {before:.2f}"


def _verdict_on_gain(gain: Estimate, compared_with: str, ahead: str) -> Verdict:
    leaning: Literal["yes", "no"] = "yes" if gain.value > SAME_ERROR else "no"
    statement = f"error {_lower(gain)} than with {compared_with}, {ahead}"
    return replace(_verdict("predicts", conclusion_of(gain, SAME_ERROR), statement, gain), leaning=leaning)


def _lower(gain: Estimate) -> str:
    return f"{percent(abs(gain.value))} % {'lower' if gain.value >= 0 else 'higher'}"


def _uses_actions(rows: Mapping[str, Row]) -> Verdict:
    """Conclude from the one-step error with shuffled actions; yes also needs an action-ranking error below chance."""
    cost, gap = (rows[f"{name}.shuffled"].estimate for name in ("cost_of_actions", "gap_of_actions"))
    leaning: Literal["yes", "no"] = "yes" if gap.value > SAME_ERROR else "no"
    conclusion, reference = conclusion_of(gap, SAME_ERROR), ""
    if "ranking.rank" in rows and conclusion == "yes" and (rank := rows["ranking.rank"].estimate).side(CHANCE) != -1:
        conclusion = "no" if rank.side(CHANCE) == 1 else "inconclusive"
        reference = f"(but action-ranking error {percent(rank.value)} %, chance 50 %)"
    change = "higher" if cost.value >= 0 else "lower"
    statement = f"one-step error {percent(abs(cost.value))} % {change} with shuffled actions"
    return replace(_verdict("uses actions", conclusion, statement, cost), reference=reference, leaning=leaning)


def _ranks_actions(rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict:
    """Conclude from the action-ranking error: yes needs less than the base model's and less than chance."""
    key = "ranking.rank"
    if key not in rows:
        return not_measured("ranks actions", "evaluate --sensitivity-clips 32")
    rank = rows[key].estimate
    statement = f"action-ranking error {percent(rank.value)} %"
    conclusion, reference = conclusion_of(rank.below(CHANCE), SAME_RANK), "chance 50 %"
    if (difference := rows.get("ranking.difference_to_base")) is not None:
        if conclusion == "yes":
            conclusion = conclusion_of(difference.estimate.below(0.0), SAME_RANK)
        reference = f"base model {percent(base_rows[key].value)} %, {reference}"
    verdict = _verdict("ranks actions", conclusion, statement, rank)
    return replace(verdict, reference=f"({reference})", baseline=CHANCE)


def _landscape(rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict | None:
    """Conclude from the distance of the energy minimum to the true action: yes needs less than the base model's.

    Without a base model it needs less than that of a random grid point. None: no landscapes were measured.
    """
    key, sharpness = "landscapes.distance", "landscapes.sharpness"
    if key not in rows:
        return None
    distance, chance = rows[key].estimate, rows[key].chance or 0.0
    unit = " cm" if rows[key].unit == "cm" else ""
    conclusion = conclusion_of(distance.below(chance), 0.0)
    compared = [f"random point {chance:.1f}{unit}", f"sharpness {rows[sharpness].value:.3f}"]
    if (difference := rows.get("landscapes.difference_to_base")) is not None:
        if conclusion == "yes":
            conclusion = conclusion_of(difference.estimate.below(0.0), 0.0)
        compared = [f"base model {base_rows[key].value:.1f}{unit}", *compared]
        compared[-1] += f", base model {base_rows[sharpness].value:.3f}"
    statement = f"energy minimum {distance.value:.1f}{unit} from the true action"
    verdict = _verdict("landscape", conclusion, statement, distance)
    return replace(verdict, reference=f"({'; '.join(compared)})", baseline=chance, unit="cm" if unit else "")


def closed_loop(shares: Mapping[str, Estimate], model: str, oracle: str, problems: int, task: str) -> Verdict:
    """Conclude from the share of problems solved in closed loop: yes needs more than every other policy but the oracle.

    Args:
        shares: Share of solved problems by policy: the model's, the oracle's, and those of its competitors.
        model: Name of its policy.
        oracle: That of the oracle. If it fails, or with fewer than five problems, there is no conclusion.
        problems: Their number.
        task: Name of the task.
    """
    share, reference = shares[model], shares[oracle]
    best = max((one for name, one in shares.items() if name not in {model, oracle}), key=lambda one: one.value)
    conclusion: Conclusion = "yes" if share.low > best.high else "no" if share.value <= best.value else "inconclusive"
    needs = ""
    if reference.value < CHANCE:
        solved = f"The oracle solves only {percent(reference.value)} % of these problems"
        needs = f"{solved}, so they cannot be used for comparison."
    elif problems < ENOUGH_EPISODES:
        needs = f"{problems} problem{'s are' if problems > 1 else ' is'} too few for a conclusion; use --episodes 50."
    others = ", ".join(f"{name} {100 * one.value:.0f} %" for name, one in shares.items() if name != model)
    statement = f"solves {100 * share.value:.0f} % of {problems} {task} problem{'s' * (problems != 1)}"
    verdict = _verdict("plans", "inconclusive" if needs else conclusion, statement, share)
    return replace(verdict, reference=f"({others})", needs=needs, baseline=best.value)
