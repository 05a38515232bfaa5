"""Gradient descent through the model, on several action sequences in parallel."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.config.planning import GradientConfig
from vjepa2_ac.planning.interfaces import PlanStart
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.planning.solvers.base import EvaluatedPlans, white_noise


class GradientSolver:
    """Adam on decisions in units of their limits, projected onto the allowed set after every step.

    Each start descends independently. The result is the best of all evaluated decisions.
    """

    uses_gradients = True

    def __init__(
        self, space: SearchSpace, config: GradientConfig, iterations: int, generator: Generator, start: PlanStart | None
    ) -> None:
        self.elites = config.starts
        noise = white_noise(space, config.starts, generator)
        noise[0] = 0.0
        origin = torch.zeros_like(space.lower) if start is None else _best_of(start)
        self._space = space
        half = (space.upper - space.lower) / 2
        self._unit = torch.where(half > 0, half, 1.0)
        self._place = space.allowed(origin + space.first_std * noise) / self._unit
        self._adam = torch.optim.Adam([self._place], lr=config.learning_rate)
        self._fall = torch.optim.lr_scheduler.LambdaLR(self._adam, lambda step: max(0.0, 1 - step / iterations))

    @property
    def mean(self) -> Float[Tensor, "decisions dim"]:
        """The mean of all descents."""
        return self.sample().mean(dim=0)

    @property
    def std(self) -> Float[Tensor, "decisions dim"]:
        """The standard deviation over the descents."""
        return self.sample().std(dim=0, correction=0)

    def sample(self) -> Float[Tensor, "samples decisions dim"]:
        """Return the current decisions of each descent."""
        return self._space.allowed(self._place * self._unit)

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Take one gradient step.

        Raises:
            ValueError: There are no gradients.
        """
        if evaluated.gradients is None:
            raise ValueError("the cost has no gradients")
        self._place.grad = evaluated.gradients * self._unit
        self._adam.step()
        self._fall.step()
        with torch.no_grad():
            self._place.copy_(self.sample() / self._unit)

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return None to request the best evaluated decisions."""
        return None


def _best_of(start: PlanStart) -> Float[Tensor, "decisions dim"]:
    """Return the best current descent: the mean of several that lead to different places leads nowhere."""
    return start.elites[0] if len(start.elites) else start.mean
