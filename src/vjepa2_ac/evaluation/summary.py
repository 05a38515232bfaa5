"""The summary of an evaluation: verdicts on prediction, sensitivity to actions, action ranking, planning and landscape.

A verdict is yes, no, inconclusive or not measured. Its statement has one number with a 95 % interval over episodes.
PyTorch is not imported.
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

from pydantic import BeforeValidator, Field, TypeAdapter

from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.result import L1, Evaluation
from vjepa2_ac.evaluation.rows import Row
from vjepa2_ac.intervals import MIN_EPISODES, Estimate
from vjepa2_ac.runs.checkpoint import RANKING_TOLERANCE
from vjepa2_ac.storage.paths import CLOSED_LOOP_FILE

Conclusion = Literal["yes", "no", "inconclusive", "not measured"]

SAME_ERROR = 0.01  # relative; errors with a smaller difference count as equal, whatever their interval
SAME_SUCCESS = 0.1  # absolute; "no" needs an upper bound that exceeds the best competitor's success rate by less
CHANCE = 0.5  # action-ranking error of a model that ignores its actions
_MIN_ORACLE_RATE = 0.5  # problems are too hard for a comparison if the oracle's success rate is lower
_BASE, _PERSISTENCE, _CHANCE = "the base model", "persistence", "chance"  # values of `compared_with`
_TOO_FEW = "too few for a conclusion"
_COLUMNS, _NO_BREAK = 90, "\N{NO-BREAK SPACE}"
_NUMBER = re.compile(r"\d[\d.]*+(?! s\b)(?: (?:%|cm))?")  # the first match in a statement is the verdict's number
_wrap = partial(wrap, break_on_hyphens=False)  # commands and paths contain hyphens and must not be broken


PREDICTION, SENSITIVITY, RANKING = "better prediction", "sensitive to actions", "better action ranking"
PLANNING, LANDSCAPE = "better than random", "better landscape"
_FORMER_NAMES = {  # in files of earlier versions
    "predicts": PREDICTION,
    "uses actions": SENSITIVITY,
    "ranks actions": RANKING,
    "plans": PLANNING,
    "plans better": PLANNING,
    "landscape": LANDSCAPE,
}


@dataclass(frozen=True)
class Verdict:
    """One line of the summary."""

    name: Annotated[str, BeforeValidator(lambda name: _FORMER_NAMES.get(name, name))]
    conclusion: Conclusion
    statement: str  # the measurement with one number; a word such as "lower" gives the sign
    value: float | None = None  # the number of the statement, with its sign; None: not measured
    low: float | None = None  # 95 % interval over episodes; None: there is none
    high: float | None = None
    unit: Literal["%", "cm", ""] = "%"  # unit in the statement; with % the value is a fraction
    reference: str = ""  # numbers to compare with, in parentheses
    needs: str = ""  # sentence that states why there is no conclusion, and what is needed
    baseline: float = 0.0  # value of an untrained model, or of the best competitor
    # Competitor that decided the conclusion, as in "not better than the base model"; earlier versions wrote "with ...".
    compared_with: Annotated[str, BeforeValidator(lambda text: text.removeprefix("with "))] = ""

    @property
    def interval(self) -> str:
        """The interval as text, with the rounding and the sign of the number in the statement; empty without one."""
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
    """The verdicts on a run or a model. The aliases are the keys of metrics.json."""

    subject: str  # name of the run with its checkpoint, or of the model
    measured: str  # numbers of clips and episodes, as text
    prediction: Annotated[Verdict, Field(alias="predicts")]
    sensitivity: Annotated[Verdict, Field(alias="uses_actions")]
    ranking: Annotated[Verdict, Field(alias="ranks_actions")]
    planning: Annotated[Verdict | None, Field(alias="plans")] = None  # None: no closed loop of this checkpoint
    landscape: Verdict | None = None  # None: no energy landscapes were measured

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """The lines of the summary. The third line is planning if it was measured, otherwise action ranking."""
        third = self.ranking if self.planning is None else self.planning
        return self.prediction, self.sensitivity, third, *(() if self.landscape is None else (self.landscape,))

    @property
    def sentence(self) -> str:
        """The conclusion from all verdicts, in one or two sentences of at most 40 words together."""
        first_three = self.verdicts[:3]
        if needs := next((verdict.needs for verdict in first_three if verdict.needs), ""):
            return needs
        for verdict in first_three:
            if verdict.conclusion == "no":
                return self._denial(verdict)
        if inconclusive := [verdict.name for verdict in first_three if verdict.conclusion == "inconclusive"]:
            needed = "problems" if inconclusive == [PLANNING] else "held-out episodes"
            needed = "clips, with --ranking-clips" if _TOO_FEW in self.verdicts[2].reference else needed
            return f"Inconclusive: {', '.join(inconclusive)}. Measure more {needed}."
        if missing := [verdict.name for verdict in first_three if verdict.conclusion == "not measured"]:
            return f"Not measured: {', '.join(missing)}."
        better = f"Better prediction than {self.prediction.compared_with}, sensitive to actions"
        if self.planning is not None:
            better += f", and a higher success rate than {self.planning.compared_with}."
        else:
            better += f", better action ranking than {self.ranking.compared_with}. Planning was not measured."
        if self.landscape is None or self.landscape.conclusion != "no":
            return better
        competitor = "a random point" if self.landscape.compared_with == _CHANCE else "that of the base model"
        return f"{better} But the energy minimum is not nearer to the true action than {competitor}."

    @property
    def _unusable(self) -> str:
        """The clause that the model cannot be used for planning; empty if planning was measured."""
        return ", so the model cannot be used for planning" if self.planning is None else ""

    def _denial(self, verdict: Verdict) -> str:
        """Return the sentence about a verdict whose conclusion is no."""
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
    def _legend(self) -> list[str]:
        """The line that explains the intervals; empty without an interval."""
        is_success_rate = {verdict is self.planning for verdict in self.verdicts if verdict.interval}
        units = " and (success rate) ".join(["episodes", "problems"][each] for each in sorted(is_success_rate))
        return [f"  Brackets: 95 % intervals over {units}"] if units else []

    def __str__(self) -> str:
        gap = _COLUMNS - len(self.subject) - len(self.measured)
        header = f"{self.subject}{' ' * gap}{self.measured}"
        lines = [header] if gap > 1 else [*_wrap(self.subject, _COLUMNS), self.measured]
        name_width = max(len(verdict.name) for verdict in self.verdicts)
        conclusion_width = max(len(verdict.conclusion) for verdict in self.verdicts)
        for verdict in self.verdicts:
            label = f"  {verdict.name:<{name_width}}  {verdict.conclusion:<{conclusion_width}}  "
            text = _keep_units_together(f"{verdict.statement_with_interval} {verdict.reference}")
            first, *rest = _wrap(text, _COLUMNS - len(label))
            lines += (label + first, *(" " * len(label) + line for line in rest))
        lines += self._legend
        lines += _wrap(_keep_units_together(self.sentence), _COLUMNS)
        return "\n".join(lines).replace(_NO_BREAK, " ")


def _keep_units_together(text: str) -> str:
    """Replace the space between a number and its unit with a no-break space."""
    return re.sub(r"(?<=\d) (?=%|cm\b|s\b)", _NO_BREAK, text)


def summarize(evaluation: Evaluation, rows: Sequence[Row]) -> Summary:
    """Return the summary of an evaluation without a verdict on planning.

    Args:
        evaluation: The evaluation.
        rows: Its rows (`rows.make_rows`).
    """
    clips, model = evaluation.clips, evaluation.models[evaluation.trained]
    trained_rows = {row.key: row for row in rows if row.model == evaluation.trained}
    base_rows = {row.key: row for row in rows if row.model == evaluation.base}
    ranking_ids = () if model.ranking is None else model.ranking.episode_ids
    landscape_ids = () if model.landscapes is None else model.landscapes.episode_ids
    landscape = _judge_landscape(trained_rows, base_rows)
    ranking = _require_enough_episodes(_judge_ranking(trained_rows, base_rows), ranking_ids)
    summary = Summary(
        subject=evaluation.title,
        measured=f"{counted(len(clips), 'clip')}, {counted(clips.episodes, 'held-out episode')}",
        prediction=_judge_prediction(evaluation, trained_rows, base_rows),
        sensitivity=_judge_sensitivity(trained_rows, ranking),
        ranking=ranking,
        landscape=None if landscape is None else _require_enough_episodes(landscape, landscape_ids),
    )
    return summary if clips.episodes >= MIN_EPISODES else _remove_conclusions(summary, clips.episodes)


def _remove_conclusions(summary: Summary, num_episodes: int) -> Summary:
    """Return the summary of too few episodes: it states what is needed, and the numbers, but no conclusions."""
    needs = (
        f"{_are_too_few(num_episodes, 'held-out episode')}; at least {MIN_EPISODES} are needed."
        f" So far: {summary.prediction.statement}; {summary.sensitivity.statement}."
    )
    return replace(
        summary,
        prediction=replace(_remove_conclusion(summary.prediction), needs=needs),
        sensitivity=_remove_conclusion(summary.sensitivity),
        ranking=_remove_conclusion(summary.ranking),
        landscape=None if summary.landscape is None else _remove_conclusion(summary.landscape),
    )


def _require_enough_episodes(verdict: Verdict, episode_ids: Sequence[str]) -> Verdict:
    """Return the verdict, without its conclusion if it was measured on too few episodes."""
    num_episodes = len(set(episode_ids))
    if not 0 < num_episodes < MIN_EPISODES:
        return verdict
    reference = f"{verdict.reference[:-1]}; {_are_too_few(num_episodes, 'episode')})"
    return replace(_remove_conclusion(verdict), reference=reference)


def _remove_conclusion(verdict: Verdict) -> Verdict:
    conclusion: Conclusion = "inconclusive" if verdict.value is not None else "not measured"
    return replace(verdict, conclusion=conclusion, low=None, high=None)


def _are_too_few(number: int, noun: str) -> str:
    return f"{counted(number, noun)} {'is' if number == 1 else 'are'} {_TOO_FEW}"


def not_measured_verdict(name: str, command: str) -> Verdict:
    """Return a verdict with the conclusion "not measured" and the command that measures it."""
    return Verdict(name, "not measured", f"to measure it, run {command}")


def with_closed_loop(summary: Summary, run: Path, checkpoint: str) -> Summary:
    """Add the planning verdict of the run's newest closed-loop benchmark of this checkpoint, if there is one."""
    files = sorted(run.glob(f"closed_loop/*/{CLOSED_LOOP_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in files:
        benchmark = json.loads(file.read_bytes())
        measured = benchmark["about"]["checkpoint"] or ""  # name of the checkpoint, and how it was selected
        if measured.partition(" ")[0] == checkpoint.partition(" ")[0] and "verdict" in benchmark:
            return replace(summary, planning=TypeAdapter(Verdict).validate_python(benchmark["verdict"]))
    return summary


def format_percent(fraction: float) -> str:
    """Return a fraction in percent, with one decimal below 10 %."""
    return f"{100 * fraction:z.0f}" if abs(fraction) >= 0.0995 else f"{100 * fraction:z.1f}"


def format_interval(fraction: Estimate) -> str:
    """Return the interval of a fraction's absolute value in percent; empty without an interval."""
    form = "z.0f" if abs(fraction.value) >= 0.0995 else "z.1f"
    low, high = (fraction.low, fraction.high) if fraction.value >= 0 else (-fraction.high, -fraction.low)
    return f"[{100 * low:{form}}, {100 * high:{form}}]" if fraction.has_interval else ""


def draw_conclusion(gain: Estimate, tolerance: float) -> Conclusion:
    """Return yes if the interval of a gain is above 0, no if it is below 0 or within ±tolerance, else inconclusive."""
    if max(abs(gain.low), abs(gain.high)) < tolerance:
        return "no"
    conclusions: dict[int, Conclusion] = {-1: "no", 0: "inconclusive", 1: "yes"}
    return conclusions[gain.compare_to(0.0)]


def _make_verdict(name: str, conclusion: Conclusion, statement: str, estimate: Estimate, compared_with: str) -> Verdict:
    if math.isnan(estimate.value):
        return Verdict(name, "not measured", "the predictions are not finite")
    low, high = (estimate.low, estimate.high) if estimate.has_interval else (None, None)
    return Verdict(name, conclusion, statement, estimate.value, low, high, compared_with=compared_with)


def _judge_prediction(evaluation: Evaluation, rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict:
    """Conclude from the L1 error of the longest rollout: yes if it is below the base model's and below persistence's.

    The reference of the verdict lists other metrics that disagree, and a lower spread, because smoother predictions
    also have a lower error.
    """
    horizon, ahead = evaluation.horizon, f"{evaluation.seconds_ahead:.1f} s ahead"
    error = rows[f"rollout.{L1.name}.over_persistence.{horizon}"].estimate
    verdict = against_persistence = _judge_gain(error.subtract_from(1.0), _PERSISTENCE, ahead)
    gain, remarks = rows.get(f"rollout.{L1.name}.gain_over_base.{horizon}"), []
    if gain is not None:
        verdict = _judge_gain(gain.estimate, _BASE, ahead)
        remarks = [
            f"by {metric.label} {_format_change(row.estimate, 'better', 'worse')}"
            f" {format_interval(row.estimate)}".rstrip()
            for metric in evaluation.metrics
            if (row := rows.get(f"rollout.{metric.name}.gain_over_base.{horizon}"))
            and row.estimate.compare_to(0.0) != gain.estimate.compare_to(0.0)
        ]
    is_error_lower = verdict.value is not None and verdict.value > SAME_ERROR
    if is_error_lower and (blur := _describe_blur(rows, base_rows, horizon)):
        remarks.append(blur)
    if verdict.conclusion == "yes" and against_persistence.conclusion != "yes":
        remarks.insert(0, f"{verdict.statement} {verdict.interval}")
        verdict = against_persistence
    return replace(verdict, reference=f"({'; '.join(remarks)})" if remarks else "")


def _describe_blur(rows: Mapping[str, Row], base_rows: Mapping[str, Row], horizon: int) -> str:
    """Return a remark if the predictions vary less than the base model's; without one, less than the true latents."""
    key = f"spread.{horizon}"
    if key not in rows or math.isnan(rows[key].value):
        return ""
    spread, reference_spread = rows[key].value, base_rows[key].value if key in base_rows else 1.0
    if spread >= min(reference_spread, 1.0) * (1 - SAME_ERROR):  # 1: as varied as the true latents
        return ""
    reference = "base model" if key in base_rows else "true latents"
    return f"part of the gain may be blur: spread {spread:.2f}, {reference} {reference_spread:.2f}"


def _judge_gain(gain: Estimate, compared_with: str, ahead: str) -> Verdict:
    reference = "the base model's" if compared_with == _BASE else f"that of {compared_with}"
    statement = f"{ahead}, error {_format_change(gain, 'lower', 'higher')} than {reference}"
    return _make_verdict(PREDICTION, draw_conclusion(gain, SAME_ERROR), statement, gain, compared_with)


def _format_change(change: Estimate, positive: str, negative: str) -> str:
    """Return a relative change in percent, followed by the word for its sign, such as "5.0 % lower"."""
    return f"{format_percent(abs(change.value))} % {positive if change.value >= 0 else negative}"


def _judge_sensitivity(rows: Mapping[str, Row], ranking: Verdict) -> Verdict:
    """Conclude from the one-step error with shuffled actions; yes also requires action ranking better than chance."""
    # The statement has the increase relative to the error with true actions. The conclusion uses the increase relative
    # to persistence, because a small error with true actions would make any increase large.
    increase, gap = (rows[f"{name}.shuffled"].estimate for name in ("cost_of_actions", "gap_of_actions"))
    conclusion, reference, compared_with = draw_conclusion(gap, SAME_ERROR), "", "shuffled actions"
    low, high = ranking.low, ranking.high
    if conclusion == "yes" and low is not None and high is not None and high >= CHANCE:
        conclusion, compared_with = "no" if low > CHANCE else "inconclusive", _CHANCE
        reference = f"(but {ranking.statement} {ranking.interval}, chance 50 %)"
    statement = f"one-step error {_format_change(increase, 'higher', 'lower')} with shuffled actions"
    return replace(_make_verdict(SENSITIVITY, conclusion, statement, increase, compared_with), reference=reference)


def _judge_ranking(rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict:
    """Conclude from the action-ranking error: yes if it is below the base model's and below chance."""
    key = "ranking.rank"
    if key not in rows:
        return not_measured_verdict(RANKING, "`vjepa2-ac evaluate --ranking-clips 32`")
    error = rows[key].estimate
    statement = f"action-ranking error {format_percent(error.value)} %"
    conclusion, compared_with = draw_conclusion(error.subtract_from(CHANCE), RANKING_TOLERANCE), _CHANCE
    reference = "chance 50 %"
    if (difference := rows.get("ranking.difference_to_base")) is not None:
        if conclusion == "yes":
            gain, compared_with = difference.estimate.subtract_from(0.0), _BASE
            conclusion = draw_conclusion(gain, RANKING_TOLERANCE)
        reference = f"base model {format_percent(base_rows[key].value)} %, {reference}"
    verdict = _make_verdict(RANKING, conclusion, statement, error, compared_with)
    return replace(verdict, reference=f"({reference})", baseline=CHANCE)


def _judge_landscape(rows: Mapping[str, Row], base_rows: Mapping[str, Row]) -> Verdict | None:
    """Conclude from the distance between energy minimum and true action; None: no landscapes were measured.

    The conclusion is yes if the distance is below the base model's and below that of a random grid point.
    """
    key, sharpness = "landscapes.distance", "landscapes.sharpness"
    if key not in rows:
        return None
    distance, chance, unit = rows[key].estimate, rows[key].chance or 0.0, rows[key].unit
    conclusion, compared_with = draw_conclusion(distance.subtract_from(chance), 0.0), _CHANCE
    references = [f"random point {_format_with_unit(chance, unit)}", f"sharpness {rows[sharpness].value:#.2g}"]
    if (difference := rows.get("landscapes.distance.difference_to_base")) is not None:
        if conclusion == "yes":
            conclusion, compared_with = draw_conclusion(difference.estimate.subtract_from(0.0), 0.0), _BASE
        references.insert(0, f"base model {_format_with_unit(base_rows[key].value, unit)}")
        references[-1] += f", base model {base_rows[sharpness].value:#.2g}"
    statement = f"energy minimum {_format_with_unit(distance.value, unit)} from the true action"
    verdict = _make_verdict(LANDSCAPE, conclusion, statement, distance, compared_with)
    return replace(verdict, reference=f"({'; '.join(references)})", baseline=chance, unit="cm" if unit else "")


def _format_with_unit(number: float, unit: str) -> str:
    return f"{number:.1f} {unit}".rstrip()


def closed_loop_verdict(
    success_rates: Mapping[str, Estimate], model: str, oracle: str, problems: int, task: str, conditions: str = ""
) -> Verdict:
    """Conclude from success rates in closed loop: yes if the model's is above those of all policies but the oracle.

    Args:
        success_rates: Success rates of the model, the oracle and the competitors, by name of the policy.
        model: Name of the model's policy.
        oracle: Name of the oracle. If it solves less than half of the problems, there is no conclusion.
        problems: Number of problems; with fewer than five there is no conclusion.
        task: Name of the task.
        conditions: Conditions of the measurement as text, for example the domain.
    """
    rate, oracle_rate = success_rates[model], success_rates[oracle]
    competing = (each for name, each in success_rates.items() if name not in {model, oracle})
    best = max(competing, key=lambda each: each.value)
    is_not_better = rate.value <= best.value and rate.high < best.value + SAME_SUCCESS
    conclusion: Conclusion = "yes" if rate.low > best.high else "no" if is_not_better else "inconclusive"
    needs = ""
    if oracle_rate.value < _MIN_ORACLE_RATE:
        solved = f"The oracle solves only {format_percent(oracle_rate.value)} % of these problems"
        needs = f"{solved}, so they cannot be used for comparison; raise --steps."
    elif problems < MIN_EPISODES:
        needs = f"{_are_too_few(problems, 'problem')}; use --episodes 50."
    rates = [f"{name} {format_percent(each.value)} %" for name, each in success_rates.items() if name != model]
    solved = f"success rate {format_percent(rate.value)} % on {counted(problems, f'{task} problem')}"
    statement, competitors = f"{solved} {conditions}".rstrip(), "the zero action and random actions"
    verdict = _make_verdict(PLANNING, "inconclusive" if needs else conclusion, statement, rate, competitors)
    return replace(verdict, reference=f"({', '.join(rates)})", needs=needs, baseline=best.value)
