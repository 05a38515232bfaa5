"""Several cameras side by side: the energy is the mean over views, each of which the model sees by itself."""

import numpy as np
import pytest
import torch

from decisions import STATE, image
from tiny_models import tiny_model
from vjepa2_ac.config.planning import CemConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.simulation.closed_loop.tasks import arm_for
from vjepa2_ac.simulation.world.domains import DOMAIN_A

QUICK = PlanningConfig(samples=12, iterations=2, horizon=2, cem=CemConfig(elites=4), limits=LimitsConfig(rotation=0.1))


def decided(goal: np.ndarray, frame: np.ndarray, views: int, mask: np.ndarray | None = None) -> Controller:
    run = Controller(tiny_model(), QUICK.model_copy(update={"views": views}))
    run.reset(goal, mask=mask)
    run.act(frame, STATE)
    return run


def energies(run: Controller, actions: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return run.decision.cost(actions)


def test_the_energy_of_two_views_is_the_mean_of_theirs() -> None:
    goals, frames = (image(100), image(101)), (image(1), image(2))
    actions = torch.randn(5, 2, 7, generator=torch.Generator().manual_seed(0)) * 0.05
    both = decided(np.hstack(goals), np.hstack(frames), 2)
    alone = [energies(decided(goal, frame, 1), actions) for goal, frame in zip(goals, frames, strict=True)]
    torch.testing.assert_close(energies(both, actions), torch.stack(alone).mean(dim=0))
    predicted, states = both.decision.cost.imagine(actions)
    tokens = tiny_model().num_tokens
    for number, (goal, frame) in enumerate(zip(goals, frames, strict=True)):
        of_one, the_same = decided(goal, frame, 1).decision.cost.imagine(actions)
        torch.testing.assert_close(predicted[:, :, number * tokens : (number + 1) * tokens], of_one)
        torch.testing.assert_close(states, the_same)


def test_the_same_view_twice_plans_as_one() -> None:
    one, two = decided(image(100), image(1), 1), decided(np.hstack([image(100)] * 2), np.hstack([image(1)] * 2), 2)
    np.testing.assert_allclose(two.decision.action, one.decision.action, atol=1e-5)
    assert two.decision.energy_now == pytest.approx(one.decision.energy_now)


def test_a_mask_may_leave_one_view_out() -> None:
    goal, frame = np.hstack([image(100), image(101)]), np.hstack([image(1), image(2)])
    mask = np.zeros(goal.shape[:2], dtype=bool)
    mask[:, : mask.shape[1] // 2] = True
    actions = torch.zeros(1, 2, 7)
    left = energies(decided(image(100), image(1), 1), actions)
    torch.testing.assert_close(energies(decided(goal, frame, 2, mask), actions), left)
    with pytest.raises(InputError, match="nothing of what the model sees"):
        decided(goal, frame, 2, np.zeros_like(mask))


def test_what_cannot_be_split_is_refused() -> None:
    odd = np.zeros((64, 65, 3), dtype=np.uint8)
    with pytest.raises(InputError, match="65 pixels wide.* 2 views share"):
        decided(odd, odd, 2)
    with pytest.raises(ValueError, match="views 2 need context 1"):
        PlanningConfig(views=2, context=2)
    with pytest.raises(ValueError, match="axes are of one camera"):
        PlanningConfig(views=2, axes="axes.json")


def test_the_arm_is_seen_from_both_sides() -> None:
    arm = arm_for("reach", DOMAIN_A, size=(24, 32), views=2)
    np.testing.assert_array_equal(arm.image(), np.hstack([arm.image("exterior_1"), arm.image("exterior_2")]))
    assert (arm.image("exterior_1") != arm.image("exterior_2")).any()
