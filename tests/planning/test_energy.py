"""The energy of actions equals a plain implementation for any batch size, without device synchronisation."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from decisions import STATE, image, make_controller
from tiny_models import DIM, TOKENS, actions, cost, draw, goal, scene, tiny_model, vector_model
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.episode import Widths
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import Goal, Scene, WorldModelCost, compute_energy_slices, distance
from vjepa2_ac.planning.planner import Planner
from vjepa2_ac.planning.search_space import make_pose_search_space
from vjepa2_ac.registry import ENERGIES
from vjepa2_ac.spaces import Spaces, apply_action


@torch.no_grad()
def plain_predictions(model: WorldModel, start: Scene, samples: Tensor) -> Tensor:
    """Return the predictions for one action sequence without a cache, with poses computed by NumPy."""
    states = [start.state.double().numpy()]
    for action in samples.double().numpy():
        after = apply_action(states[-1], action)
        after[6] = np.clip(after[6], 0, 1)
        states.append(after)
    poses = torch.from_numpy(np.stack(states)).float()[None]
    latents = start.latents[None, None]
    for _ in samples:
        time = latents.shape[1]
        camera = None if start.extrinsics is None else start.extrinsics.expand(1, time, -1)
        following = model.predict(latents, samples[None, :time], poses[:, :time], camera)[:, -1:]
        latents = torch.cat([latents, following], dim=1)
    return latents[0, 1:]


@pytest.mark.parametrize(("adapted", "extrinsics"), [(False, False), (True, False), (False, True)])
def test_rollout_equals_a_plain_implementation(adapted: bool, extrinsics: bool) -> None:
    model, start, samples = (
        tiny_model(adapted=adapted, extrinsics=extrinsics),
        scene(extrinsics=extrinsics),
        actions(3, 3),
    )
    with torch.no_grad():
        actual, states = WorldModelCost(model, start, goal(), EnergyConfig()).rollout(samples)
    expected = torch.stack([plain_predictions(model, start, sample) for sample in samples])
    torch.testing.assert_close(actual, expected, rtol=2e-5, atol=2e-5)
    assert states.shape == (3, 4, 7)
    assert (actual[0] - actual[1]).abs().mean() > 1e-3  # the predictions depend on the actions


@torch.no_grad()
@pytest.mark.parametrize("joined", ["sum", "last"])
def test_target_model_receives_states_integrated_from_changes(joined: str) -> None:
    model = vector_model(3)
    model.base_predictor.action_encoder.weight.mul_(40)
    start, samples = Scene(draw(TOKENS, DIM), draw(3)), actions(2, 4)[..., :3]
    spaces = Spaces.from_widths(Widths(3, 3), joined)
    actual, states = WorldModelCost(model, start, goal(), EnergyConfig(), spaces=spaces).rollout(samples)
    after = start.state + torch.cat([torch.zeros(2, 1, 3), samples.cumsum(dim=1)], dim=1)
    torch.testing.assert_close(states, after)
    model_actions = after[:, 1:] if joined == "last" else samples
    torch.testing.assert_close(actual, model.rollout(start.latents.expand(2, 1, -1, -1), model_actions, after[:, :-1]))


@torch.no_grad()
def test_energies_are_independent_of_the_batch_size() -> None:
    model, samples = tiny_model(), actions(7, 2)
    expected = cost(model, samples_at_once=7)(samples)
    for at_once in (1, 3, 100):
        torch.testing.assert_close(cost(model, samples_at_once=at_once)(samples), expected, rtol=1e-5, atol=1e-6)
    assert expected.unique().numel() == 7


def test_predictor_batches_are_at_most_samples_at_once() -> None:
    model, batch_sizes = tiny_model(), []
    model.base_predictor.register_forward_pre_hook(lambda _, inputs: batch_sizes.append(len(inputs[0])))
    with torch.no_grad():
        cost(model, samples_at_once=3)(actions(7, 1))
    assert batch_sizes == [3, 3, 1]
    batch_sizes.clear()
    samples = actions(7, 1).requires_grad_()
    cost(model, samples_at_once=7)(samples).sum().backward()  # a single batch is not recomputed
    assert batch_sizes == [7]
    batch_sizes.clear()
    cost(model, samples_at_once=4)(samples).sum().backward()  # several batches are recomputed one at a time
    assert sorted(batch_sizes) == [3, 3, 4, 4]


def test_distances_equal_their_formulas() -> None:
    actual, target = draw(5, TOKENS, DIM, seed=1), draw(TOKENS, DIM, seed=2)
    torch.testing.assert_close(distance(actual, target, EnergyConfig()), (actual - target).abs().mean(dim=(1, 2)))
    torch.testing.assert_close(
        distance(actual, target, EnergyConfig(distance="l2")), ((actual - target) ** 2).mean(dim=(1, 2))
    )
    cosine = torch.einsum("std,td->st", actual, target) / actual.norm(dim=-1) / target.norm(dim=-1)
    torch.testing.assert_close(distance(actual, target, EnergyConfig(distance="cosine")), 1 - cosine.mean(dim=1))
    for kind in ("l1", "l2", "cosine"):
        assert float(distance(target, target, EnergyConfig(distance=kind))) == pytest.approx(0, abs=1e-6)


@torch.no_grad()
def test_energy_uses_the_weights_of_the_goal() -> None:
    model, samples = tiny_model(), actions(3, 1)
    weights = torch.arange(float(TOKENS))
    measure = WorldModelCost(model, scene(), goal(weights=weights), EnergyConfig())
    predicted, _ = measure.rollout(samples)
    torch.testing.assert_close(measure(samples), distance(predicted[:, 0], goal().latents[0], EnergyConfig(), weights))


@torch.no_grad()
def test_energy_goal_depends_on_the_elapsed_steps() -> None:
    model, samples, target = tiny_model(), actions(3, 1), goal(2, durations=(4,))
    energies = [
        WorldModelCost(model, scene(), target, EnergyConfig(), elapsed_steps=steps)(samples) for steps in (0, 3, 4)
    ]
    single = [
        WorldModelCost(model, scene(), Goal(latents[None]), EnergyConfig())(samples) for latents in target.latents
    ]
    for actual, expected in zip(energies, (single[0], single[0], single[1]), strict=True):
        torch.testing.assert_close(actual, expected)


def test_gradients_are_independent_of_the_batch_size() -> None:
    model, actual = tiny_model(), []
    for at_once in (5, 2):
        samples = actions(5, 3).requires_grad_()
        energies = cost(model, distance="l2", samples_at_once=at_once)(samples)
        actual.append(torch.autograd.grad(energies.sum(), samples)[0])
    torch.testing.assert_close(actual[0], actual[1], rtol=1e-4, atol=1e-6)
    assert (actual[0].abs().sum(dim=-1) > 0).all()  # the first action has an effect on all later steps


@pytest.mark.parametrize("planner", ["cem", "icem", "mppi", "gradient"])
def test_every_planner_lowers_the_energy_with_a_world_model(planner: str) -> None:
    component = {"name": planner, "options": {"starts": 4} if planner == "gradient" else {}}
    limits = LimitsConfig(rotation=0.1)
    settings = PlanningConfig(planner=component, horizon=2, samples=32, iterations=6, limits=limits)
    measure = cost(tiny_model(), distance="l2")
    plan = Planner(settings).plan(measure, torch.Generator().manual_seed(0))
    with torch.no_grad():
        zero_action_energy = float(measure(torch.zeros(1, 2, 7))[0])
        assert plan.energy == pytest.approx(float(measure(plan.actions[None])[0]), rel=1e-4)
    assert plan.energy < zero_action_energy
    assert plan.iterations[-1].elite_energy < plan.iterations[0].elite_energy


def test_model_in_training_mode_raises() -> None:
    with pytest.raises(ValueError, match="eval"):
        cost(tiny_model(adapted=True).train())


def test_energy_class_is_constructed_once_per_controller(monkeypatch: pytest.MonkeyPatch) -> None:
    instances = []

    class Counted:
        def __init__(self) -> None:
            instances.append(self)

        def __call__(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
            return (predicted - target).abs().mean(dim=-1)

    monkeypatch.setitem(ENERGIES._things, "counted", Counted)
    controller = make_controller(horizon=1, energy=EnergyConfig(distance="counted", samples_at_once=3))
    controller.reset(image(100), image(101), durations=(1,))
    for seed in range(2):
        controller.act(image(seed), STATE)
    controller.score(image(2), STATE, np.zeros((2, 1, 7)))
    assert len(instances) == 1


# Energy slices

CHOSEN = torch.arange(28.0).reshape(4, 7) / 1000
LIMITS = LimitsConfig(xyz=(0.04, 0.08, 0.0))


def weighted(actions: Tensor) -> Tensor:
    """Return a cost with a different weight for each number of each step."""
    return (actions * torch.arange(1.0, 29.0).reshape(4, 7)).sum(dim=(1, 2))


def test_energy_slice_varies_two_components_of_the_first_action_only() -> None:
    slices = compute_energy_slices(
        weighted, CHOSEN, make_pose_search_space(PlanningConfig(horizon=4, limits=LIMITS)), nodes=5
    )
    assert tuple(plane.components for plane in slices) == ((0, 1), (0, 2), (1, 2))
    for plane in slices:
        for row, up in enumerate(plane.up):
            for column, across in enumerate(plane.across):
                changed = CHOSEN.clone()
                changed[0, plane.components[0]], changed[0, plane.components[1]] = across, up
                assert plane.energy[row, column] == pytest.approx(float(weighted(changed[None])[0]), rel=1e-5)


def test_energy_slice_extends_beyond_the_limits_of_fixed_components() -> None:
    slices = compute_energy_slices(
        weighted, CHOSEN, make_pose_search_space(PlanningConfig(horizon=4, limits=LIMITS)), nodes=3
    )
    np.testing.assert_allclose(slices[0].across, [-0.05, 0, 0.05], rtol=1e-5)
    np.testing.assert_allclose(slices[0].up, [-0.1, 0, 0.1], rtol=1e-5)
    np.testing.assert_allclose(
        slices[2].up, [-0.1, 0, 0.1], rtol=1e-5
    )  # dz is fixed, so its range is that of the component with the larger limit
    fixed_space = make_pose_search_space(PlanningConfig(horizon=4, limits=LimitsConfig(xyz=(0, 0, 0), rotation=0.1)))
    np.testing.assert_allclose(
        compute_energy_slices(weighted, CHOSEN, fixed_space, nodes=3)[0].up, [-0.0625, 0, 0.0625], rtol=1e-5
    )


# Synchronisation with the device

SYNCHRONISING = {
    "_local_scalar_dense", "_to_copy", "copy_", "equal", "index", "index_put_", "is_nonzero", "lift_fresh",
    "masked_select", "nonzero", "unique_dim", "_unique2",
}  # fmt: skip
"""Operations that copy numbers from or to the device, or whose result has a size that depends on the numbers."""


class OperationRecorder(TorchDispatchMode):
    """Records the names of all operations."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: set[str] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        self.operations.add(operation._overloadpacket.__name__)
        return operation(*arguments, **(options or {}))


def record_operations(work: Callable[[], object]) -> set[str]:
    """Return the names of the operations that a call runs, after a first call as warm-up."""
    work()
    with OperationRecorder() as recorder:
        work()
    return recorder.operations


@torch.no_grad()
@pytest.mark.parametrize(("steps", "kind"), [("last", "l1"), ("sum", "cosine")])
def test_energies_are_computed_without_device_synchronisation(steps: str, kind: str) -> None:
    measure, samples = cost(tiny_model(), samples_at_once=4, steps=steps, distance=kind), actions(10, 3)
    reported: list[tuple[int, int]] = []
    measure.progress = lambda *progress: reported.append(progress)
    operations = record_operations(lambda: measure(samples))
    assert reported == 2 * [(4, 10), (8, 10), (10, 10)]
    assert "addmm" in operations
    assert not operations & SYNCHRONISING
