"""Improved cross-entropy method: noise correlated in time, and elites reused in the next iteration."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.config.planning import IcemConfig
from vjepa2_ac.planning.interfaces import PlanStart
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.planning.solvers.base import EvaluatedPlans


class IcemSolver:
    """Fewer samples per iteration; elites are reused and shifted into the next decision; the result is the best sample.

    The last iteration also evaluates the mean. Components of a sample are independent, decisions are correlated.

    Source: Pinneri et al., Sample-efficient Cross-Entropy Method for Real-time Planning, arXiv 2008.06389, algorithm 1.
    """

    uses_gradients = False

    def __init__(
        self,
        space: SearchSpace,
        config: IcemConfig,
        samples: int,
        iterations: int,
        generator: Generator,
        start: PlanStart | None = None,
    ) -> None:
        self.elites = config.elites
        self.mean = space.allowed(torch.zeros_like(space.lower) if start is None else start.mean)
        self.std = space.first_std
        self._space, self._config, self._generator = space, config, generator
        self._samples, self._iterations, self._iteration = samples, iterations, 0
        self._kept = self.mean[None][:0] if start is None else self._few(start.elites)

    def sample(self) -> Float[Tensor, "samples decisions dim"]:
        """Return new samples, the reused elites, and in the last iteration the mean."""
        count = self._config.new_samples(self._samples, self._iteration)
        noise = coloured_noise(
            count, self._space.decisions, self._space.dim, self._config.noise_exponent, self._generator
        )
        evaluated = [self.mean + self.std * noise, self._kept]
        self._iteration += 1
        if self._iteration == self._iterations:
            evaluated.append(self.mean[None])
        return self._space.allowed(torch.cat(evaluated))

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Fit the distribution to the elites, and keep some of them."""
        best = evaluated.best(self.elites).decisions
        keep = self._config.momentum
        if len(best):
            self.mean = keep * self.mean + (1 - keep) * best.mean(dim=0)
            self._kept = self._few(best)
        if len(best) > 1:
            self.std = keep * self.std + (1 - keep) * best.std(dim=0)

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return None to request the best evaluated decisions."""
        return None

    def _few(self, elites: Float[Tensor, "elites decisions dim"]) -> Float[Tensor, "kept decisions dim"]:
        return elites[: round(self._config.kept * self.elites)]


def coloured_noise(
    samples: int, decisions: int, dim: int, exponent: float, generator: Generator
) -> Float[Tensor, "samples decisions dim"]:
    """Return normal numbers of variance 1 with a power spectrum 1 / frequency^exponent along decisions; 0: white.

    The constant component has the power of the lowest frequency.

    Source: Timmer and König, On generating power law noise, Astronomy and Astrophysics 300 (1995): normal Fourier
    coefficients, scaled.
    """
    frequency = torch.fft.rfftfreq(decisions).clamp(min=1 / decisions)
    scale = frequency ** (-exponent / 2)
    parts = torch.randn(2, samples, dim, len(frequency), generator=generator)
    single = torch.zeros(len(frequency), dtype=torch.bool)  # real coefficients, which stand for one wave
    single[0] = True
    single[-1] = single[-1] or decisions % 2 == 0
    wave = torch.complex(parts[0], parts[1].masked_fill(single, 0.0)) * torch.where(single, 1.0, 0.5**0.5)
    power: Tensor = (scale**2 * torch.where(single, 1.0, 2.0)).sum() / decisions
    noise: Tensor = torch.fft.irfft(wave * scale, n=decisions, norm="ortho").transpose(1, 2)
    return noise / power.sqrt()
