"""Oracles solve push, pick and place; doing nothing and random actions do not."""

import numpy as np
import pytest

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions, farthest
from vjepa2_ac.simulation.rollout import RolloutSpec, put, run_episode, run_task
from vjepa2_ac.simulation.tasks import GRASP_M, RELEASED, STEPS, arm_for, make_problem

LIMITS = LimitsConfig()


CASES = [("push", DOMAIN_A), ("pick", DOMAIN_B), ("place", DOMAIN_A), ("place", DOMAIN_B)]


@pytest.mark.parametrize(("task", "domain"), CASES, ids=[f"{task} {domain.name}" for task, domain in CASES])
def test_the_oracle_solves_it_and_nothing_and_chance_do_not(task: str, domain) -> None:
    arm = arm_for(task, domain, size=(18, 32))
    oracle = run_task(RolloutSpec(task, domain, 4, seed=5), Oracle(LIMITS, arm), arm)
    assert oracle.success_rate.value == 1.0
    assert oracle.final_distance_cm.value < 3.0
    for episode in oracle.episodes:
        assert (np.abs(episode.actions) <= farthest(LIMITS)).all()
        assert episode.blocks.shape == (STEPS[task] + 1, 4)
        np.testing.assert_allclose(episode.blocks[0], episode.problem.block_start, atol=1e-9)
        ends = np.linalg.norm(episode.blocks[-1, :3] - episode.problem.block_goal[:3])
        assert episode.distances_m[-1] == pytest.approx(ends)
    for policy in (ZeroActions(), RandomActions(LIMITS)):
        result = run_task(RolloutSpec(task, domain, 2, seed=5), policy, arm)
        assert result.success_rate.value == 0.0
        assert result.final_distance_cm.value > 8.0


@pytest.mark.parametrize("seed", [11, 12])
def test_a_block_is_placed_by_lifting_carrying_and_letting_go(seed: int) -> None:
    arm = arm_for("place", DOMAIN_B, size=(18, 32))
    spec = RolloutSpec("place", DOMAIN_B, 3, seed=seed)
    result = run_task(spec, Oracle(LimitsConfig(xyz=(0.075,) * 3), arm), arm)
    assert result.success_rate.value == 1.0
    for episode in result.episodes:
        height, grip = episode.blocks[:, 2], episode.states[:, 6]
        assert height.max() > 0.06 + 0.03  # off the table by half a block
        carried = height > 0.05
        assert (grip[carried] > RELEASED).all()
        assert not episode.reached[carried].any()
        assert episode.distances_m[-1] < 0.02
        assert grip[-1] < 0.05
        np.testing.assert_allclose(episode.states[-1, :3], episode.problem.goal[:3], atol=0.01)


def test_a_block_that_is_held_over_the_mark_is_near_and_not_placed() -> None:
    problem = make_problem("place", DOMAIN_A, 0, 0)
    arm = arm_for("place", DOMAIN_A, size=(18, 32))
    low = problem.goal.copy()
    low[2] = problem.block_goal[2] + GRASP_M
    put(arm, low, problem.block_goal, problem.mark)
    holding = arm.command(arm.state + 0.9 * np.eye(7)[6], 8)
    assert problem.distance_m(holding, arm.block) < 0.01
    assert not problem.succeeded(holding, arm.block)
    assert problem.succeeded(arm.command(arm.state - holding[6] * np.eye(7)[6], 8), arm.block)


def test_the_goal_image_of_a_place_shows_the_block_on_the_mark() -> None:
    arm = arm_for("place", DOMAIN_B)
    for index in (0, 1):  # the mark is where it belongs in every episode
        problem = make_problem("place", DOMAIN_B, 0, index)
        episode = run_episode(arm, ZeroActions(), problem, steps=1, keep_frames=True)
        for image, block in ((episode.goal_image, problem.block_goal), (episode.frames[0], problem.block_start)):
            seen = image.astype(int)
            green = np.argwhere(seen[..., 1] > 1.8 * np.maximum(seen[..., 0], seen[..., 2])).mean(axis=0)
            cyan = np.argwhere(np.minimum(seen[..., 1], seen[..., 2]) > 2.5 * seen[..., 0]).mean(axis=0)
            apart = np.linalg.norm(green - cyan)
            assert (apart < 8) == (block is problem.block_goal), apart
