"""The energy of what could be done next, and a plan: from any place, imagined by one model, towards a goal frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.episode import Progress
from vjepa2_ac.explore.explorer import Explorer, Place
from vjepa2_ac.planning.energy import EnergySlice, Goal, Scene, WorldModelCost, distance, energy_slices
from vjepa2_ac.planning.planner import Cancelled, Plan, Planner, until_cancelled
from vjepa2_ac.planning.search_space import SearchSpace, search_space

_NODES = 7  # of an energy map along each axis


@dataclass(frozen=True, eq=False)
class PlanFound:
    """A plan, and what its search saw."""

    plan: Plan
    energy_now: float  # of what is imagined now
    best: tuple[Float[Tensor, "tokens dim"], ...]  # imagined end of the best sample of each iteration


class Search:
    """Searches from places that are imagined."""

    def __init__(self, explorer: Explorer, config: PlanningConfig) -> None:
        """Prepare.

        Args:
            explorer: With the models.
            config: How plans are searched, and what energy is.
        """
        self._explorer, self.config = explorer, config

    def space(self, steps: int = 1) -> SearchSpace:
        """Return the allowed actions of a plan.

        Raises:
            InputError: There are no limits for vectors.
        """
        return search_space(self._of(steps), self._explorer.spaces.state)

    def _of(self, steps: int) -> PlanningConfig:
        return self.config.model_copy(update={"horizon": steps, "action_repeat": 1})

    @property
    def axes(self) -> tuple[int, ...]:
        """The numbers of an action over which energy is shown: of a pose the position, else the first ones."""
        is_pose = self._explorer.spaces.state.is_pose
        return (0, 1, 2) if is_pose else tuple(self.space().free[:3].tolist())

    def energy(self, latents: Float[Tensor, "tokens dim"], goal: Float[Tensor, "tokens dim"]) -> float:
        """Return the distance of a frame to a goal."""
        return float(distance(latents[None], goal[None], self.config.energy))

    def maps(
        self, teller: int, place: Place, goal: Tensor, action: Sequence[float], progress: Progress, cancelled: Cancelled
    ) -> tuple[EnergySlice, ...]:
        """Return the energy after one more action, over each pair of its numbers.

        Raises:
            InputError: There are no limits.
            SearchCancelledError: It was cancelled.
        """
        around = torch.tensor([list(action)], dtype=torch.float32)
        with self._cost(teller, place, goal) as cost:
            watched = until_cancelled(cancelled, progress)
            return energy_slices(cost, around, self.space(), self.axes, nodes=_NODES, progress=watched)

    def plan(
        self, teller: int, place: Place, goal: Tensor, steps: int, progress: Progress, cancelled: Cancelled
    ) -> PlanFound:
        """Return a plan of some steps.

        Raises:
            InputError: There are no limits.
            SearchCancelledError: It was cancelled.
        """
        planner = Planner(self._of(steps), self.space(steps), progress=progress)
        with self._cost(teller, place, goal) as cost, torch.no_grad():
            plan = planner.plan(cost, torch.Generator().manual_seed(0), cancelled=cancelled)
            elites = torch.stack([one.elites[0] for one in plan.iterations if len(one.elites)][-8:] or [plan.actions])
            best, _ = cost.imagine(elites)
        now = self.energy(self._explorer.imagined(teller, place), goal)
        return PlanFound(plan, now, tuple(best[:, -1].float()))

    @contextmanager
    def _cost(self, teller: int, place: Place, goal: Tensor) -> Iterator[WorldModelCost]:
        """Yield the energy from a place; what is imagined there counts as seen."""
        explorer = self._explorer
        state = torch.from_numpy(np.array(explorer.states(place)[-1], dtype=np.float32))
        scene = Scene(explorer.imagined(teller, place), state, explorer.camera(place))
        with explorer.autocast(), explorer.contenders[teller].switched():
            goals, config = Goal(goal[None]), self.config.energy
            yield WorldModelCost(explorer.model(teller), scene, goals, config, spaces=explorer.spaces)
