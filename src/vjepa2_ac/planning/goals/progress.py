"""When does the next goal take its turn? A rule of counts and relative energies, without a model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

REACHED = 1e-6  # the energy of an image equal to the goal image, up to rounding


@dataclass(frozen=True)
class AdvanceRule:
    """How long a goal applies: as `SubGoal`, in model steps."""

    name: str = ""
    at_least: int = 1
    at_most: int | None = None
    share: float | None = None
    floor: float = 0.0

    def is_reached(self, energy: float, began: float) -> bool:
        """Return whether an energy is low enough, by what it was when the goal began; false for NaN."""
        if self.share is None:
            return False
        return energy < max(self.share * began, self.floor) or energy <= REACHED

    def is_used_up(self, steps: int) -> bool:
        """Return whether the goal has had all its steps."""
        return self.at_most is not None and steps >= self.at_most


@dataclass(frozen=True)
class GoalProgress:
    """Which goal applies at a decision, and since when. It never goes back to an earlier goal.

    Source of the rule: zcczhang/UVD @ e7d657a, uvd/envs/evaluator/inference_wrapper.py: energy relative to that at the
    beginning of the sub-goal, within bounds on the number of steps.
    """

    place: int  # index of the goal
    since: int  # model step, counted from the reset, at which it began
    began: float  # energy of the image to it at that time
    changed: str = ""  # why it is another one than before, or why the last one is reached; empty: nothing changed
    done: bool = False  # the last goal is reached; it stays so

    @classmethod
    def first(cls, energy: Callable[[int], float]) -> GoalProgress:
        """Return the progress at the first decision.

        Args:
            energy: Of the current image to the goal of an index.
        """
        return cls(0, 0, energy(0))

    def after(self, rules: Sequence[AdvanceRule], step: int, energy: Callable[[int], float]) -> GoalProgress:
        """Return the progress at a later decision: the same goal, or the next one.

        Args:
            rules: Of all goals, in order. That of the last one says when it is reached, by energy only.
            step: Model steps done since the reset.
            energy: Of the current image to the goal of an index.
        """
        rule, steps, stays = rules[self.place], step - self.since, replace(self, changed="")
        if self.done or steps < rule.at_least:
            return stays
        now, is_last = energy(self.place), self.place == len(rules) - 1
        if rule.is_reached(now, self.began):
            why = _reached(rule, now, self.began)
        elif rule.is_used_up(steps) and not is_last:
            why = f"its {rule.at_most} steps are over at energy {now:.4g}{_share_of(now, self.began)}"
        else:
            return stays
        text = f"{self._called(rule)}, after {steps} step{'s' * (steps > 1)}: {why}."
        if is_last:
            return replace(self, changed=text, done=True)
        return GoalProgress(self.place + 1, step, energy(self.place + 1), text)

    def _called(self, rule: AdvanceRule) -> str:
        return f"Goal {self.place + 1} ({rule.name})" if rule.name else f"Goal {self.place + 1}"


def _reached(rule: AdvanceRule, now: float, began: float) -> str:
    if rule.share is not None and now < rule.share * began:
        return f"energy {now:.4g} is below {rule.share:.0%} of {began:.4g}"
    if now < rule.floor:
        return f"energy {now:.4g} is within the noise of {rule.floor:.4g}"
    return "the image equals the goal's"


def _share_of(now: float, began: float) -> str:
    return f", {now / began:.0%} of {began:.4g}" if began > 0 and math.isfinite(now / began) else ""
