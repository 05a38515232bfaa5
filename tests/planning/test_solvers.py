"""Solvers find known optima, respect limits and time, and handle a cost without finite values."""

import json
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from paths import GOLDEN
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.planning.planner import Plan, Planner
from vjepa2_ac.planning.search_space import GRIPPER, SearchSpace, make_pose_search_space
from vjepa2_ac.planning.solvers import (
    EvaluatedPlans,
    MppiSolver,
    PlanStart,
    draw_coloured_noise,
)

PLANNERS = ("cem", "icem", "mppi", "gradient")


def space(decisions: int = 1, dim: int = 2, reach: float = 1.0) -> SearchSpace:
    """Return a box around zero."""
    upper = torch.full((decisions, dim), reach)
    return SearchSpace(-upper, upper, upper)


def config(
    planner: str, iterations: int = 30, samples: int = 200, options: dict[str, Any] | None = None, **changes: Any
) -> PlanningConfig:
    """Return settings that suffice to optimise a few numbers."""
    default_options = {"gradient": {"starts": 16, "learning_rate": 0.1}, "mppi": {"std_decay": 0.85}}.get(planner, {})
    component = {"name": planner, "options": options or default_options}
    return PlanningConfig(planner=component, iterations=iterations, samples=samples, **changes)


def solve(
    planner: str, cost: Callable[[Tensor], Tensor], search_space: SearchSpace, seed: int = 0, **changes: Any
) -> Plan:
    """Return the plan of least cost in a space."""
    generator = torch.Generator().manual_seed(seed)
    return Planner(config(planner, **changes), search_space).plan(cost, generator)


def parabola(target: Tensor) -> Callable[[Tensor], Tensor]:
    """Return the squared distance of an action sequence from the target."""
    return lambda actions: (actions - target).square().sum(dim=(1, 2))


def rosenbrock(actions: Tensor) -> Tensor:
    """Return the Rosenbrock function of doubled actions, whose minimum is at (0.5, 0.5)."""
    x, y = (2 * actions[:, 0]).unbind(-1)
    return (1 - x) ** 2 + 100 * (y - x**2) ** 2


@pytest.mark.parametrize("planner", PLANNERS)
def test_every_planner_finds_the_minimum_of_a_parabola(planner: str) -> None:
    target = torch.tensor([[0.3, -0.2], [0.1, 0.7], [-0.6, 0.0]])
    plan = solve(planner, parabola(target), space(3), iterations=40)
    torch.testing.assert_close(plan.actions, target, atol=0.03, rtol=0)
    assert plan.energy == pytest.approx(float((plan.actions - target).square().sum()), abs=1e-6)


def upstream_cost(actions: Tensor) -> Tensor:
    """Return the energies of the world in which upstream's planner was run (golden/DATA_ORIGIN.md)."""
    goal = torch.tensor([[0.03, -0.02, 0.06, 0.3], [0.05, 0.0, 0.0, 0.0]])
    first = torch.zeros(len(actions), 4)
    second, x = torch.zeros(len(actions)), torch.full((len(actions),), 0.4)
    for dx, dy, dz, *_, grip in (step.unbind(-1) for step in actions.unbind(1)):
        first = first + torch.stack([dx, dy + dx * dz, dz, grip], dim=-1)
        second, x = second + x * grip, x + dx
    second = torch.nn.functional.pad(second[:, None], (0, 3))
    return (torch.stack([first, second], dim=1) - goal).abs().mean(dim=(1, 2))


@pytest.mark.parametrize("case", json.loads((GOLDEN / "cem.json").read_text()), ids=lambda case: str(case["seed"]))
def test_cem_equals_the_upstream_plan_for_the_same_seed(case: dict) -> None:
    arguments = case["arguments"]
    closing = arguments.get("close_gripper")
    default_options = {"momentum_mean": 0.25, "momentum_std": 0.95}
    cem = {"elites": arguments["topk"], **default_options} | {
        name: arguments[name] for name in arguments if name.startswith("momentum")
    }
    settings = PlanningConfig(
        horizon=arguments["rollout"],
        samples=arguments["samples"],
        iterations=arguments["cem_steps"],
        limits=LimitsConfig(xyz=(arguments.get("maxnorm", 0.05),) * 3),
        planner={"name": "cem", "options": cem},
    )
    search_space = make_pose_search_space(settings)
    if closing is not None:
        search_space.lower[closing:, GRIPPER] = search_space.upper[closing:, GRIPPER] = 1.0
    plan = Planner(settings, search_space).plan(upstream_cost, torch.Generator().manual_seed(case["seed"]))
    expected = torch.tensor(case["actions"])
    if closing is not None:  # upstream's value is a mean that is still approaching 1
        expected[closing:, 6] = 1.0
    torch.testing.assert_close(plan.actions, expected, atol=1e-6, rtol=1e-5)


def jepa_wms_cost(actions: Tensor) -> Tensor:
    """Return the energies of the world in which JEPA-WMs' planner was run (golden/DATA_ORIGIN.md)."""
    goal = torch.tensor([0.12, -0.05, 0.3, 0.02, 0.0, -0.04, 0.6])
    distance = (actions.sum(dim=1) - goal).square().sum(dim=-1)
    return distance + 0.1 * (actions[:, 0, 0] * actions[:, 1, 1]).abs() + 0.05 * actions[:, :, 3].square().sum(dim=1)


@pytest.mark.parametrize("case", json.loads((GOLDEN / "cem_jepa_wms.json").read_text()), ids=lambda c: str(c["seed"]))
def test_cem_with_jepa_wms_settings_equals_its_plan(case: dict) -> None:
    none = dict.fromkeys(("momentum_mean", "momentum_std", "momentum_mean_gripper", "momentum_std_gripper"), 0.0)
    settings = PlanningConfig(
        planner={"name": "cem", "options": {**none, "try_mean": True}},
        horizon=3,
        samples=304,  # so that one draw of JEPA-WMs and three draws here give the same numbers
        iterations=15,
        limits=LimitsConfig(xyz=(0.1, 0.1, 0.1), rotation=0.1, gripper=0.75, gripper_mode="free"),
    )
    search_space = make_pose_search_space(settings)
    search_space.std[:, GRIPPER] = 0.1
    plan = Planner(settings, search_space).plan(jepa_wms_cost, torch.Generator().manual_seed(case["seed"]))
    torch.testing.assert_close(
        [iteration.lowest for iteration in plan.iterations], case["losses"], rtol=1e-3, atol=1e-7
    )
    torch.testing.assert_close(plan.actions, torch.tensor(case["actions"]), atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("planner", PLANNERS)
def test_the_same_seed_gives_the_same_plan_and_another_seed_another(planner: str) -> None:
    first, repeated, other = (solve(planner, rosenbrock, space(), seed, iterations=3) for seed in (5, 5, 6))
    assert torch.equal(first.actions, repeated.actions)
    assert first.seed == 5
    assert not torch.equal(first.iterations[0].elites, other.iterations[0].elites)


@pytest.mark.parametrize("planner", PLANNERS)
@pytest.mark.parametrize("energy", [math.nan, math.inf, -math.inf])
def test_no_finite_energy_gives_zero_actions(planner: str, energy: float) -> None:
    plan = solve(planner, lambda actions: actions.sum(dim=(1, 2)) * 0 + energy, space(2), iterations=3)
    assert not plan.actions.any()
    assert plan.stopped == "no finite energy"
    assert math.isnan(plan.energy)
    assert all(iteration.finite == 0 and iteration.lowest == math.inf for iteration in plan.iterations)


@pytest.mark.parametrize("planner", PLANNERS)
def test_samples_without_finite_energy_are_ignored(planner: str) -> None:
    target = torch.tensor([[0.4, -0.3]])

    def cost(actions: Tensor) -> Tensor:
        return torch.where(actions[:, 0, 1] > 0, math.nan, parabola(target)(actions))

    plan = solve(planner, cost, space(), iterations=40)
    torch.testing.assert_close(plan.actions, target, atol=0.03, rtol=0)
    assert 0 < plan.iterations[0].finite < plan.iterations[0].samples


@pytest.mark.parametrize("planner", PLANNERS)
def test_unbounded_cost_keeps_the_plan_within_the_limits(planner: str) -> None:
    settings = config(
        planner, iterations=30, horizon=4, action_repeat=2,
        limits=LimitsConfig(xyz=(0.05, 0.03, 0.0), rotation=0.1),
    )  # fmt: skip
    plan = Planner(settings).plan(lambda actions: -1e6 * actions.sum(dim=(1, 2)), torch.Generator())
    assert plan.actions.shape == (4, 7)
    for number, limit in enumerate((0.05, 0.03, 0.0, 0.1, 0.1, 0.1, 0.75)):
        assert (plan.actions[:, number].abs().double() <= limit).all()
    assert (plan.actions[:, 3:6] > 0.05).all()
    assert torch.equal(plan.actions[0], plan.actions[1])


class FakeClock:
    """A clock that advances only on request."""

    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


@pytest.mark.parametrize("planner", PLANNERS)
@pytest.mark.parametrize(("budget", "iterations"), [(0.1, 1), (2.9, 2), (3.0, 3), (99.0, 5)])
def test_iterations_stop_before_the_time_budget_is_exceeded(planner: str, budget: float, iterations: int) -> None:
    clock = FakeClock()

    def slow(actions: Tensor) -> Tensor:
        clock.time += 1.0 if len(actions) > 1 else 0.0
        return parabola(torch.zeros(1, 2))(actions)

    settings = config(planner, iterations=5, budget_s=budget)
    plan = Planner(settings, space(), clock=clock).plan(slow, torch.Generator())
    assert len(plan.iterations) == iterations
    assert plan.stopped == ("finished" if iterations == 5 else "out of time")
    assert plan.seconds == iterations
    assert [iteration.seconds for iteration in plan.iterations] == [1.0] * iterations
    assert math.isfinite(plan.energy)


@pytest.mark.parametrize("planner", PLANNERS)
def test_warm_start_begins_at_the_previous_plan(planner: str) -> None:
    target = torch.tensor([[0.2, 0.1], [0.8, -0.9], [-0.7, 0.6]])
    before = solve(planner, parabola(target), space(3), iterations=40)
    following = torch.cat([target[1:], target[-1:]])
    start = before.make_next_start()
    torch.testing.assert_close(start.mean[:2], before.mean[1:])

    def first(start: PlanStart | None) -> float:
        settings = config(planner, iterations=1, samples=20)
        plan = Planner(settings, space(3)).plan(parabola(following), torch.Generator().manual_seed(1), start)
        return plan.iterations[0].lowest

    assert first(start) < first(None)


def test_icem_reuses_elites() -> None:
    before = solve("icem", rosenbrock, space(2), iterations=3)
    start = before.make_next_start()
    shown: list[Tensor] = []

    def cost(actions: Tensor) -> Tensor:
        shown.append(actions)
        return rosenbrock(actions)

    settings = config("icem", iterations=2, samples=40, options={"elites": 10, "kept": 0.3})
    plan = Planner(settings, space(2)).plan(cost, torch.Generator(), start)
    assert torch.equal(shown[0][40:], start.elites[:3])
    assert torch.equal(shown[1][32:35], plan.iterations[0].elites[:3])  # 40 / 1.25 new samples come first
    torch.testing.assert_close(shown[1][35], plan.iterations[0].mean)  # the last iteration also evaluates the mean
    assert all(later.lowest <= earlier.lowest for earlier, later in pairwise(plan.iterations))


def test_mppi_evaluates_its_mean_and_weights_by_energy() -> None:
    options = MppiSolver.Config(temperature=0.5, std_decay=0.5)
    solver = MppiSolver(space(), config("mppi", samples=3), torch.Generator(), options=options)
    assert torch.equal(solver.sample()[0], solver.mean)
    samples = torch.tensor([[[0.0, 0.0]], [[1.0, 0.0]], [[0.0, 1.0]]])
    energies = torch.tensor([1.0, 3.0, 2.0])
    solver.update(EvaluatedPlans(samples, energies))
    weights = torch.exp(-energies / (0.5 * (2 / 3) ** 0.5))
    torch.testing.assert_close(solver.mean, (weights[1:] / weights.sum())[None])
    torch.testing.assert_close(solver.std, torch.full((1, 2), 0.5))


@pytest.mark.parametrize("decisions", [1, 2, 7, 8])
@pytest.mark.parametrize("exponent", [0.0, 2.0])
def test_coloured_noise_has_unit_variance(decisions: int, exponent: float) -> None:
    noise = draw_coloured_noise(40_000, decisions, 1, exponent, torch.Generator().manual_seed(0))
    torch.testing.assert_close(noise.var(dim=0), torch.ones(decisions, 1), atol=0.05, rtol=0)
    assert noise.mean(dim=0).abs().max() < 0.03
