"""The summary of an evaluation: verdicts on prediction, sensitivity to actions, action ranking or planning, landscape.

A verdict is yes, no, inconclusive or not measured. It names what was measured, with one number and its 95 % interval
over episodes. PyTorch is not imported.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Literal

from pydantic import BeforeValidator, TypeAdapter

from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.result import L1, Evaluation
from vjepa2_ac.evaluation.rows import Row
from vjepa2_ac.intervals import MIN_EPISODES, Estimate
from vjepa2_ac.runs.checkpoint import RANKING_TOLERANCE
from vjepa2_ac.storage.paths import CLOSED_LOOP_FILE

Conclusion = Literal["yes", "no", "inconclusive", "not measured"]

SAME_ERROR = 0.01  # relative; errors this close count as equal, whatever their interval
SAME_SUCCESS = 0.1  # absolute; "no" needs an upper bound less than this above the best competitor's success rate
CHANCE = 0.5  # action-ranking error of a model that ignores its actions
_BASE, _PERSISTENCE, _CHANCE = "the base model", "persistence", "chance"  # values of `compared_with`
_TOO_FEW = "too few for a conclusion"
_COLUMNS, _NO_BREAK = 90, "\N{NO-BREAK SPACE}"
_NUMBER = re.compile(r"\d[\d.]*(?: (?:%|cm))?")  # the first one in a statement is the verdict's number
_wrap = partial(wrap, break_on_hyphens=False)  # commands and paths have hyphens


PREDICTION, SENSITIVITY, RANKING = "better prediction", "sensitive to actions", "better action ranking"
PLANNING, LANDSCAPE = "plans better", "better landscape"
_FORMER_NAMES = {  # in files of earlier versions
    "predicts": PREDICTION,
    "uses actions": SENSITIVITY,
    "ranks actions": RANKING,
    "plans": PLANNING,
    "landscape": LANDSCAPE,
}


@dataclass(frozen=True)
class Verdict:
    """One line of the summary."""

    name: Annotated[str, BeforeValidator(lambda name: _FORMER_NAMES.get(name, name))]
    conclusion: Conclusion
    statement: str  # the measurement with one number; a word such as "lower" gives the sign
    value: float | None = None  # this number with its sign; None: not measured
    low: float | None = None  # 95 % interval over episodes; None: there is none
    high: float | None = None
    unit: Literal["%", "cm", ""] = "%"  # unit of the number; with % the value is a fraction
    reference: str = ""  # numbers to compare with
    needs: str = ""  # a sentence: why there is no conclusion, and what is needed for one
    baseline: float = 0.0  # value of an untrained model, or of the best competitor
    # The reference that decided the conclusion, as in "not better than the base model"; earlier versions wrote "with".
    compared_with: Annotated[str, BeforeValidator(lambda text: text.removeprefix("with "))] = ""

    @property
    def interval(self) -> str:
        """The interval as text, rounded and signed like the number in the statement; empty without an interval."""
        if self.value is None or self.low is None or self.high is None:
            return ""
        if self.unit == "%":
            return format_interval(Estimate(self.value, self.low, self.high))
        return f"[{self.low:z.1f}, {self.high:z.1f}]"

    @property
    def statement_with_interval(self) -> str:
        """The statement with the interval directly after its number."""
        number = _NUMBER.search(self.statement)
        if number is None or not self.interval:
            return self.statement
        interval = self.interval.replace(" ", _NO_BREAK)
        return f"{self.statement[: number.end()]}{_NO_BREAK}{interval}{self.statement[number.end() :]}"


@dataclass(frozen=True)
class Summary:
    """The verdicts on a run or a model."""

    subject: str  # with its checkpoint, as text
    measured: str  # number of clips and episodes, or the problems of a closed loop
    predicts: Verdict
    uses_actions: Verdict
    ranks_actions: Verdict
    plans: Verdict | None = None  # None: there is no closed loop of this checkpoint
    landscape: Verdict | None = None  # None: no energy landscapes were measured

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """The lines of the summary. The third is planning if a closed loop measured it, otherwise action ranking."""
        third = self.ranks_actions if self.plans is None else self.plans
        return self.predicts, self.uses_actions, third, *(() if self.landscape is None else (self.landscape,))

    @property
    def sentence(self) -> str:
        """The conclusion from all verdicts in one or two sentences, at most 40 words."""
        first_three = self.verdicts[:3]
        if needs := next((verdict.needs for verdict in first_three if verdict.needs), ""):
            return needs
        for verdict in first_three:
            if verdict.conclusion == "no":
                return self._denial(verdict)
        if unclear := [verdict.name for verdict in first_three if verdict.conclusion == "inconclusive"]:
            more = "problems" if unclear == [PLANNING] else "held-out episodes"
            more = "clips, with --ranking-clips" if _TOO_FEW in self.verdicts[2].reference else more
            return f"Inconclusive: {', '.join(unclear)}. Measure more {more}."
        if missing := [verdict.name for verdict in first_three if verdict.conclusion == "not measured"]:
            return f"Not measured: {', '.join(missing)}."
        better = f"Better prediction than {self.predicts.compared_with}, sensitive to actions"
        if self.plans is not None:
            better += f", and a higher success rate than {self.plans.compared_with}."
        else:
            better += f", better action ranking than {self.ranks_actions.compared_with}. Planning was not measured."
        if self.landscape is None or self.landscape.conclusion != "no":
            return better
        competitor = "a random point" if self.landscape.compared_with == _CHANCE else "that of the base model"
        return f"{better} But the energy minimum is not nearer to the true action than {competitor}."

    @property
    def _unusable(self) -> str:
        """The consequence for planning as a clause; empty if planning was measured."""
        return ", so the model cannot be used for planning" if self.plans is None else ""

    def _denial(self, verdict: Verdict) -> str:
        """Return the sentence about a verdict that is no."""
        if verdict.name == PREDICTION:
            return f"Prediction is not better than {verdict.compared_with}. Check data, axes and stride first."
        if verdict.name == RANKING:
            return f"Action ranking is not better than {verdict.compared_with}."
        if verdict.name == PLANNING:
            return f"The success rate in closed loop is not higher than {verdict.compared_with}."
        if verdict.compared_with == _CHANCE:
            return f"Action ranking is worse than chance{self._unusable}."
        if verdict.high is not None and verdict.high < 0:
            return "The error is lower with shuffled actions than with true ones. Check data, axes and stride first."
        return f"The model predicts typical motion and ignores the actions{self._unusable}."

    @property
    def _explained_brackets(self) -> list[str]:
        """A line that explains the intervals; no line without an interval."""
        intervals = {verdict is self.plans for verdict in self.verdicts if verdict.interval}
        over = " and (success rate) ".join({False: "episodes", True: "problems"}[key] for key in sorted(intervals))
        return [f"  Brackets: 95 % intervals over {over}"] if intervals else []

    def __str__(self) -> str:
        gap = _COLUMNS - len(self.subject) - len(self.measured)
        header = f"{self.subject}{' ' * gap}{self.measured}"
        lines = [header] if gap > 1 else [*_wrap(self.subject, _COLUMNS), self.measured]
        names = max(len(verdict.name) for verdict in self.verdicts)
        width = max(len(verdict.conclusion) for verdict in self.verdicts)
        for verdict in self.verdicts:
            label = f"  {verdict.name:<{names}}  {verdict.conclusion:<{width}}  "
            text = _with_fixed_units(f"{verdict.statement_with_interval} {verdict.reference}")
            first, *rest = _wrap(text, _COLUMNS - len(label))
            lines += (label + first, *(" " * len(label) + line for line in rest))
        lines += self._explained_brackets
        lines += _wrap(_with_fixed_units(self.sentence), _COLUMNS)
        return "\n".join(lines).replace(_NO_BREAK, " ")


def _with_fixed_units(text: str) -> str:
    """Replace the space between a number and its unit by a no-break space."""
    return re.sub(r"(?<=\d) (?=%|cm\b|s\b)", _NO_BREAK, text)


def summarize(evaluation: Evaluation, rows: Sequence[Row]) -> Summary:
    """Return the summary of an evaluation from its rows (`rows.make_rows`)."""
    clips, model = evaluation.clips, evaluation.models[evaluation.trained]
    trained_rows = {row.key: row for row in rows if row.model == evaluation.trained}
    base_rows = {row.key: row for row in rows if row.model == evaluation.base}
    ranked = () if model.ranking is None else model.ranking.episode_ids
    mapped = () if model.landscapes is None else model.landscapes.episode_ids
    landscape = _landscape(trained_rows, base_rows)
    ranks_actions = _require_enough_episodes(_ranks_actions(trained_rows, base_rows), ranked)
    summary = Summary(
        subject=evaluation.title,
        measured=f"{counted(len(clips), 'clip')}, {counted(clips.episodes, 'held-out episode')}",
        predicts=_predicts(evaluation, trained_rows, base_rows),
        uses_actions=_uses_actions(trained_rows, ranks_actions),
        ranks_actions=ranks_actions,
        landscape=None if landscape is None else _require_enough_episodes(landscape, mapped),
    )
    return summary if clips.episodes >= MIN_EPISODES else _too_few(summary, clips.episodes)


def _too_few(summary: Summary, episodes: int) -> Summary:
    """Return a summary without conclusions: it states that there are too few episodes, and the numbers so far."""
    needs = (
        f"{_are_too_few(episodes, 'held-out episode')}; at least {MIN_EPISODES} are needed."
        f" So far: {summary.predicts.statement}; {summary.uses_actions.statement}."
    )
    return replace(
        summary,
        predicts=replace(_without_conclusion(summary.predicts), needs=needs),
        uses_actions=_without_conclusion(summary.uses_actions),
        ranks_actions=_without_conclusion(summary.ranks_actions),
        landscape=None if summary.landscape is None else _without_conclusion(summary.landscape),
    )


def _require_enough_episodes(verdict: Verdict, episode_ids: Sequence[str]) -> Verdict:
    """Return the verdict, without its conclusion if it was measured on too few episodes."""
    episodes = len(set(episode_ids))
    if not 0 < episodes < MIN_EPISODES:
        return verdict
    few = f"{verdict.reference[:-1]}; {_are_too_few(episodes, 'episode')})"
    return replace(_without_conclusion(verdict), reference=few)


def _without_conclusion(verdict: Verdict) -> Verdict:
    conclusion: Conclusion = "inconclusive" if verdict.value is not None else "not measured"
    return replace(verdict, conclusion=conclusion, low=None, high=None)


def _are_too_few(number: int, noun: str) -> str:
    return f"{counted(number, noun)} {'is' if number == 1 else 'are'} {_TOO_FEW}"


def not_measured_verdict(name: str, how: str) -> Verdict:
    """Return a verdict "not measured", with the command that measures it."""
    return Verdict(name, "not measured", f"to measure it, run {how}")


def with_closed_loop(summary: Summary, run: Path, checkpoint: str) -> Summary:
    """Add the planning verdict of the run's newest closed-loop benchmark of this checkpoint, if there is one."""
    files = sorted(run.glob(f"closed_loop/*/{CLOSED_LOOP_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in files:
        written = json.loads(file.read_bytes())
        measured = written["about"]["checkpoint"] or ""  # name of the checkpoint, and how it was selected
        if measured.partition(" ")[0] == checkpoint.partition(" ")[0] and "verdict" in written:
            return replace(summary, plans=TypeAdapter(Verdict).validate_python(written["verdict"]))
    return summary


def format_percent(share: float) -> str:
    """Return a share in percent, with one decimal below 10 %."""
    return f"{100 * share:z.0f}" if abs(share) >= 0.0995 else f"{100 * share:z.1f}"


def format_interval(share: Estimate) -> str:
    """Return the interval of a share in percent; of a negative share, that of its absolute value. Empty without one."""
    form = "z.0f" if abs(share.value) >= 0.0995 else "z.1f"
    low, high = (share.low, share.high) if share.value >= 0 else (-share.high, -share.low)
    return f"[{100 * low:{form}}, {100 * high:{form}}]" if share.has_interval else ""


def draw_conclusion(gain: Estimate, same: float) -> Conclusion:
    """Return yes if the interval of a gain is above 0, no if it is below 0 or within ±`same`, else inconclusive."""
    if max(abs(gain.low), abs(gain.high)) < same:
        return "no"
    conclusions: dict[int, Conclusion] = {-1: "no", 0: "inconclusive", 1: "yes"}
    return conclusions[gain.compare_to(0.0)]


def _verdict(name: str, conclusion: Conclusion, statement: str, estimate: Estimate, compared_with: str) -> Verdict:
    if math.isnan(estimate.value):
        return Verdict(name, "not measured", "the predictions are not finite")
    low, high = (estimate.low, estimate.high) if estimate.has_interval else (None, None)
    return Verdict(name, conclusion, statement, estimate.value, low, high, compared_with=compared_with)


def _predicts(evaluation: Evaluation, rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict:
    """Conclude from the L1 error of the longest rollout: yes if it is below the base model's and below persistence's.

    The verdict's reference mentions a lower spread (smoother predictions also have a lower error), and other metrics
    that disagree.
    """
    horizon, ahead = evaluation.horizon, f"{evaluation.seconds_ahead:.1f} s ahead"
    error = rows[f"rollout.{L1.name}.over_persistence.{horizon}"].estimate
    verdict = against_persistence = _verdict_on_gain(error.subtract_from(1.0), _PERSISTENCE, ahead)
    gain, remarks = rows.get(f"rollout.{L1.name}.gain_over_base.{horizon}"), []
    if gain is not None:
        verdict = _verdict_on_gain(gain.estimate, _BASE, ahead)
        remarks = [
            f"by {metric.label} {_amount(other.estimate, 'better', 'worse')} {format_interval(other.estimate)}".rstrip()
            for metric in evaluation.metrics
            if (other := rows.get(f"rollout.{metric.name}.gain_over_base.{horizon}"))
            and other.estimate.compare_to(0.0) != gain.estimate.compare_to(0.0)
        ]
    error_fell = verdict.value is not None and verdict.value > SAME_ERROR
    if error_fell and (blur := _blur(rows, base_rows, horizon)):
        remarks.append(blur)
    if verdict.conclusion == "yes" and against_persistence.conclusion != "yes":
        remarks.insert(0, f"{verdict.statement} {verdict.interval}")
        verdict = against_persistence
    return replace(verdict, reference=f"({'; '.join(remarks)})" if remarks else "")


def _blur(rows: Mapping[str, Row], base_rows: Mapping[str, Row], horizon: int) -> str:
    """Return a remark if the predictions vary less than the base model's, or less than the true latents if no base."""
    key = f"spread.{horizon}"
    if key not in rows or math.isnan(rows[key].value):
        return ""
    spread, before = rows[key].value, base_rows[key].value if key in base_rows else 1.0
    if spread >= min(before, 1.0) * (1 - SAME_ERROR):  # 1: as varied as the truth
        return ""
    reference = "base model" if key in base_rows else "true latents"
    return f"part of the gain may be blur: spread {spread:.2f}, {reference} {before:.2f}"


def _verdict_on_gain(gain: Estimate, compared_with: str, ahead: str) -> Verdict:
    reference = "the base model's" if compared_with == _BASE else f"that of {compared_with}"
    statement = f"error {_amount(gain, 'lower', 'higher')} than {reference}, {ahead}"
    return _verdict(PREDICTION, draw_conclusion(gain, SAME_ERROR), statement, gain, compared_with)


def _amount(change: Estimate, positive: str, negative: str) -> str:
    """Return a relative change in percent, with one of two words for its sign."""
    return f"{format_percent(abs(change.value))} % {positive if change.value >= 0 else negative}"


def _uses_actions(rows: Mapping[str, Row], ranks_actions: Verdict) -> Verdict:
    """Conclude from the one-step error with shuffled actions; yes also requires action ranking better than chance."""
    # The increase of the error is stated relative to the error with true actions, and judged relative to persistence.
    increase, gap = (rows[f"{name}.shuffled"].estimate for name in ("cost_of_actions", "gap_of_actions"))
    conclusion, reference, compared_with = draw_conclusion(gap, SAME_ERROR), "", "shuffled actions"
    low, high = ranks_actions.low, ranks_actions.high
    if conclusion == "yes" and low is not None and high is not None and high >= CHANCE:
        conclusion, compared_with = "no" if low > CHANCE else "inconclusive", _CHANCE
        reference = f"(but {ranks_actions.statement} {ranks_actions.interval}, chance 50 %)"
    statement = f"one-step error {_amount(increase, 'higher', 'lower')} with shuffled actions"
    return replace(_verdict(SENSITIVITY, conclusion, statement, increase, compared_with), reference=reference)


def _ranks_actions(rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict:
    """Conclude from the action-ranking error: yes if it is below the base model's and below chance."""
    key = "ranking.rank"
    if key not in rows:
        return not_measured_verdict(RANKING, "`vjepa2-ac evaluate --ranking-clips 32`")
    rank = rows[key].estimate
    statement = f"action-ranking error {format_percent(rank.value)} %"
    conclusion, reference, compared_with = (
        draw_conclusion(rank.subtract_from(CHANCE), RANKING_TOLERANCE),
        "chance 50 %",
        _CHANCE,
    )
    if (difference := rows.get("ranking.difference_to_base")) is not None:
        if conclusion == "yes":
            conclusion, compared_with = (
                draw_conclusion(difference.estimate.subtract_from(0.0), RANKING_TOLERANCE),
                _BASE,
            )
        reference = f"base model {format_percent(base_rows[key].value)} %, {reference}"
    verdict = _verdict(RANKING, conclusion, statement, rank, compared_with)
    return replace(verdict, reference=f"({reference})", baseline=CHANCE)


def _landscape(rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict | None:
    """Conclude from the distance between energy minimum and true action; None: no landscapes were measured.

    Yes requires a smaller distance than the base model's and than that of a random grid point.
    """
    key, sharpness = "landscapes.distance", "landscapes.sharpness"
    if key not in rows:
        return None
    distance, chance, unit = rows[key].estimate, rows[key].chance or 0.0, rows[key].unit
    conclusion, compared_with = draw_conclusion(distance.subtract_from(chance), 0.0), _CHANCE
    references = [f"random point {_with_unit(chance, unit)}", f"sharpness {rows[sharpness].value:#.2g}"]
    if (difference := rows.get("landscapes.distance.difference_to_base")) is not None:
        if conclusion == "yes":
            conclusion, compared_with = draw_conclusion(difference.estimate.subtract_from(0.0), 0.0), _BASE
        references.insert(0, f"base model {_with_unit(base_rows[key].value, unit)}")
        references[-1] += f", base model {base_rows[sharpness].value:#.2g}"
    statement = f"energy minimum {_with_unit(distance.value, unit)} from the true action"
    verdict = _verdict(LANDSCAPE, conclusion, statement, distance, compared_with)
    return replace(verdict, reference=f"({'; '.join(references)})", baseline=chance, unit="cm" if unit else "")


def _with_unit(number: float, unit: str) -> str:
    return f"{number:.1f} {unit}".rstrip()


def closed_loop_verdict(
    shares: Mapping[str, Estimate], model: str, oracle: str, problems: int, task: str, conditions: str = ""
) -> Verdict:
    """Conclude from the success rates in closed loop: yes if the model's exceeds those of all policies but the oracle.

    Args:
        shares: Success rate by policy: of the model, the oracle, and the competitors.
        model: Name of the model's policy.
        oracle: Name of the oracle. If it solves less than half, or with fewer than five problems, there is no
            conclusion.
        problems: Number of problems.
        task: Name of the task.
        conditions: Conditions of the measurement as text, for example the domain.
    """
    share, reference = shares[model], shares[oracle]
    competing = (rate for name, rate in shares.items() if name not in {model, oracle})
    best = max(competing, key=lambda rate: rate.value)
    is_not_better = share.value <= best.value and share.high < best.value + SAME_SUCCESS
    conclusion: Conclusion = "yes" if share.low > best.high else "no" if is_not_better else "inconclusive"
    needs = ""
    if reference.value < CHANCE:
        solved = f"The oracle solves only {format_percent(reference.value)} % of these problems"
        needs = f"{solved}, so they cannot be used for comparison; raise --steps."
    elif problems < MIN_EPISODES:
        needs = f"{_are_too_few(problems, 'problem')}; use --episodes 50."
    competitors_text = ", ".join(
        f"{name} {format_percent(rate.value)} %" for name, rate in shares.items() if name != model
    )
    statement = (
        f"success rate {format_percent(share.value)} % on {counted(problems, f'{task} problem')} {conditions}".rstrip()
    )
    competitors = "the zero action and random actions"
    verdict = _verdict(PLANNING, "inconclusive" if needs else conclusion, statement, share, competitors)
    return replace(verdict, reference=f"({competitors_text})", needs=needs, baseline=best.value)
