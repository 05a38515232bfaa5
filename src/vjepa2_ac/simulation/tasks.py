"""What is the simulated robot to do? Problems: where arm and block begin, where they shall be, and what counts as done.

They are drawn in the world frame: a problem looks the same in every domain, however the robot is mounted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.simulation.domains import Domain
from vjepa2_ac.simulation.motion import MotionRecipe, downward_poses, poses_in_base

TaskName = Literal["reach", "push", "pick"]

SUCCESS_M: dict[TaskName, float] = {"reach": 0.05}
"""Closer than this at the end is a success: the flange to the goal, or the block to where it shall be."""

REACH_WAY_M = (0.12, 0.25)
"""How far start and goal of `reach` lie apart."""

_NUMBER: dict[TaskName, int] = {"reach": 0}  # of the random stream


@dataclass(frozen=True)
class Problem:
    """One start and one goal. States and positions are in the robot base frame of the domain (legend: episode.py)."""

    task: TaskName
    index: int
    start: Float[np.ndarray, " 7"]
    goal: Float[np.ndarray, " 7"]  # of the arm in the goal picture

    def distance_m(self, state: Float[np.ndarray, " 7"]) -> float:
        """Return how far the flange is from its goal, whatever its rotation and the gripper."""
        return float(np.linalg.norm(state[:3] - self.goal[:3]))


def make_problem(task: TaskName, domain: Domain, seed: int, index: int) -> Problem:
    """Return a problem: a pure function of its arguments, and the same in the world in every domain.

    `reach`: both ends in the box of `MotionRecipe`, gripper pointing down, the same turn and gripper at both.

    Args:
        task: What to do.
        domain: Where; decides only in which frame the problem is told.
        seed: Which problems.
        index: Which of them.

    Raises:
        ValueError: No such task, or a negative seed or index.
    """
    if task not in _NUMBER:
        raise ValueError(f"no task {task!r}: {', '.join(_NUMBER)}")
    rng = np.random.default_rng([seed, index, _NUMBER[task]])
    recipe = MotionRecipe()
    low, high = np.array(recipe.low_m), np.array(recipe.high_m)
    start = rng.uniform(low, high)
    while not REACH_WAY_M[0] <= np.linalg.norm((goal := rng.uniform(low, high)) - start) <= REACH_WAY_M[1]:
        pass
    turn, closedness = rng.uniform(-recipe.max_turn_rad, recipe.max_turn_rad), float(rng.integers(2))
    first, last = _states(np.stack([start, goal]), np.full(2, turn), np.full(2, closedness), domain)
    return Problem(task, index, first, last)


def _states(
    positions: Float[np.ndarray, "states 3"],
    turns: Float[np.ndarray, " states"],
    closedness: Float[np.ndarray, " states"],
    domain: Domain,
) -> Float[np.ndarray, "states 7"]:
    """Return states in the base frame: the flange at positions of the world, pointing down, turned about z."""
    poses = poses_in_base(downward_poses(np.concatenate([positions, turns[:, None]], axis=1)), domain)
    return np.concatenate([poses, closedness[:, None]], axis=1)
