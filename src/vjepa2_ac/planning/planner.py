"""The planner: the loop around each solver, with a time budget, limits, bad energies and a record of all steps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.planning.interfaces import Cost, Iteration, Plan, PlanStart, SearchCancelledError, Stopped, reporting
from vjepa2_ac.planning.search_space import SearchSpace, pose_space
from vjepa2_ac.planning.solvers import EvaluatedPlans, Solver
from vjepa2_ac.registry import PLANNERS

Clock = Callable[[], float]  # seconds, from anywhere
Cancelled = Callable[[], bool]  # whether nobody waits for the plan any more


class Planner:
    """Searches the action sequence of lowest cost, and knows nothing else about the model.

    Whatever the cost returns, the actions of a plan are within the limits; if no cost is finite, they are zero.
    """

    def __init__(
        self,
        config: PlanningConfig,
        space: SearchSpace | None = None,
        clock: Clock = time.perf_counter,
        progress: Progress = no_progress,
    ) -> None:
        """Select a planner.

        Args:
            config: The solver, and how long it searches.
            space: The allowed actions; None: an arm's actions within `planning.limits`.
            clock: Measures the time budget.
            progress: Called with the number of evaluated action sequences of a plan: at its start, after each part that
                the cost reports, and after each iteration.
        """
        self.config = config
        self.space = pose_space(config) if space is None else space
        self.clock, self.progress = clock, progress

    def plan(
        self, cost: Cost, generator: Generator, start: PlanStart | None = None, cancelled: Cancelled = lambda: False
    ) -> Plan:
        """Return the best plan found.

        Args:
            cost: The cost of action sequences. Called without gradients except by planner gradient.
            generator: On the CPU; the same seed gives the same plan. Its initial seed is recorded.
            start: Left by an earlier plan (`Plan.start_after`).
            cancelled: Asked before every iteration.

        Raises:
            SearchCancelledError: It was cancelled.
            ValueError: The cost does not return one number per sample, or `start` is of another shape.
        """
        began = self.clock()
        if start is not None and start.mean.shape != self.space.lower.shape:
            raise ValueError(f"a start of {tuple(start.mean.shape)} for {tuple(self.space.lower.shape)} decisions")
        options = PLANNERS.options(self.config.planner, self.config.planner_options)
        search: Solver = PLANNERS.find(self.config.planner)(self.space, self.config, generator, start, **options)
        record: list[Iteration] = []
        best = _Best()
        shares, total = self.config.sequences, sum(self.config.sequences)
        self.progress(0, total)
        while len(record) < self.config.iterations and self._has_time(began, record):
            if cancelled():
                raise SearchCancelledError
            done, share = sum(shares[: len(record)]), shares[len(record)]
            with reporting(cost, self.progress, done=done, share=share, total=total):
                record.append(self._iterate(search, cost, best))
        stopped: Stopped = "finished" if len(record) == self.config.iterations else "out of time"
        actions, energy, evaluated = self._chosen(search.result(), best, cost, lowest=stopped == "out of time")
        if actions is None:
            actions, stopped = torch.zeros(self.space.steps, self.space.dim), "no finite energy"
        return Plan(
            actions=actions,
            energy=energy,
            stopped=stopped,
            iterations=tuple(record),
            mean=search.mean,
            repeat=self.space.repeat,
            planner=self.config.planner,
            seed=generator.initial_seed(),
            evaluations=sum(one.samples for one in record) + evaluated,
            seconds=self.clock() - began,
        )

    def _has_time(self, began: float, record: list[Iteration]) -> bool:
        """Return whether an iteration as long as the longest so far would end within the budget."""
        if self.config.budget_s is None or not record:
            return True
        return self.clock() - began + max(one.seconds for one in record) <= self.config.budget_s

    def _iterate(self, search: Solver, cost: Cost, best: _Best) -> Iteration:
        began = self.clock()
        decisions = search.sample()
        evaluated = self._try(cost, decisions, gradients=search.uses_gradients)
        elites = evaluated.best(search.elites)
        if len(elites.energies) and float(elites.energies[0]) < best.energy:
            best.decisions, best.energy = elites.decisions[0], float(elites.energies[0])
        search.update(evaluated)
        found = bool(len(elites.energies))
        return Iteration(
            samples=len(decisions),
            finite=len(evaluated.energies),
            lowest=float(elites.energies[0]) if found else math.inf,
            elite_energy=float(elites.energies.mean()) if found else math.inf,
            elites=elites.decisions,
            elite_energies=elites.energies,
            mean=search.mean,
            std=search.std,
            seconds=self.clock() - began,
        )

    def _try(self, cost: Cost, decisions: Float[Tensor, "samples decisions dim"], *, gradients: bool) -> EvaluatedPlans:
        decisions = decisions.detach().requires_grad_(gradients)
        with torch.set_grad_enabled(gradients):
            energies = cost(self.space.over_steps(decisions))
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
        self, answer: Tensor | None, best: _Best, cost: Cost, *, lowest: bool
    ) -> tuple[Float[Tensor, "steps dim"] | None, float, int]:
        """Return actions, their energy, and the number of extra evaluations: the result, or else the best sample.

        With `lowest`, the one of lower cost: a mean that has hardly moved may lead nowhere.
        """
        chosen, lowest_energy, evaluated = None, math.nan, 0
        for decisions in (answer, best.decisions):
            if decisions is None or (chosen is not None and not lowest):
                continue
            done, energies = self.space.finished(decisions), [best.energy]
            if decisions is not best.decisions or not torch.equal(done, decisions):
                energies = self._try(cost, done[None], gradients=False).energies.tolist()
                evaluated += 1
            if energies and not energies[0] >= lowest_energy:
                chosen, lowest_energy = self.space.over_steps(done), energies[0]
        return chosen, lowest_energy, evaluated


@dataclass
class _Best:
    """The best decisions evaluated so far."""

    decisions: Tensor | None = None
    energy: float = math.inf
