"""Demonstrations with a block: an oracle with noise, or random play around the block.

Commands are as in the closed loop: one target state per model step, held for that step.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.simulation.arm import Look, SimulatedArm
from vjepa2_ac.simulation.motion import Motion, MotionRecipe, OutOfReachError
from vjepa2_ac.simulation.policies import Oracle, shortened
from vjepa2_ac.simulation.rollout import put, ways_along
from vjepa2_ac.simulation.tasks import GRASP_M, TaskName, TaskProblem, make_problem
from vjepa2_ac.spaces import apply_action

_NOISE_M = 0.008  # standard deviation of the noise on each axis of an oracle's step
_LOWEST_M, _HIGHEST_M = 0.155, 0.34  # of the flange while playing
_TO_BLOCK = 0.5  # probability that a step of play goes to the block, or through it
_AREA = np.array([[0.30, -0.28], [0.64, 0.28]])  # of the flange while playing, in the world


def play(
    arm: SimulatedArm, task: TaskName, steps: int, rng: np.random.Generator, *, script: bool, look: Look | None = None
) -> Motion:
    """Return a demonstration of `steps` control steps with an arm that touches the block.

    Afterwards arm and block are where control step `steps` would be measured; fewer steps are the beginning of more.

    Args:
        arm: From `arm_for` of this task.
        task: One with a block: the problem at the start, and whether the gripper is used.
        steps: Control steps; 0: only the start is drawn.
        rng: The only source of randomness.
        script: Whether an oracle solves the problem, with noise; otherwise, random play.
        look: Called with the arm.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    recipe = MotionRecipe()
    problem = make_problem(task, arm.domain, int(rng.integers(2**31)), 0)
    limits = LimitsConfig(xyz=(recipe.reach_m,) * 3)
    oracle = Oracle(limits, arm)
    put(arm, problem.start, problem.block_start, problem.mark)
    unseen = np.zeros((1, 1, 3), dtype=np.uint8)
    oracle.reset(problem, unseen)
    motion = Motion(np.empty((steps, 7)), np.empty(steps), np.empty((steps, 7)), np.empty(steps))
    joints, grip = arm.joints, float(problem.start[6])
    for step in range(steps):
        if step % recipe.stride == 0:
            if script:
                noise = np.append(rng.normal(0.0, _NOISE_M, size=3), np.zeros(4))
                action = shortened(oracle.act(unseen, arm.state) + noise, limits)
            else:
                action = _play_action(arm, problem, limits, rng)
            joints, grip = _sent(arm, action)
        motion.commanded_joints[step], motion.commanded_gripper[step] = joints, grip
        motion.joints[step], motion.gripper[step] = arm.joints, arm.closedness
        if look:
            look(arm)
        arm.command_joints(joints, grip)
    return motion


def _play_action(arm: SimulatedArm, problem: TaskProblem, limits: LimitsConfig, rng: np.random.Generator) -> np.ndarray:
    """Return a step to or through the block, or anywhere; but for `push`, sometimes the gripper opens or closes."""
    state, block = arm.state, arm.block
    if block is None:
        raise ValueError("there is no block to play with")
    turn = arm.domain.base_pose()[:3, :3]
    way = np.zeros(ACTION_DIM)
    if rng.uniform() < _TO_BLOCK:
        height = GRASP_M if problem.task != "push" else problem.goal[2] - block[2]
        way[:3] = block[:3] - state[:3] + np.append(rng.normal(0.0, 0.03, size=2), height)
        way[:2] *= rng.uniform(0.6, 1.8)
    else:
        way[:3] = rng.uniform(-1.0, 1.0, size=3) * limits.xyz_m
    if problem.task != "push" and rng.uniform() < 0.25:
        way[6] = rng.choice([-1.0, 1.0]) * limits.gripper
    way = shortened(way, limits)
    place = turn @ (state[:3] + way[:3])
    low, high = np.append(_AREA[0], _LOWEST_M), np.append(_AREA[1], _HIGHEST_M)
    way[:3] = turn.T @ np.clip(place, low, high) - state[:3]
    return shortened(way, limits)


def _sent(arm: SimulatedArm, action: Float[np.ndarray, " 7"]) -> tuple[np.ndarray, float]:
    """Return the joints and closedness of a step's command, as far along it as joint angles exist."""
    joints, target = arm.joints, apply_action(arm.state, action)
    for way in [target, *reversed(ways_along(arm.state, action)[:-1])]:
        with suppress(OutOfReachError):
            joints = arm.joints_for(way)
            break
    return joints, float(np.clip(target[6], 0.0, 1.0))
