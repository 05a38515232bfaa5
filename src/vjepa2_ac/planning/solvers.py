"""Solvers: CEM, iCEM, MPPI and gradient descent search for the action sequence of lowest energy.

A solver proposes decisions, receives their energies, and returns a result; `planning.planner` runs the loop. A
third-party solver has the constructor, the attributes and the methods of `Solver`, but need not inherit from it
(docs/extending.md). Its options are the fields of its class `Config`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from einops import reduce
from jaxtyping import Float
from pydantic import BaseModel, Field
from torch import Generator, Tensor

from vjepa2_ac.config.planning import ELITES, PlanningConfig
from vjepa2_ac.config.section import Positive, PositiveInt, Section, Share, ZeroToOne
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.planning.search_space import SearchSpace

_MIN_PRIOR_STD = 0.1  # lower bound on a prior's std, as a fraction of the planner's, since priors are overconfident
Momentum = float | Tensor  # share of the old mean or standard deviation in the new one
Elites = Annotated[int, Field(ge=2)]


@dataclass(frozen=True)
class PlanStart:
    """The start of a search, from the previous plan, an action prior or a policy."""

    mean: Float[Tensor, "decisions dim"]
    elites: Float[Tensor, "elites decisions dim"]
    std: Float[Tensor, "decisions dim"] | None = None  # None: the planner's own

    @classmethod
    def from_samples(cls, samples: Float[Tensor, "samples steps dim"], space: SearchSpace) -> PlanStart:
        """Return a start at the mean of actions that a policy proposes, with their standard deviation.

        Raises:
            InputError: The actions have fewer model steps than a plan, or another number of components.
        """
        if samples.ndim != 3 or not len(samples) or samples.shape[1] < space.steps or samples.shape[2] != space.dim:
            needed = f"one or more samples with at least {counted(space.steps, 'model step')} of {space.dim} numbers"
            raise InputError(where="samples of a policy", found=f"shape {tuple(samples.shape)}", needed=needed)
        steps = samples[:, : space.steps].float()
        decisions = reduce(
            steps, "samples (decisions repeat) dim -> samples decisions dim", "mean", repeat=space.repeat
        )
        return cls(decisions.mean(dim=0), decisions, decisions.std(dim=0, correction=0))


OptionalStart = PlanStart | None
Samples = Float[Tensor, "samples decisions dim"]


@dataclass(frozen=True)
class EvaluatedPlans:
    """Decisions with a finite energy, possibly none, and their energies."""

    decisions: Float[Tensor, "finite decisions dim"]
    energies: Float[Tensor, " finite"]
    gradients: Samples | None = None  # of all evaluated samples; 0 where the energy is not finite

    def select_best(self, count: int) -> EvaluatedPlans:
        """Return the decisions of lowest energy, best first; fewer if there are not enough."""
        order = self.energies.sort(stable=True).indices[:count]
        return EvaluatedPlans(self.decisions[order], self.energies[order])


class Solver:
    """The search for one plan, from the first samples to the result.

    Args:
        space: The allowed decisions.
        config: Settings for planning.
        generator: Random generator of the samples.
        start: The start of the search; None: zero motion.
        options: An instance of the solver's `Config`; None if it has no options.
    """

    uses_gradients = False
    Config: type[BaseModel] | None = None  # the class of the options; None: no options
    mean: Float[Tensor, "decisions dim"]  # of the distribution from which samples are drawn
    std: Float[Tensor, "decisions dim"]

    def __init__(
        self,
        space: SearchSpace,
        config: PlanningConfig,
        generator: Generator,
        start: OptionalStart = None,
        options: Any = None,
    ) -> None:
        self._space, self._config, self._generator, self._options = space, config, generator, options
        self.mean = space.clip(torch.zeros_like(space.lower) if start is None else start.mean)
        self.std = space.first_std * self._fill_action(getattr(options, "start_std", 1.0), gripper=1.0)
        if start is not None and start.std is not None:
            self.std = torch.minimum(torch.maximum(start.std, _MIN_PRIOR_STD * self.std), self.std)
        self.begin(start)

    @property
    def elites(self) -> int:
        """Number of best decisions that are recorded."""
        return int(getattr(self._options, "elites", ELITES))

    def begin(self, start: OptionalStart) -> None:
        """Prepare the search. The constructor calls this method last."""

    def num_samples(self, iteration: int) -> int:  # noqa: ARG002 - the same in all iterations
        """Return the number of new decisions that an iteration (from 0) evaluates; 0 ends the search."""
        return self._config.samples

    def sample(self) -> Samples:
        """Return the next decisions to evaluate, all within the limits."""
        raise NotImplementedError

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Update the distribution; it must not change if no energy is finite."""
        raise NotImplementedError

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return the current result; None: the planner uses the best evaluated decisions."""
        return None

    def _fill_action(self, value: float, *, gripper: float) -> Float[Tensor, " dim"]:
        """Return a vector with `gripper` for the gripper of an action and `value` for all other components."""
        numbers = torch.full((self._space.dim,), value)
        if self._space.gripper is not None:
            numbers[self._space.gripper] = gripper
        return numbers

    def _sample_around_mean(self, *, try_mean: bool) -> Samples:
        noise = draw_white_noise(self._space, self._config.samples, self._generator)
        noise[: int(try_mean)] = 0.0
        return self._space.clip(self.mean + self.std * noise)

    def _fit_to_elites(
        self, best: Float[Tensor, "elites decisions dim"], keep_mean: Momentum, keep_std: Momentum
    ) -> None:
        """Move the distribution towards the elites; a single elite does not change the standard deviation."""
        if len(best):
            self.mean = keep_mean * self.mean + (1 - keep_mean) * best.mean(dim=0)
        if len(best) > 1:
            self.std = keep_std * self.std + (1 - keep_std) * best.std(dim=0)


def draw_white_noise(space: SearchSpace, samples: int, generator: Generator) -> Samples:
    """Return independent standard normal numbers, zero for components that are fixed in all decisions.

    The numbers are drawn in upstream's order (decision by decision, free components only), so that the same seed gives
    upstream's samples.
    """
    noise = torch.zeros(samples, space.decisions, space.dim)
    for decision in range(space.decisions):
        noise[:, decision, space.free] = torch.randn(samples, len(space.free), generator=generator)
    return noise


class Sampling(Section):
    """Options of the planners that draw samples."""

    start_std: Positive = 1.0
    """Standard deviation of the first samples, as a fraction of the limits of position and rotation."""


class CemSolver(Solver):
    """CEM as upstream: samples are clipped, and mean and standard deviation move towards the elites with a momentum.

    Differences from upstream: a warm start is possible, samples without a finite energy are never elites, and a fixed
    gripper has its exact value in the result as well.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, cem.
    """

    class Config(Sampling):
        """Options of cem: the cross-entropy method; the defaults are upstream's."""

        elites: Elites = ELITES
        """Best samples, which decide the next mean and standard deviation."""
        momentum_mean: Share = 0.15
        """Share of the old mean in the new one."""
        momentum_std: Share = 0.15
        """Share of the old standard deviation in the new one."""
        momentum_mean_gripper: Share = 0.15
        """The same share for the gripper."""
        momentum_std_gripper: Share = 0.15
        """The same share for the gripper."""
        try_mean: bool = False
        """Whether the mean itself replaces an iteration's first sample (facebookresearch/jepa-wms)."""

    def sample(self) -> Samples:
        """Return samples of the distribution, clipped to the limits."""
        return self._sample_around_mean(try_mean=self._options.try_mean)

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Fit the distribution to the elites."""
        options = self._options
        keep_mean = self._fill_action(options.momentum_mean, gripper=options.momentum_mean_gripper)
        keep_std = self._fill_action(options.momentum_std, gripper=options.momentum_std_gripper)
        self._fit_to_elites(evaluated.select_best(self.elites).decisions, keep_mean, keep_std)

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return the mean."""
        return self.mean


class IcemSolver(Solver):
    """Improved CEM: fewer samples in each iteration, reused elites, and coloured noise; the result is the best sample.

    With `warm_start` the next search also reuses elites, shifted by one model step. The last iteration also evaluates
    the mean. The noise is correlated along the plan, but independent between the components of an action.

    Source: Pinneri et al., Sample-efficient Cross-Entropy Method for Real-time Planning, arXiv 2008.06389, algorithm 1.
    """

    class Config(Sampling):
        """Options of icem: the improved cross-entropy method (arXiv 2008.06389); the defaults are the paper's."""

        elites: Elites = ELITES
        """Best samples, which decide the next mean and standard deviation."""
        momentum: Share = 0.1
        """Share of the old mean and standard deviation in the new ones."""
        noise_exponent: Annotated[float, Field(ge=0.0, le=8.0)] = 2.0
        """Exponent of the noise's power spectrum, 1 / frequency^exponent along the plan. 0: white; larger: smoother."""
        shrink: Annotated[float, Field(ge=1.0)] = 1.25
        """Factor by which the number of samples decreases per iteration, down to twice the number of elites."""
        kept: ZeroToOne = 0.3
        """Share of the elites that are reused, in the next iteration and, with warm_start, in the next decision."""

    def begin(self, start: OptionalStart) -> None:
        """Reuse the elites of the start, if there is one."""
        self._iteration = 0
        self._reused = self.mean[None][:0] if start is None else self._select_reused(start.elites)

    def num_samples(self, iteration: int) -> int:
        """Return the number of new decisions, which decreases with each iteration."""
        return max(int(self._config.samples * self._options.shrink**-iteration), 2 * self.elites)

    def sample(self) -> Samples:
        """Return new samples, the reused elites, and in the last iteration the mean."""
        options, space = self._options, self._space
        noise = draw_coloured_noise(
            self.num_samples(self._iteration), space.decisions, space.dim, options.noise_exponent, self._generator
        )
        evaluated = [self.mean + self.std * noise, self._reused]
        self._iteration += 1
        if self._iteration == self._config.iterations:
            evaluated.append(self.mean[None])
        return space.clip(torch.cat(evaluated))

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Fit the distribution to the elites, and reuse some of them in the next iteration."""
        best, keep = evaluated.select_best(self.elites).decisions, self._options.momentum
        self._fit_to_elites(best, keep, keep)
        if len(best):
            self._reused = self._select_reused(best)

    def _select_reused(self, elites: Float[Tensor, "elites decisions dim"]) -> Float[Tensor, "reused decisions dim"]:
        return elites[: round(self._options.kept * self.elites)]


def draw_coloured_noise(samples: int, decisions: int, dim: int, exponent: float, generator: Generator) -> Samples:
    """Return normal numbers of variance 1 with a power spectrum 1 / frequency^exponent along the decisions.

    An exponent of 0 gives white noise. The constant component has the power of the lowest frequency.

    Source: Timmer and König, On generating power law noise, Astronomy and Astrophysics 300 (1995): normal Fourier
    coefficients, scaled.
    """
    frequency = torch.fft.rfftfreq(decisions).clamp(min=1 / decisions)
    scale = frequency ** (-exponent / 2)
    coefficients = torch.randn(2, samples, dim, len(frequency), generator=generator)
    is_real = torch.zeros(len(frequency), dtype=torch.bool)  # true for the constant and the Nyquist frequency
    is_real[0] = True
    is_real[-1] = is_real[-1] or decisions % 2 == 0
    wave = torch.complex(coefficients[0], coefficients[1].masked_fill(is_real, 0.0)) * torch.where(
        is_real, 1.0, 0.5**0.5
    )
    power: Tensor = (scale**2 * torch.where(is_real, 1.0, 2.0)).sum() / decisions
    noise: Tensor = torch.fft.irfft(wave * scale, n=decisions, norm="ortho").transpose(1, 2)
    return noise / power.sqrt()


class MppiSolver(Solver):
    """MPPI: the new mean weights the samples by exp(-energy / temperature), and the noise decays by a fixed factor.

    The mean itself is also evaluated. The paper's control cost is omitted, because the limits bound the actions.

    Source: Williams et al., Information Theoretic MPC for Model-Based Reinforcement Learning, ICRA 2017, algorithm 2.
    """

    class Config(Sampling):
        """Options of mppi: model predictive path integral control."""

        temperature: Positive = 0.1
        """Temperature of the weights exp(-energy / temperature), in standard deviations of the samples' energies."""
        std_decay: Annotated[float, Field(gt=0.0, le=1.0)] = 0.8
        """Factor by which the standard deviation is multiplied after each iteration; 1: constant."""

    def sample(self) -> Samples:
        """Return the mean and samples around it."""
        return self._sample_around_mean(try_mean=True)

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Move the mean to the weighted mean of the samples."""
        energies, mppi = evaluated.energies, self._options
        if not len(energies):
            return
        spread = energies.std(correction=0).clamp(min=torch.finfo(torch.float32).tiny)
        weights = torch.softmax((energies.min() - energies) / (mppi.temperature * spread), dim=0)
        self.mean = torch.einsum("s,sdn->dn", weights, evaluated.decisions)
        self.std = self.std * mppi.std_decay

    def result(self) -> Float[Tensor, "decisions dim"] | None:
        """Return the mean."""
        return self.mean


class PriorSolver(Solver):
    """The action prior's proposal, evaluated once, without a search.

    Raises:
        InputError: There is no start, because no prior is loaded.
    """

    def num_samples(self, iteration: int) -> int:
        """Return 1 for the first iteration, and 0 for the second, which ends the search."""
        return int(iteration == 0)

    def begin(self, start: OptionalStart) -> None:
        """Refuse a search without a prior."""
        if start is None:
            raise InputError(
                where="planning.planner",
                found="prior, but no action prior is loaded",
                needed="planning.prior, or a planner that searches, such as cem",
            )

    def sample(self) -> Samples:
        """Return the prior's mean."""
        return self.mean[None]

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Ignore the energies: the proposal is not improved."""


class GradientSolver(Solver):
    """Gradient descent: Adam on decisions in units of their limits, clipped to the limits after every step.

    Several descents run independently. The first begins at the best elite of the previous plan, not at the mean of its
    elites, because these may be different solutions. The result is the best of all evaluated decisions.
    """

    uses_gradients = True

    class Config(Section):
        """Options of gradient: gradient descent through the model."""

        starts: PositiveInt = 8
        """Sequences that are optimised in parallel: the first starts from the previous plan (or zero motion), the
        others from random sequences."""
        learning_rate: Positive = 0.1
        """Learning rate of Adam at the first iteration, as a fraction of the limits; it decays linearly to zero."""

    @property
    def elites(self) -> int:
        """Number of recorded decisions: one for each descent."""
        return int(self._options.starts)

    def begin(self, start: OptionalStart) -> None:
        """Draw the starting points of the descents."""
        space, config, options = self._space, self._config, self._options
        noise = draw_white_noise(space, options.starts, self._generator)
        noise[0] = 0.0
        origin = torch.zeros_like(space.lower)
        if start is not None:
            origin = start.elites[0] if len(start.elites) else start.mean
        half_range = (space.upper - space.lower) / 2
        self._unit = torch.where(half_range > 0, half_range, 1.0)
        self._scaled = space.clip(origin + self.std * noise) / self._unit
        self._adam = torch.optim.Adam([self._scaled], lr=options.learning_rate)
        self._schedule = torch.optim.lr_scheduler.LambdaLR(
            self._adam, lambda step: max(0.0, 1 - step / config.iterations)
        )

    def num_samples(self, iteration: int) -> int:  # noqa: ARG002 - the same in all iterations
        """Return the number of descents."""
        return self.elites

    def sample(self) -> Samples:
        """Return the current decisions of each descent."""
        return self._space.clip(self._scaled * self._unit)

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Take one gradient step.

        Raises:
            ValueError: There are no gradients.
        """
        if evaluated.gradients is None:
            raise ValueError("the cost function returned no gradients")
        self._scaled.grad = evaluated.gradients * self._unit
        self._adam.step()
        self._schedule.step()
        with torch.no_grad():
            self._scaled.copy_(self.sample() / self._unit)
            descents = self.sample()
            self.mean, self.std = descents.mean(dim=0), descents.std(dim=0, correction=0)
