"""The answer of an evaluation: does it predict better, does it use the actions, does it plan better?

Each is yes, no, or not known yet, with one number and its 95 % interval over episodes. PyTorch is not imported.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from vjepa2_ac.evaluation.estimates import over_persistence
from vjepa2_ac.evaluation.result import L1, Evaluation, Row
from vjepa2_ac.intervals import ENOUGH_EPISODES, Estimate

Word = Literal["yes", "no", "not known yet"]

SAME_ERROR = 0.01  # share: errors this close are the same, whatever their interval
SAME_MOVES = 0.005  # share of moves: likewise
_COLUMNS = 80
CLOSED_LOOP_FILE = "closed_loop.json"  # in RUN/closed_loop/TASK-DOMAIN
CHANCE = 0.5  # of moves that look better
_SCENE = "it learned the scene, not the arm"


@dataclass(frozen=True)
class Question:
    """One question, and its answer."""

    name: str
    word: Word
    says: str  # with one number
    share: float | None = None  # this number; None: not measured
    interval: str = ""  # 95 % over episodes, as text; "": there is none
    beside: str = ""  # what to hold the number against
    seems: Literal["yes", "no", ""] = ""  # by the number alone
    why: str = ""  # a sentence: why nothing can be known
    against: float = 0.0  # what figures hold the number against: nothing, chance, or the best rival


@dataclass(frozen=True)
class Answer:
    """The three questions about a run or a model."""

    subject: str  # with its checkpoint, as text
    measured: str  # on how much
    rival: str  # what it is held against: the base, or doing nothing
    predicts: Question
    uses_actions: Question
    plans: Question

    @property
    def questions(self) -> tuple[Question, ...]:
        """All three."""
        return self.predicts, self.uses_actions, self.plans

    @property
    def sentence(self) -> str:
        """What the three say together, in at most 40 words."""
        if why := next((question.why for question in self.questions if question.why), ""):
            return why
        words = {"predicts better": self.predicts, "uses the actions": self.uses_actions, "plans better": self.plans}
        if self.predicts.word == "no":
            return f"It predicts no better than {self.rival}: look at the data, their axes and stride first."
        if self.uses_actions.word == "no":
            return f"{_SCENE.capitalize()}: wrong actions cost it nothing, so it cannot plan."
        if self.plans.word == "no":
            return f"It predicts better than {self.rival}, but it does not plan better."
        if unknown := [name for name, one in words.items() if one.word == "not known yet"]:
            return f"Not known yet: whether it {' and '.join(unknown)}. More held-out episodes, or problems, tell more."
        return f"It predicts better than {self.rival}, it uses the actions, and it plans better."

    def __str__(self) -> str:
        between = _COLUMNS - len(self.subject) - len(self.measured)
        lines = [f"{self.subject}{' ' * between if between > 1 else chr(10)}{self.measured}"]
        wide = max(len(question.word) for question in self.questions)
        for question in self.questions:
            before = f"  {question.name:<12}  {question.word:<{wide}}  "
            room = _COLUMNS - len(before) - len(question.interval) - 1
            says, *more = textwrap.wrap(f"{question.says} {question.beside}", room)
            lines.append(f"{before}{says:<{room}} {question.interval}".rstrip())
            lines += (" " * len(before) + text for text in more)
        return "\n".join([*lines, *textwrap.wrap(self.sentence, _COLUMNS)])


def answer(evaluation: Evaluation, rows: Sequence[Row]) -> Answer:
    """Return the answer of an evaluation from its rows (`rows.rows_of`)."""
    clips, base = evaluation.clips, evaluation.base
    of_trained = {row.key: row for row in rows if row.model == evaluation.trained}
    of_base = {row.key: row for row in rows if row.model == base}
    found = Answer(
        subject=evaluation.title,
        measured=f"{len(clips)} clips, {clips.episodes} held-out episode{'s' * (clips.episodes != 1)}",
        rival="doing nothing" if base is None else "the base",
        predicts=_predicts(of_trained, evaluation.horizon, f"{evaluation.seconds_ahead:.1f} s ahead"),
        uses_actions=_uses_actions(of_trained),
        plans=_plans(of_trained, of_base),
    )
    return found if clips.episodes >= ENOUGH_EPISODES else _too_few(found, clips.episodes)


def _too_few(found: Answer, episodes: int) -> Answer:
    """Return an answer in which nothing is known yet, and what the numbers alone say."""
    shows = found.predicts.says
    if found.predicts.seems == "yes" and found.uses_actions.seems == "no":
        shows += f", but {found.uses_actions.says}: {_SCENE}"
    few = f"{episodes} held-out episode{'s are' if episodes > 1 else ' is'} too few to know"
    why = f"{few}, {ENOUGH_EPISODES} would do. So far: {shows}."
    predicts, uses_actions, plans = (
        replace(question, word="not known yet", interval="", why=why) for question in found.questions
    )
    return replace(found, predicts=predicts, uses_actions=uses_actions, plans=plans)


def not_measured(name: str, instead: str = "") -> Question:
    """Return a question that nobody asked yet, and the command that would."""
    return Question(name, "not known yet", "not measured", beside=f"({instead})" if instead else "")


def with_closed_loop(found: Answer, run: Path, checkpoint: str) -> Answer:
    """Return an answer whose plans are those of the run's newest closed loop of this checkpoint, if there is one."""
    files = sorted(run.glob(f"closed_loop/*/{CLOSED_LOOP_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in files:
        measured = json.loads(file.read_bytes())
        if measured["about"]["checkpoint"] == checkpoint:
            return replace(found, plans=Question(**measured["plans"]))
    return found


def spread(evaluations: Sequence[Evaluation]) -> str:
    """Return as text how much the errors of several runs differ, at the longest horizon."""
    errors = [over_persistence(one.errors, "rollout")[-1].value for one in evaluations]
    mean = f"{np.mean(errors):.3f} ({min(errors):.3f} to {max(errors):.3f})"
    return f"{len(evaluations)} runs: error over that of doing nothing {mean}"


def percent(share: float) -> str:
    """Return a share in percent, with a digit more below 10."""
    return f"{100 * share:.0f}" if abs(share) >= 0.0995 else f"{100 * share:.1f}"


def interval_of(share: Estimate) -> str:
    """Return the interval of a share in percent, with as many digits as the share; "": there is none."""
    form = ".0f" if abs(share.value) >= 0.0995 else ".1f"
    return f"[{100 * share.low:{form}}, {100 * share.high:{form}}]" if share.has_interval else ""


def word_of(share: Estimate, same: float) -> Word:
    """Return yes or no if the interval of a difference lies on one side of 0 or within `same` of it, else unknown."""
    if max(abs(share.low), abs(share.high)) < same:
        return "no"
    words: dict[int, Word] = {-1: "no", 0: "not known yet", 1: "yes"}
    return words[share.side(of=0.0)]


def _predicts(rows: Mapping[str, Row], horizon: int, ahead: str) -> Question:
    """Answer by the L1 error of the longest rollout: it has to be below the base's and below doing nothing's."""
    error = rows[f"rollout.{L1.name}.over_persistence.{horizon}"].estimate
    beside_nothing = _of_gain(error.below(1.0), "doing nothing's", ahead)
    gain = rows.get(f"rollout.{L1.name}.gain_over_base.{horizon}")
    if gain is None:
        return beside_nothing
    found = _of_gain(gain.estimate, "the base's", ahead)
    if found.word == "yes" and beside_nothing.word != "yes":
        return replace(beside_nothing, beside=f"({found.says} {found.interval})")
    others = [
        f"by {name} {_lower(row.estimate)}"
        for name in dict.fromkeys(key.split(".")[1] for key in rows if key.startswith("rollout."))
        if (row := rows.get(f"rollout.{name}.gain_over_base.{horizon}"))
        and row.estimate.side(of=0.0) != gain.estimate.side(of=0.0)
    ]
    return replace(found, beside=f"({', '.join(others)})" if others else "")


def _of_gain(gain: Estimate, whose: str, ahead: str) -> Question:
    seems: Literal["yes", "no"] = "yes" if gain.value > SAME_ERROR else "no"
    says = f"error {_lower(gain)} than {whose}, {ahead}"
    return Question("predicts", word_of(gain, SAME_ERROR), says, gain.value, interval_of(gain), seems=seems)


def _lower(gain: Estimate) -> str:
    return f"{percent(abs(gain.value))} % {'lower' if gain.value >= 0 else 'higher'}"


def _uses_actions(rows: Mapping[str, Row]) -> Question:
    """Answer by what another clip's actions cost; the true ones have to fit best among others, too, where measured."""
    cost, gap = (rows[f"{name}.shuffled"].estimate for name in ("cost_of_actions", "gap_of_actions"))
    seems: Literal["yes", "no"] = "yes" if gap.value > SAME_ERROR else "no"
    word = word_of(gap, SAME_ERROR)
    beside = ""
    for key in ("sensitivity.rank.clips", "sensitivity.rank.box"):
        if key in rows and word == "yes" and (rank := rows[key].estimate).side(of=CHANCE) != -1:
            word = "no" if rank.side(of=CHANCE) == 1 else "not known yet"
            beside = f"({rows[key].name}: {percent(rank.value)} %, chance 50 %)"
    says = f"a wrong action costs {percent(cost.value)} %" if seems == "yes" else "a wrong action costs nothing"
    return Question("uses actions", word, says, cost.value, interval_of(cost), beside, seems)


def _plans(rows: Mapping[str, Row], of_base: Mapping[str, Row]) -> Question:
    """Answer by the share of other moves that look better than the true one: below the base's, and below chance."""
    key = "ranking.rank"
    if key not in rows:
        return not_measured("plans")
    rank = rows[key].estimate
    says = f"{percent(rank.value)} % of other moves look better than the true one"
    word, held = word_of(rank.below(CHANCE), SAME_MOVES), "chance 50 %"
    if (difference := rows.get("ranking.difference_to_base")) is not None:
        word = word_of(difference.estimate.below(0.0), SAME_MOVES) if word == "yes" else word
        held = f"base {percent(of_base[key].value)} %, {held}"
    return Question("plans", word, says, rank.value, interval_of(rank), f"({held})", against=CHANCE)


def closed_loop(shares: Mapping[str, Estimate], model: str, oracle: str, problems: int, task: str) -> Question:
    """Answer by the share of problems that are solved in closed loop: above that of doing nothing and of chance.

    Args:
        shares: Of solved problems, by policy: the model's, the oracle's, and those that it has to beat.
        model: Its policy.
        oracle: That of the oracle. Where it fails, or of one problem, nothing can be known.
        problems: Their number.
        task: What is to be done.
    """
    own, reference = shares[model], shares[oracle]
    best = max((one for name, one in shares.items() if name not in {model, oracle}), key=lambda one: one.value)
    word: Word = "yes" if own.low > best.high else "no" if own.value <= best.value else "not known yet"
    why = ""
    if reference.value < CHANCE:
        why = f"The oracle itself solves {percent(reference.value)} % of these problems: they show nothing."
    elif problems < ENOUGH_EPISODES:
        why = f"{problems} episode{'s' * (problems > 1)} of {task} cannot show anything: 50 would."
    beside = ", ".join(f"{name} {100 * one.value:.0f} %" for name, one in shares.items() if name != model)
    says = f"solves {100 * own.value:.0f} % of {problems} problems of {task}"
    known: Word = "not known yet" if why else word
    return Question("plans", known, says, own.value, interval_of(own), f"({beside})", why=why, against=best.value)
