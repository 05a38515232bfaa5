"""The base of all solvers: samples, their energies, and the best of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.planning.search_space import SearchSpace


@dataclass(frozen=True)
class EvaluatedPlans:
    """Decisions with their energies; those without a finite one are left out, so it may be empty."""

    decisions: Float[Tensor, "finite decisions dim"]
    energies: Float[Tensor, " finite"]
    gradients: Float[Tensor, "samples decisions dim"] | None = None  # of all samples, 0 where not finite

    def best(self, count: int) -> EvaluatedPlans:
        """Return the decisions of lowest energy, best first; fewer if there are not enough."""
        order = self.energies.sort(stable=True).indices[:count]
        return EvaluatedPlans(self.decisions[order], self.energies[order])


@runtime_checkable
class Solver(Protocol):
    """The search of one decision, from its first samples to its result."""

    elites: int  # how many of the best are recorded
    uses_gradients: bool

    @property
    def mean(self) -> Float[Tensor, "decisions dim"]:
        """The mean of the distribution."""
        ...

    @property
    def std(self) -> Float[Tensor, "decisions dim"]:
        """The standard deviation of the distribution."""
        ...

    def sample(self) -> Float[Tensor, "samples decisions dim"]:
        """Return the next decisions to evaluate, all allowed."""
        ...

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Update the distribution. Without any finite energy, nothing changes."""
        ...

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return the current result; None: the best evaluated decisions."""
        ...


def white_noise(space: SearchSpace, samples: int, generator: Generator) -> Float[Tensor, "samples decisions dim"]:
    """Return independent standard normal numbers, zero on axes that are fixed in all decisions.

    Drawn decision by decision and for free axes only, in upstream's order: the same seed gives upstream's samples.
    """
    noise = torch.zeros(samples, space.decisions, space.dim)
    for decision in range(space.decisions):
        noise[:, decision, space.free] = torch.randn(samples, len(space.free), generator=generator)
    return noise
