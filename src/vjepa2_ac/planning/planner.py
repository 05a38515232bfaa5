"""The planner: minimises a cost over action sequences, within a time budget and limits, and records the search.

Tensor dimensions: samples (action sequences), decisions (actions that are chosen), steps (model steps; each decision is
repeated for `SearchSpace.repeat` of them), dim (components of an action). All tensors are on the CPU.
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
from vjepa2_ac.planning.search_space import SearchSpace, make_pose_search_space
from vjepa2_ac.planning.solvers import EvaluatedPlans, PlanStart, Samples, Solver
from vjepa2_ac.registry import PLANNERS

Clock = Callable[[], float]  # seconds since an arbitrary start
Cancelled = Callable[[], bool]  # returns whether the plan is no longer needed
Stopped = Literal["finished", "out of time", "no finite energy"]


class SearchCancelledError(Exception):
    """The caller cancelled the search; there is no plan."""


@runtime_checkable
class Cost(Protocol):
    """The interface between planner and model: the cost of action sequences. Lower is better.

    Action sequences whose cost is not finite are never selected. A cost that evaluates in batches may have an attribute
    `progress`, which it calls after each batch with the number of evaluated action sequences and the total of the call.
    """

    def __call__(self, actions: Float[Tensor, "samples steps dim"]) -> Float[Tensor, " samples"]:
        """Return the energy of each action sequence; the planner `gradient` differentiates it."""
        ...


def make_cancellation_check(cancelled: Cancelled, progress: Progress = no_progress) -> Progress:
    """Return a progress callback that raises `SearchCancelledError` in its caller once `cancelled` returns true."""

    def report(done: int, total: int) -> None:
        if cancelled():
            raise SearchCancelledError
        progress(done, total)

    return report


@contextmanager
def report_progress(cost: Cost, progress: Progress, *, num_before: int, num_added: int, total: int) -> Iterator[None]:
    """Report the progress of the evaluation in a `with` block: after each batch that the cost reports, and at the end.

    Args:
        cost: The cost that is evaluated.
        progress: Called with the number of evaluated action sequences and the total.
        num_before: Number of action sequences before this evaluation.
        num_added: Number that this evaluation adds; action sequences that a planner reuses are not counted.
        total: Number of all evaluations.
    """

    def report_batch(done: int, call_total: int) -> None:
        if done < call_total:  # the end is reported after the `with` block, when the energies have been computed
            progress(num_before + num_added * done // call_total, total)

    reporting_cost: Any = cost if hasattr(cost, "progress") else SimpleNamespace(progress=no_progress)
    previous, reporting_cost.progress = reporting_cost.progress, report_batch
    try:
        yield
    finally:
        reporting_cost.progress = previous
    progress(num_before + num_added, total)


@dataclass(frozen=True)
class Iteration:
    """The record of one iteration, for plots."""

    samples: int
    finite: int  # number of samples with a finite energy
    elites: Float[Tensor, "elites decisions dim"]  # best first
    elite_energies: Float[Tensor, " elites"]
    mean: Float[Tensor, "decisions dim"]  # of the distribution after the iteration
    std: Float[Tensor, "decisions dim"]
    seconds: float

    @property
    def lowest(self) -> float:
        """Lowest energy of this iteration; infinite if no energy is finite."""
        return float(self.elite_energies[0]) if len(self.elite_energies) else math.inf

    @property
    def elite_energy(self) -> float:
        """Mean energy of the elites; infinite if there are none."""
        return float(self.elite_energies.mean()) if len(self.elite_energies) else math.inf


@dataclass(frozen=True)
class Plan:
    """The planned actions, and a record of the search."""

    actions: Float[Tensor, "steps dim"]  # always within the limits; zero if `stopped` is "no finite energy"
    energy: float  # predicted for `actions`; NaN if `stopped` is "no finite energy"
    stopped: Stopped  # why the search ended
    iterations: tuple[Iteration, ...]
    mean: Float[Tensor, "decisions dim"]  # final mean of the search, before the gripper is rounded
    repeat: int  # model steps for which each decision is repeated
    planner: str
    seed: int
    evaluations: int  # number of evaluated action sequences
    seconds: float

    def make_next_start(self) -> PlanStart:
        """Return the start of the next search, one model step later.

        Each new decision starts at the mean of this plan's actions in the same model steps. If actions are repeated,
        these steps may belong to two decisions of this plan. After the end of this plan its last action is repeated.
        """
        elites = self.iterations[-1].elites if self.iterations else self.mean[None][:0]
        return PlanStart(_shift_by_step(self.mean[None], self.repeat)[0], _shift_by_step(elites, self.repeat))


def _shift_by_step(decisions: Samples, repeat: int) -> Samples:
    steps = decisions.shape[1] * repeat
    indices = (torch.arange(steps) + 1).clamp(max=steps - 1) // repeat
    return reduce(
        decisions[:, indices], "samples (decisions repeat) dim -> samples decisions dim", "mean", repeat=repeat
    )


def count_samples_per_iteration(config: PlanningConfig) -> tuple[int, ...]:
    """Return the number of new action sequences that each iteration evaluates, without those that icem reuses."""
    zeros = torch.zeros(1, 1)
    solver = _make_solver(config, SearchSpace(zeros, zeros, zeros), Generator(), PlanStart(zeros, zeros[None]))
    return _count_samples(solver, config)


def _make_solver(config: PlanningConfig, space: SearchSpace, generator: Generator, start: PlanStart | None) -> Solver:
    name, options = config.planner.name, config.planner.options
    solver: Solver = PLANNERS.find(name)(space, config, generator, start, **PLANNERS.options(name, options))
    return solver


def _count_samples(solver: Solver, config: PlanningConfig) -> tuple[int, ...]:
    """Return the number of samples of each iteration; a third-party solver need not have `num_samples`."""
    number = getattr(solver, "num_samples", lambda _: config.samples)
    return tuple(itertools.takewhile(bool, map(number, range(config.iterations))))


@dataclass
class Planner:
    """A search for the action sequence of lowest cost. It uses the model only through the cost function.

    For any output of the cost, the actions of a plan are within the limits; if no cost is finite, they are zero.

    Args:
        config: The solver, its number of iterations, and its time budget.
        space: The allowed actions; None: an arm's actions within `planning.limits`.
        clock: Measures the time budget.
        progress: Called with the number of evaluated action sequences and the total: at the start of a search, after
            each batch that the cost reports, and after each iteration.
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
        """Search for a plan, and return it.

        Args:
            cost: The cost of action sequences. It is called without gradients, except by the planner `gradient`.
            generator: A random generator on the CPU. The same seed gives the same plan; the plan records the seed.
            start: Start of the search, from the previous plan (`Plan.make_next_start`), a prior or a policy; None: zero
                motion.
            cancelled: Called before every iteration, and after each batch that the cost reports; returns whether to
                stop.
            space: The allowed actions, with the planner's number of decisions; None: those of the planner.

        Raises:
            SearchCancelledError: `cancelled` returned true.
            ValueError: The cost does not return one number per sample.
        """
        started_s, config = self.clock(), self.config
        space = space or self.space or make_pose_search_space(config)
        solver = _make_solver(config, space, generator, start)
        record: list[Iteration] = []
        counts = _count_samples(solver, config)  # by iteration
        total = sum(counts)
        self.progress(0, total)
        while len(record) < len(counts):
            longest = max((iteration.seconds for iteration in record), default=0.0)
            if record and config.budget_s is not None and self.clock() - started_s + longest > config.budget_s:
                break
            if cancelled():
                raise SearchCancelledError
            num_before, num_added = sum(counts[: len(record)]), counts[len(record)]
            report = make_cancellation_check(cancelled, self.progress)
            with report_progress(cost, report, num_before=num_before, num_added=num_added, total=total):
                record.append(self._run_iteration(solver, cost, space))
        stopped: Stopped = "finished" if len(record) == len(counts) else "out of time"
        actions, energy, num_extra = _select_plan(
            solver.result(), record, cost, space, take_lowest=stopped == "out of time"
        )
        if actions is None:
            actions, stopped = torch.zeros(space.steps, space.dim), "no finite energy"
        return Plan(
            actions=actions,
            energy=energy,
            stopped=stopped,
            iterations=tuple(record),
            mean=solver.mean,
            repeat=space.repeat,
            planner=config.planner.name,
            seed=generator.initial_seed(),
            evaluations=sum(iteration.samples for iteration in record) + num_extra,
            seconds=self.clock() - started_s,
        )

    def _run_iteration(self, solver: Solver, cost: Cost, space: SearchSpace) -> Iteration:
        started_s = self.clock()
        decisions = solver.sample()
        plans = _evaluate(cost, decisions, space, gradients=solver.uses_gradients)
        best = plans.select_best(solver.elites)
        solver.update(plans)
        counts = len(decisions), len(plans.energies)
        return Iteration(*counts, best.decisions, best.energies, solver.mean, solver.std, self.clock() - started_s)


def _evaluate(cost: Cost, decisions: Samples, space: SearchSpace, *, gradients: bool) -> EvaluatedPlans:
    decisions = decisions.detach().requires_grad_(gradients)
    with torch.set_grad_enabled(gradients):
        energies = cost(space.repeat_over_steps(decisions))
        if energies.shape != (len(decisions),):
            raise ValueError(f"energies of shape {tuple(energies.shape)} for {len(decisions)} action sequences")
        finite = torch.isfinite(energies)
        gradient = None
        if gradients:
            (gradient,) = torch.autograd.grad(energies.where(finite, 0.0).sum(), decisions)
            gradient = torch.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0)
    finite = finite.cpu()
    return EvaluatedPlans(decisions.detach()[finite], energies.detach().float().cpu()[finite], gradient)


def _select_plan(
    result: Tensor | None, record: list[Iteration], cost: Cost, space: SearchSpace, *, take_lowest: bool
) -> tuple[Float[Tensor, "steps dim"] | None, float, int]:
    """Return actions, their energy, and the number of extra evaluations.

    The actions are the solver's result, or the best sample if the result has no finite energy. With `take_lowest`
    the one with the lower energy is selected, because after an early stop the mean may still be close to its start.
    """
    best_iteration = min(record, key=lambda iteration: iteration.lowest)
    best = best_iteration.elites[0] if len(best_iteration.elites) else None
    chosen, lowest_energy, num_extra = None, math.nan, 0
    for decisions in (result, best):
        if decisions is None or (chosen is not None and not take_lowest):
            continue
        finished, energies = space.finalize(decisions), [best_iteration.lowest]
        if decisions is not best or not torch.equal(finished, decisions):
            energies = _evaluate(cost, finished[None], space, gradients=False).energies.tolist()
            num_extra += 1
        if energies and not energies[0] >= lowest_energy:
            chosen, lowest_energy = space.repeat_over_steps(finished), energies[0]
    return chosen, lowest_energy, num_extra
