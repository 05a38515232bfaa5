"""Problems whose optimum is known, and spaces to search it in."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.planning.planner import Plan, Planner
from vjepa2_ac.planning.search_space import SearchSpace

PLANNERS = ("cem", "icem", "mppi", "gradient")


def space(decisions: int = 1, dim: int = 2, reach: float = 1.0) -> SearchSpace:
    """Return a box around zero."""
    upper = torch.full((decisions, dim), reach)
    return SearchSpace(-upper, upper, upper)


def config(
    planner: str, iterations: int = 30, samples: int = 200, options: dict[str, Any] | None = None, **changes: Any
) -> PlanningConfig:
    """Return settings that are good enough for a few numbers."""
    usual = {"gradient": {"starts": 16, "learning_rate": 0.1}, "mppi": {"std_decay": 0.85}}.get(planner, {})
    component = {"name": planner, "options": options or usual}
    return PlanningConfig(planner=component, iterations=iterations, samples=samples, **changes)


def solve(planner: str, cost: Callable[[Tensor], Tensor], where: SearchSpace, seed: int = 0, **changes: Any) -> Plan:
    """Return the plan of least cost in a space."""
    generator = torch.Generator().manual_seed(seed)
    return Planner(config(planner, **changes), where).plan(cost, generator)


def parabola(target: Tensor) -> Callable[[Tensor], Tensor]:
    """Return the squared distance of an action sequence from the target."""
    return lambda actions: (actions - target).square().sum(dim=(1, 2))


def rosenbrock(actions: Tensor) -> Tensor:
    """Return a bent valley; its lowest place is (1, 1), here at (0.5, 0.5)."""
    x, y = (2 * actions[:, 0]).unbind(-1)
    return (1 - x) ** 2 + 100 * (y - x**2) ** 2
