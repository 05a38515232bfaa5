"""Oracles solve push and pick; doing nothing and random actions do not."""

import numpy as np
import pytest

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.simulation.world.domains import DOMAIN_A, DOMAIN_B

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.simulation.closed_loop.oracles import oracle_for
from vjepa2_ac.simulation.closed_loop.policies import DoNothing, RandomActions, farthest
from vjepa2_ac.simulation.closed_loop.rollout import RolloutSpec, run_episode, run_task
from vjepa2_ac.simulation.closed_loop.tasks import STEPS, arm_for, make_problem

LIMITS = LimitsConfig()


@pytest.mark.parametrize(("task", "domain"), [("push", DOMAIN_A), ("pick", DOMAIN_B)], ids=["push", "pick"])
def test_the_oracle_solves_it_and_nothing_and_chance_do_not(task: str, domain) -> None:
    arm = arm_for(task, domain, size=(18, 32))
    oracle = run_task(RolloutSpec(task, domain, 4, seed=5), oracle_for(task, LIMITS, arm), arm)
    assert oracle.success_rate.value == 1.0
    assert oracle.final_distance_cm.value < 3.0
    assert oracle.steps == STEPS[task]
    for episode in oracle.episodes:
        assert (np.abs(episode.actions) <= farthest(LIMITS)).all()
        assert episode.blocks.shape == (STEPS[task] + 1, 4)
        np.testing.assert_allclose(episode.blocks[0], episode.problem.block_start, atol=1e-9)
        ends = np.linalg.norm(episode.blocks[-1, :3] - episode.problem.block_goal[:3])
        assert episode.distances_m[-1] == pytest.approx(ends)
    for policy in (DoNothing(), RandomActions(LIMITS)):
        result = run_task(RolloutSpec(task, domain, 2, seed=5), policy, arm)
        assert result.success_rate.value == 0.0
        assert result.final_distance_cm.value > 8.0


def test_the_goal_image_shows_the_block_at_its_goal() -> None:
    arm = arm_for("pick", DOMAIN_A)
    episode = run_episode(arm, DoNothing(), make_problem("pick", DOMAIN_A, 0, 0), steps=1, keep_frames=True)

    def green(image: np.ndarray) -> np.ndarray:
        seen = image.astype(int)
        return np.argwhere(seen[..., 1] > 1.8 * np.maximum(seen[..., 0], seen[..., 2])).mean(axis=0)

    assert green(episode.frames[0])[0] - green(episode.goal_image)[0] > 8  # it is lifted: higher in the image


def test_an_arm_without_a_block_cannot_push() -> None:
    with pytest.raises(ValueError, match="no block"):
        run_task(RolloutSpec("push", DOMAIN_A, 1), DoNothing(), arm_for("reach", DOMAIN_A, size=(18, 32)))
