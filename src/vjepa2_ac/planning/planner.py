"""The planner: a cost function in, a plan out. The loop around each solver: time, limits, bad energies, a record.

Axes: samples (action sequences), decisions (chosen actions), steps (of the model; a decision is repeated for
`SearchSpace.repeat` of them), dim (components of an action). All on the CPU.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from einops import reduce
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.planning.search_space import SearchSpace, pose_space
from vjepa2_ac.planning.solvers import EvaluatedPlans, PlanStart, Samples, Solver
from vjepa2_ac.registry import PLANNERS

Clock = Callable[[], float]  # seconds, from anywhere
Cancelled = Callable[[], bool]  # whether nobody waits for the plan any more
Stopped = Literal["finished", "out of time", "no finite energy"]


class SearchCancelledError(Exception):
    """A search was ended from outside before it was done; there is no plan."""


@runtime_checkable
class Cost(Protocol):
    """A planner's only view of a model: the cost of action sequences. Lower is better; NaN is not allowed.

    One that evaluates in parts may have an attribute `progress`, which it calls after each part with the action
    sequences so far, and all of the call.
    """

    def __call__(self, actions: Float[Tensor, "samples steps dim"]) -> Float[Tensor, " samples"]:
        """Return the energy of each action sequence; for `gradient`, as a differentiable function of it."""
        ...


def until_cancelled(cancelled: Cancelled, progress: Progress = no_progress) -> Progress:
    """Return a progress that raises `SearchCancelledError` in what reports to it, once that is cancelled."""

    def report(done: int, total: int) -> None:
        if cancelled():
            raise SearchCancelledError
        progress(done, total)

    return report


@contextmanager
def reporting(cost: Cost, progress: Progress, *, done: int, share: int, total: int) -> Iterator[None]:
    """Report the progress of the one evaluation within a `with` block: its parts, if the cost says so, and its end.

    Args:
        cost: What is evaluated.
        progress: Called with what is done, and the total.
        done: Before the evaluation.
        share: Of the evaluation in the total, however many action sequences it has.
        total: Of all evaluations.
    """

    def evaluated(part: int, of: int) -> None:
        if part < of:  # the last part is done when its energies are there
            progress(done + share * part // of, total)

    parts: Any = cost if hasattr(cost, "progress") else SimpleNamespace(progress=no_progress)
    before, parts.progress = parts.progress, evaluated
    try:
        yield
    finally:
        parts.progress = before
    progress(done + share, total)


@dataclass(frozen=True)
class Iteration:
    """The record of one iteration, for figures."""

    samples: int
    finite: int  # of these, how many have an energy
    elites: Float[Tensor, "elites decisions dim"]  # best first
    elite_energies: Float[Tensor, " elites"]
    mean: Float[Tensor, "decisions dim"]  # of the distribution after it
    std: Float[Tensor, "decisions dim"]
    seconds: float

    @property
    def lowest(self) -> float:
        """The energy of this iteration's best; infinite where there is none."""
        return float(self.elite_energies[0]) if len(self.elite_energies) else math.inf

    @property
    def elite_energy(self) -> float:
        """The mean of the elites' energies; infinite where there are none."""
        return float(self.elite_energies.mean()) if len(self.elite_energies) else math.inf


@dataclass(frozen=True)
class Plan:
    """The planned actions, and how they were found."""

    actions: Float[Tensor, "steps dim"]  # within the limits, always
    energy: float  # of these actions; NaN where the plan is to do nothing
    stopped: Stopped  # with "no finite energy" the actions are zero
    iterations: tuple[Iteration, ...]
    mean: Float[Tensor, "decisions dim"]  # where the search ended, before the gripper is rounded
    repeat: int  # model steps of a decision
    planner: str
    seed: int
    evaluations: int  # number of evaluated action sequences
    seconds: float

    def start_after(self) -> PlanStart:
        """Return the start of the next search, one model step later.

        A decision of the next plan begins at the mean of what this plan would have done in its model steps: if an
        action is repeated, a decision begins between two of this plan's. The last decision is repeated.
        """
        elites = self.iterations[-1].elites if self.iterations else self.mean[None][:0]
        return PlanStart(_one_step_later(self.mean[None], self.repeat)[0], _one_step_later(elites, self.repeat))


def _one_step_later(decisions: Samples, repeat: int) -> Samples:
    steps = decisions.shape[1] * repeat
    places = (torch.arange(steps) + 1).clamp(max=steps - 1) // repeat
    return reduce(
        decisions[:, places], "samples (decisions repeat) dim -> samples decisions dim", "mean", repeat=repeat
    )


def samples_of_iterations(config: PlanningConfig) -> tuple[int, ...]:
    """Return the number of action sequences that each iteration evaluates, without those that icem reuses."""
    one = torch.zeros(1, 1)
    search = _solver(config, SearchSpace(one, one, one), Generator(), PlanStart(one, one[None]))
    return _samples_of(search, config)


def _solver(config: PlanningConfig, space: SearchSpace, generator: Generator, start: PlanStart | None) -> Solver:
    name, given = config.planner.name, config.planner.options
    search: Solver = PLANNERS.find(name)(space, config, generator, start, **PLANNERS.options(name, given))
    return search


def _samples_of(search: Solver, config: PlanningConfig) -> tuple[int, ...]:
    """Return the samples of each iteration; a solver of a third party need not say how many it draws."""
    number = getattr(search, "num_samples", lambda _: config.samples)
    return tuple(itertools.takewhile(bool, map(number, range(config.iterations))))


@dataclass
class Planner:
    """Searches the action sequence of lowest cost, and knows nothing else about the model.

    Whatever the cost returns, the actions of a plan are within the limits; if no cost is finite, they are zero.

    Args:
        config: The solver, and how long it searches.
        space: The allowed actions; None: an arm's actions within `planning.limits`.
        clock: Measures the time budget.
        progress: Called with the number of evaluated action sequences of a plan: at its start, after each part that the
            cost reports, and after each iteration.
    """

    config: PlanningConfig
    space: SearchSpace | None = None
    clock: Clock = time.perf_counter
    progress: Progress = no_progress

    def plan(
        self,
        cost: Cost,
        generator: Generator,
        start: PlanStart | None = None,
        cancelled: Cancelled = lambda: False,
        space: SearchSpace | None = None,
    ) -> Plan:
        """Return the best plan found.

        Args:
            cost: The cost of action sequences. Called without gradients except by planner gradient.
            generator: On the CPU; the same seed gives the same plan. Its initial seed is recorded.
            start: Left by an earlier plan (`Plan.start_after`).
            cancelled: Asked before every iteration, and after each part that the cost reports.
            space: The allowed actions, as many as usual; None: those of the planner.

        Raises:
            SearchCancelledError: It was cancelled.
            ValueError: The cost does not return one number per sample.
        """
        began, config, space = self.clock(), self.config, space or self.space or pose_space(self.config)
        search = _solver(config, space, generator, start)
        record: list[Iteration] = []
        shares = _samples_of(search, config)
        total = sum(shares)
        self.progress(0, total)
        while len(record) < len(shares):
            longest = max((one.seconds for one in record), default=0.0)
            if record and config.budget_s is not None and self.clock() - began + longest > config.budget_s:
                break
            if cancelled():
                raise SearchCancelledError
            done, share = sum(shares[: len(record)]), shares[len(record)]
            watched = until_cancelled(cancelled, self.progress)
            with reporting(cost, watched, done=done, share=share, total=total):
                record.append(self._iterate(search, cost, space))
        stopped: Stopped = "finished" if len(record) == len(shares) else "out of time"
        actions, energy, evaluated = _chosen(search.result(), record, cost, space, lowest=stopped == "out of time")
        if actions is None:
            actions, stopped = torch.zeros(space.steps, space.dim), "no finite energy"
        return Plan(
            actions=actions,
            energy=energy,
            stopped=stopped,
            iterations=tuple(record),
            mean=search.mean,
            repeat=space.repeat,
            planner=config.planner.name,
            seed=generator.initial_seed(),
            evaluations=sum(one.samples for one in record) + evaluated,
            seconds=self.clock() - began,
        )

    def _iterate(self, search: Solver, cost: Cost, space: SearchSpace) -> Iteration:
        began = self.clock()
        decisions = search.sample()
        found = _evaluated(cost, decisions, space, gradients=search.uses_gradients)
        best = found.best(search.elites)
        search.update(found)
        counts = len(decisions), len(found.energies)
        return Iteration(*counts, best.decisions, best.energies, search.mean, search.std, self.clock() - began)


def _evaluated(cost: Cost, decisions: Samples, space: SearchSpace, *, gradients: bool) -> EvaluatedPlans:
    decisions = decisions.detach().requires_grad_(gradients)
    with torch.set_grad_enabled(gradients):
        energies = cost(space.over_steps(decisions))
        if energies.shape != (len(decisions),):
            raise ValueError(f"energies of shape {tuple(energies.shape)} for {len(decisions)} action sequences")
        finite = torch.isfinite(energies)
        downhill = None
        if gradients:
            (downhill,) = torch.autograd.grad(energies.where(finite, 0.0).sum(), decisions)
            downhill = torch.nan_to_num(downhill, nan=0.0, posinf=0.0, neginf=0.0)
    finite = finite.cpu()
    return EvaluatedPlans(decisions.detach()[finite], energies.detach().float().cpu()[finite], downhill)


def _chosen(
    answer: Tensor | None, record: list[Iteration], cost: Cost, space: SearchSpace, *, lowest: bool
) -> tuple[Float[Tensor, "steps dim"] | None, float, int]:
    """Return actions, their energy, and the number of extra evaluations: the result, or else the best sample.

    With `lowest`, the one of lower cost: a mean that has hardly moved may lead nowhere.
    """
    found = min(record, key=lambda one: one.lowest)
    best = found.elites[0] if len(found.elites) else None
    chosen, lowest_energy, evaluated = None, math.nan, 0
    for decisions in (answer, best):
        if decisions is None or (chosen is not None and not lowest):
            continue
        done, energies = space.finished(decisions), [found.lowest]
        if decisions is not best or not torch.equal(done, decisions):
            energies = _evaluated(cost, done[None], space, gradients=False).energies.tolist()
            evaluated += 1
        if energies and not energies[0] >= lowest_energy:
            chosen, lowest_energy = space.over_steps(done), energies[0]
    return chosen, lowest_energy, evaluated
