"""Model predictive path integral control: the mean of all samples, weighted by their cost."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.config.planning import MppiConfig
from vjepa2_ac.planning.interfaces import PlanStart
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.planning.solvers.base import EvaluatedPlans, white_noise

_RECORDED = 10


class MppiSolver:
    """Weights exp(-energy / temperature); the noise decays by a fixed factor, and the mean is evaluated itself.

    The control cost of the original is left out: the limits define the allowed actions.

    Source: Williams et al., Information Theoretic MPC for Model-Based Reinforcement Learning, ICRA 2017, algorithm 2.
    """

    uses_gradients = False
    elites = _RECORDED

    def __init__(
        self, space: SearchSpace, config: MppiConfig, samples: int, generator: Generator, start: PlanStart | None = None
    ) -> None:
        self.mean = space.allowed(torch.zeros_like(space.lower) if start is None else start.mean)
        self.std = space.first_std
        self._space, self._config, self._samples, self._generator = space, config, samples, generator

    def sample(self) -> Float[Tensor, "samples decisions dim"]:
        """Return the mean and samples around it."""
        noise = white_noise(self._space, self._samples, self._generator)
        noise[0] = 0.0
        return self._space.allowed(self.mean + self.std * noise)

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Move the mean to the weighted mean of the samples."""
        if not len(evaluated.energies):
            return
        spread = evaluated.energies.std(correction=0).clamp(min=torch.finfo(torch.float32).tiny)
        weights = torch.softmax(
            (evaluated.energies.min() - evaluated.energies) / (self._config.temperature * spread), dim=0
        )
        self.mean = torch.einsum("s,sdn->dn", weights, evaluated.decisions)
        self.std = self.std * self._config.std_decay

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return the mean."""
        return self.mean
