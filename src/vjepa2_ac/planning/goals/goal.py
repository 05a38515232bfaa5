"""Latents of goals: one goal image or a sequence of them, optionally limited to a region of the image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from vjepa2_ac.planning.goals.progress import AdvanceRule
from vjepa2_ac.planning.goals.sub_goals import GripperMode

_EVERYWHERE = 1e-12


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
    if weights.sum() <= _EVERYWHERE:
        raise ValueError("the mask leaves nothing of the image")
    return weights
