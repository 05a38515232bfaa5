"""Goals: images that a plan aims at, when each takes its turn, and the latents that energies compare with."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from vjepa2_ac.errors import InputError

GripperMode = Literal["rounded", "free", "held", "open", "close"]


@dataclass(frozen=True, eq=False)
class SubGoal:
    """A goal image, how long it applies, and what the gripper may do meanwhile.

    Raises:
        InputError: The numbers contradict each other.
    """

    image: np.ndarray  # RGB, height x width x 3, uint8; checked where it is used
    name: str = ""
    at_least: int = 1  # model steps
    at_most: int | None = None  # likewise; None: no bound, and always of the last goal
    share: float | None = None  # the next goal follows below this share of the energy at the beginning; None: by count
    gripper: GripperMode | None = None  # None: planning.limits.gripper_mode
    floor: float = 0.0  # noise of camera and encoder: no threshold is below this energy

    def __post_init__(self) -> None:
        if self.at_least < 1 or (self.at_most is not None and self.at_most < self.at_least):
            found = f"at least {self.at_least} and at most {self.at_most} steps"
            raise InputError(where=self._where, found=found, needed="1 <= at_least <= at_most")
        if self.share is not None and not 0.0 < self.share < 1.0:
            raise InputError(where=self._where, found=f"share {self.share}", needed="a number between 0 and 1, or none")
        if not 0.0 <= self.floor < np.inf:
            raise InputError(where=self._where, found=f"a noise floor of {self.floor}", needed="an energy of 0 or more")

    @property
    def _where(self) -> str:
        return f"goal {self.name!r}" if self.name else "goal"


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


@dataclass(frozen=True)
class Goal:
    """Goal latents in order: each applies for its number of model steps, the last one without end.

    Raises:
        ValueError: No goals, another number of durations than there are goals before the last, a duration below 1, or
            weights that are negative, not finite, or all zero.
    """

    latents: Float[Tensor, "goals tokens dim"]
    durations: tuple[int, ...] = ()  # model steps of each goal but the last
    weights: Float[Tensor, " tokens"] | None = None  # weight of each patch; None: equal weights

    def __post_init__(self) -> None:
        if not len(self.latents) or len(self.durations) != len(self.latents) - 1 or min(self.durations, default=1) < 1:
            raise ValueError(f"{len(self.latents)} goals with durations {self.durations}: one for each but the last")
        if self.weights is not None:
            usable = torch.isfinite(self.weights).all() and (self.weights >= 0).all() and self.weights.any()
            if self.weights.shape != self.latents.shape[1:2] or not usable:
                raise ValueError("one weight for each patch, none negative, and not all zero")

    def place(self, step: int) -> int:
        """Return the index of the goal that applies after this many model steps since the start."""
        for place, duration in enumerate(self.durations):
            step -= duration
            if step < 0:
                return place
        return len(self.latents) - 1

    def ahead(self, done: int, steps: int) -> Float[Tensor, "steps tokens dim"]:
        """Return the goal latents after each of the next steps, when some are done.

        The frame after a goal's last step is still compared with that goal.
        """
        places = [self.place(done + step) for step in range(steps)]
        return torch.stack([self.latents[place] for place in places])  # a list as an index would wait for the device


@dataclass(frozen=True)
class GoalSequence:
    """Latents of goals in order, with the rule of each."""

    latents: Float[Tensor, "goals tokens dim"]
    rules: tuple[AdvanceRule, ...]
    grippers: tuple[GripperMode | None, ...]  # None: planning.limits.gripper_mode
    weights: Float[Tensor, " tokens"] | None = None  # as of `Goal`

    def rest(self, place: int) -> Goal:
        """Return a goal and what follows it by count at the latest, for plans of several steps."""
        durations: list[int] = []
        for rule in self.rules[place:-1]:
            if rule.at_most is None:
                break
            durations.append(rule.at_most)
        return Goal(self.latents[place : place + len(durations) + 1], tuple(durations), self.weights)


def patch_weights(
    mask: Bool[Tensor, "height width"] | Float[Tensor, "height width"], grid: int
) -> Float[Tensor, " tokens"]:
    """Return the weight of each patch: the mean of a mask over the patch, patches row by row.

    Args:
        mask: Over the image as the model sees it (cropped), of any resolution; 1 counts, 0 does not.
        grid: Patches along one side.

    Raises:
        ValueError: The mask is empty.
    """
    weights = adaptive_avg_pool2d(mask.float()[None], grid).flatten()
    if weights.sum() <= 1e-12:
        raise ValueError("the mask leaves nothing of the image")
    return weights
