"""Interfaces of planners: a cost function in, a plan out.

Axes: samples (action sequences), decisions (chosen actions), steps (of the model; a decision is repeated for
`SearchSpace.repeat` of them), dim (components of an action). All on the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from einops import reduce
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.episode import Progress

Stopped = Literal["finished", "out of time", "no finite energy"]


class SearchCancelledError(Exception):
    """A search was ended from outside before it was done; there is no plan."""


@runtime_checkable
class Cost(Protocol):
    """A planner's only view of a model: the cost of action sequences. Lower is better; NaN is not allowed."""

    def __call__(self, actions: Float[Tensor, "samples steps dim"]) -> Float[Tensor, " samples"]:
        """Return the energy of each action sequence; for `gradient`, as a differentiable function of it."""
        ...


@runtime_checkable
class ReportingCost(Cost, Protocol):
    """A cost that evaluates in parts, and says how far it is."""

    progress: Progress  # called after each part with the action sequences so far, and all of the call


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

    if isinstance(cost, ReportingCost):
        before, cost.progress = cost.progress, evaluated
        try:
            yield
        finally:
            cost.progress = before
    else:
        yield
    progress(done + share, total)


@dataclass(frozen=True)
class PlanStart:
    """The start of a search: what the last decision left."""

    mean: Float[Tensor, "decisions dim"]
    elites: Float[Tensor, "elites decisions dim"]


@dataclass(frozen=True)
class Iteration:
    """The record of one iteration, for figures."""

    samples: int
    finite: int  # of these, how many have an energy
    lowest: float  # energy of this iteration's best; infinite where there is none
    elite_energy: float  # mean of the elites' energies; infinite where there are none
    elites: Float[Tensor, "elites decisions dim"]  # best first
    elite_energies: Float[Tensor, " elites"]
    mean: Float[Tensor, "decisions dim"]  # of the distribution after it
    std: Float[Tensor, "decisions dim"]
    seconds: float


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

    def start_after(self, done: int) -> PlanStart:
        """Return the start of the next search after some model steps of this plan were done.

        A decision of the next plan begins at the mean of what this plan would have done in its model steps: if an
        action is repeated, a decision begins between two of this plan's. The last decision is repeated for the steps
        that this plan did not reach.

        Raises:
            ValueError: A negative number of steps.
        """
        if done < 0:
            raise ValueError(f"{done} steps were done")
        elites = self.iterations[-1].elites if self.iterations else self.mean[None][:0]
        return PlanStart(_later(self.mean[None], done, self.repeat)[0], _later(elites, done, self.repeat))


def _later(
    decisions: Float[Tensor, "samples decisions dim"], by: int, repeat: int
) -> Float[Tensor, "samples decisions dim"]:
    steps = decisions.shape[1] * repeat
    places = (torch.arange(steps) + by).clamp(max=steps - 1) // repeat
    at_steps = decisions[:, places]
    return reduce(at_steps, "samples (decisions repeat) dim -> samples decisions dim", "mean", repeat=repeat)
