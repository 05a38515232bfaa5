"""Cross-entropy method: sample from a normal distribution, fit it to the elites, repeat."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.config.planning import CemConfig
from vjepa2_ac.planning.interfaces import PlanStart
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.planning.solvers.base import EvaluatedPlans, white_noise


class CemSolver:
    """As upstream: samples are clipped, mean and standard deviation keep a share of their old values.

    Differs from upstream: a warm start is possible, samples without a finite energy are no elites, and a fixed gripper
    is exact in the result as well.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, cem.
    """

    uses_gradients = False

    def __init__(
        self, space: SearchSpace, config: CemConfig, samples: int, generator: Generator, start: PlanStart | None = None
    ) -> None:
        self.elites = config.elites
        self.mean = space.allowed(torch.zeros_like(space.lower) if start is None else start.mean)
        self.std = space.first_std
        self._space, self._samples, self._generator = space, samples, generator
        self._answers_mean, self._tries_mean = config.answer == "mean", config.try_mean
        self._keep_mean = _momentum(space, config.momentum_mean, config.momentum_mean_gripper)
        self._keep_std = _momentum(space, config.momentum_std, config.momentum_std_gripper)

    def sample(self) -> Float[Tensor, "samples decisions dim"]:
        """Return samples of the distribution, clipped to the allowed set."""
        noise = white_noise(self._space, self._samples, self._generator)
        if self._tries_mean:
            noise[0] = 0.0
        return self._space.allowed(self.mean + self.std * noise)

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Fit the distribution to the elites; a single one does not change the standard deviation."""
        best = evaluated.best(self.elites).decisions
        if len(best):
            self.mean = self._keep_mean * self.mean + (1 - self._keep_mean) * best.mean(dim=0)
        if len(best) > 1:
            self.std = self._keep_std * self.std + (1 - self._keep_std) * best.std(dim=0)

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return the mean, or None to request the best."""
        return self.mean if self._answers_mean else None


def _momentum(space: SearchSpace, others: float, gripper: float) -> Float[Tensor, " dim"]:
    momentum = torch.full((space.dim,), others)
    if space.gripper is not None:
        momentum[space.gripper] = gripper
    return momentum
