"""Demonstrations with a block touch it, and are recorded like all others."""

import numpy as np
import pytest

from vjepa2_ac.simulation.domains import DOMAIN_A
from vjepa2_ac.simulation.motion import forward_kinematics
from vjepa2_ac.simulation.tasks import arm_for

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.simulation.policies import play
from vjepa2_ac.simulation.record import RecordingSpec, default_steps, record_episode


def blocks_of(task: str, seed: int, *, script: bool, steps: int = 41) -> np.ndarray:
    seen = []
    play(
        arm_for(task, DOMAIN_A),
        task,
        steps,
        np.random.default_rng(seed),
        script=script,
        look=lambda arm: seen.append(arm.block),
    )
    return np.array(seen)


def test_scripts_and_play_move_the_block() -> None:
    pushed = blocks_of("push", 1, script=True)
    assert len(pushed) == 41
    assert np.linalg.norm(pushed[-1, :2] - pushed[0, :2]) > 0.08
    assert blocks_of("pick", 1, script=True)[-1, 2] > 0.10
    placed = blocks_of("place", 1, script=True, steps=default_steps("place"))
    assert placed[:, 2].max() > 0.08
    assert placed[-1, 2] < 0.035
    assert np.linalg.norm(placed[-1, :2] - placed[0, :2]) > 0.06
    played = [blocks_of("push", seed, script=False, steps=25) for seed in range(3)]
    ways = [np.linalg.norm(blocks[-1, :2] - blocks[0, :2]) for blocks in played]
    assert max(ways) > 0.05


def test_measurements_follow_commands_that_are_held_for_a_model_step() -> None:
    motion = play(arm_for("push", DOMAIN_A), "push", 9, np.random.default_rng(0), script=False)
    for first in (0, 4):
        np.testing.assert_array_equal(motion.commanded_joints[first : first + 4], motion.commanded_joints[[first] * 4])
    assert (motion.commanded_joints[4] != motion.commanded_joints[3]).any()
    to_go = [np.abs(motion.commanded_joints[0] - motion.joints[step]).max() for step in range(4)]
    assert to_go[0] > to_go[1] > to_go[2] > to_go[3]


def test_an_episode_with_a_block_is_consistent_and_always_the_same() -> None:
    first, again = (record_episode(2, RecordingSpec(DOMAIN_A, 6, 1, task="pick")) for _ in range(2))
    assert first.images == again.images
    joints, poses = (first.arrays[f"observation/{name}_position"] for name in ("joint", "cartesian"))
    np.testing.assert_array_equal(forward_kinematics(joints), poses)
    assert all(len(film) == 6 for film in first.images.values())
    assert first.language_instruction == "pick up the block"
    other = record_episode(2, RecordingSpec(DOMAIN_A, 6, 1))
    assert other.language_instruction != first.language_instruction
    assert np.abs(other.arrays["action"] - first.arrays["action"]).max() > 0.01
