"""A planning decision: one planned action, with all data needed to judge it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8

from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.planning.energy_slices import (
    FEWEST_NODES,
    EnergySlice,
    energy_slices,
    fitting_nodes,
    sequences_of_slices,
)
from vjepa2_ac.planning.goals.sub_goals import SubGoal
from vjepa2_ac.planning.interfaces import Cost, Plan
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.spaces import StateSpace


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """The observation and the goal."""

    start: UInt8[np.ndarray, "height width 3"]
    state: Float[np.ndarray, " numbers"]  # measured; a pose is refused or taken by the controller
    goals: tuple[np.ndarray, ...]
    durations: tuple[int, ...] = ()  # model steps of each goal but the last
    mask: np.ndarray | None = None  # region of the image that counts: height x width
    sub_goals: tuple[SubGoal, ...] = ()  # of these images, with rules instead of durations; empty: durations apply

    @classmethod
    def of_sub_goals(
        cls, start: np.ndarray, state: np.ndarray, goals: Sequence[SubGoal], mask: np.ndarray | None = None
    ) -> PlanRequest:
        """Return the request to plan towards goals with rules of their own; the first one applies."""
        return cls(start, state, tuple(goal.image for goal in goals), mask=mask, sub_goals=tuple(goals))

    def with_equal_durations(self, horizon: int) -> PlanRequest:
        """Return the same request with the steps divided equally among the goals, the last one taking the rest."""
        return replace(self, durations=(max(1, horizon // len(self.goals)),) * (len(self.goals) - 1))


@dataclass(frozen=True)
class Seconds:
    """Durations in seconds."""

    goals: float  # encoding them
    decision: float  # encoding the start, and planning
    slices: float


@dataclass(frozen=True, eq=False)
class PlanResult:
    """A decision, with its alternatives."""

    question: PlanRequest
    controller: Controller
    decision: Decision
    actions: Float[np.ndarray, "steps dim"]  # changes of the state; zero where the decision is to do nothing
    states: Float[np.ndarray, "steps+1 dim"]  # predicted states along them
    doing_nothing: float  # predicted energy of no motion; NaN if it was not computed
    slices: tuple[EnergySlice, ...]  # empty if there is no plan, or none were requested
    seconds: Seconds

    @property
    def space(self) -> SearchSpace:
        """The allowed actions."""
        return self.controller.space

    @property
    def state_space(self) -> StateSpace:
        """What the numbers of a state are."""
        return self.controller.spaces.state

    @property
    def shown_axes(self) -> tuple[int, ...]:
        """The numbers of an action that figures show."""
        return self.controller.shown_axes

    @property
    def unused_goals(self) -> tuple[int, ...]:
        """Goals that do not affect the plan: they begin after its end, or only its last step counts."""
        ahead = self.decision.goals
        counted = set(ahead[-1:] if self.controller.config.energy.steps == "last" else ahead)
        return tuple(place for place in range(len(self.question.goals)) if place not in counted)


def decide(
    controller: Controller, question: PlanRequest, *, nodes: int | None = 0, reporter: Reporter = SILENT
) -> PlanResult:
    """Make one decision, and evaluate its alternatives.

    Args:
        controller: The planner; it is reset.
        question: The observation and the goal.
        nodes: Of an energy slice along each axis; below 3: no slices; None: as many as evaluate no more action
            sequences than the search did.
        reporter: Shows the progress of the slices, or why there are none. (The search has the controller's.)

    Raises:
        InputError: An image, the state or the mask is invalid.
        ValueError: The number of durations is not the number of goals minus one.
    """
    began = time.perf_counter()
    if question.sub_goals:
        controller.follow(question.sub_goals, mask=question.mask)
    else:
        controller.reset(*question.goals, durations=question.durations, mask=question.mask)
    ready = time.perf_counter()
    controller.act(question.start, question.state)
    decided = time.perf_counter()
    decision = controller.decision
    if decision is None:
        raise ValueError("a controller that acted has decided")
    still = np.nan
    slices: tuple[EnergySlice, ...] = ()
    if decision.plan is not None and decision.cost is not None:
        with torch.no_grad():
            still = float(decision.cost(torch.zeros_like(decision.plan.actions)[None])[0])
        if decision.why != "no finite energy":
            slices = _slices(controller, decision.plan, decision.cost, nodes, reporter)
    steps, dim = controller.space.steps, controller.space.dim
    return PlanResult(
        question=question,
        controller=controller,
        decision=decision,
        actions=np.zeros((steps, dim)) if decision.plan is None else decision.plan.actions.double().numpy(),
        states=np.tile(question.state, (steps + 1, 1)) if decision.states is None else decision.states,
        doing_nothing=still,
        slices=slices,
        seconds=Seconds(ready - began, decided - ready, time.perf_counter() - decided),
    )


def _slices(
    controller: Controller, plan: Plan, cost: Cost, nodes: int | None, reporter: Reporter
) -> tuple[EnergySlice, ...]:
    axes, searched = controller.shown_axes, sum(one.samples for one in plan.iterations)
    if nodes is None:
        nodes = fitting_nodes(searched, len(axes))
        if not nodes:
            needed = sequences_of_slices(FEWEST_NODES, len(axes))
            reporter.note(f"No energy maps: they take {needed} action sequences or more, the search {searched}.")
    if nodes < 3 or len(axes) < 2:
        return ()
    task = reporter.task("energy maps", "action sequences")
    return energy_slices(cost, plan.actions, controller.space, axes, nodes=nodes, progress=task)
