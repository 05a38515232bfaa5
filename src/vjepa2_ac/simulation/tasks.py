"""Tasks of the simulated arm: start and goal of arm and block, and the criterion of success.

Problems are drawn in the world frame, so they are the same in every domain, independently of the robot's mounting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.simulation.arm import Block, ContactArm, Mark, SimulatedArm, State
from vjepa2_ac.simulation.camera import FRAME_SIZE
from vjepa2_ac.simulation.domains import (
    BLOCK_M,
    FINGER_HALF_M,
    FINGER_INSIDE_M,
    FINGER_OUTSIDE_M,
    FINGER_TRAVEL_M,
    FINGERTIP_M,
    Domain,
)
from vjepa2_ac.simulation.motion import MotionRecipe, downward_poses, poses_in_base

TaskName = Literal["reach", "push", "pick", "place"]

SUCCESS_M: dict[TaskName, float] = {"reach": 0.05, "push": 0.04, "pick": 0.05, "place": 0.04}
"""Largest distance to the goal that counts as success: of the flange (reach), or of the block's centre.

For place it is the same as for push, because the block is on the table in both; the block's centre is then on the mark,
at least 1.5 cm from its edge. Place has further conditions: see `TaskProblem.succeeded`.
"""

STEPS: dict[TaskName, int] = {"reach": 8, "push": 8, "pick": 12, "place": 18}
"""Default number of model steps per episode; for place the paper's 4 + 10 + 4 steps of pick-and-place."""

REACH_DISTANCE_M, PUSH_DISTANCE_M, LIFT_M, PLACE_DISTANCE_M = (0.12, 0.25), (0.10, 0.16), (0.10, 0.14), (0.10, 0.20)
"""Ranges of the distance from start to goal: of the flange (reach), of the block (push, place), of its lift (pick)."""

GRASP_M = FINGERTIP_M - 0.02  # height of the flange above the centre of the block when grasping it

HOLDING = 1.0 - (BLOCK_M / 2 - FINGER_INSIDE_M) / FINGER_TRAVEL_M  # gripper position that holds the block

RELEASED = HOLDING - 0.1  # gripper position below which the block is released, with 4 mm of space on each side

_FLANGE_AREA = np.array([[0.32, -0.26], [0.62, 0.26]])  # lower and upper bounds of (x, y) in the world
_BLOCK_AREA = np.array([[0.36, -0.26], [0.64, 0.26]])
_PUSHING_M = 0.17  # height of the flange while pushing, with the fingertips 2 cm above the table
_GRASP_AREA = _FLANGE_AREA * 0.8 + 0.2 * _FLANGE_AREA.mean(axis=0)  # area in which a block is picked up or put down
_ON_TABLE_M = 0.01  # tolerance of the height of a block that is on the table
_MAX_TURN_RAD = 0.4  # largest rotation of block and hand from straight ahead


@dataclass(frozen=True)
class TaskProblem:
    """Start and goal of the simulated arm. All poses are in its base frame (conventions: episode.py).

    The pose of a block is its centre (x, y, z in metres) and its rotation about z in radians.
    """

    task: TaskName
    index: int
    start: State
    goal: State  # state of the arm in the goal image
    block_start: Block | None = None  # None: the task has no block
    block_goal: Block | None = None

    @property
    def ends(self) -> Float[np.ndarray, "2 4"]:
        """Start and goal of the block.

        Raises:
            ValueError: The task has no block.
        """
        if self.block_start is None or self.block_goal is None:
            raise ValueError(f"the task {self.task} has no block")
        return np.stack([self.block_start, self.block_goal])

    @property
    def mark(self) -> Mark | None:
        """Centre (x, y) of the mark on the table under the block's goal; None for tasks other than place."""
        return self.block_goal[:2] if self.task == "place" and self.block_goal is not None else None

    def distance_m(self, state: State, block: Block | None = None) -> float:
        """Return the distance to the goal, of the block if the task has one, else of the flange.

        Rotations and the gripper are ignored.

        Raises:
            ValueError: The task has a block, but `block` is None.
        """
        if self.block_goal is None:
            return float(np.linalg.norm(state[:3] - self.goal[:3]))
        if block is None:
            raise ValueError(f"the task {self.task} needs the pose of a block")
        return float(np.linalg.norm(block[:3] - self.block_goal[:3]))

    def succeeded(self, state: State, block: Block | None = None) -> bool:
        """Return whether a state of arm and block is a success.

        The distance must be below `SUCCESS_M`. For place, the block must also be on the table and released.

        Raises:
            ValueError: The task has a block, but `block` is None.
        """
        near = self.distance_m(state, block) < SUCCESS_M[self.task]
        if self.task != "place" or block is None or self.block_goal is None:
            return near
        return near and bool(abs(block[2] - self.block_goal[2]) < _ON_TABLE_M and state[6] < RELEASED)


def make_problem(task: TaskName, domain: Domain, seed: int, index: int) -> TaskProblem:
    """Return a problem. It is a pure function of the arguments, and the same in the world frame in every domain.

    reach: start and goal are in the box of `MotionRecipe`, with the same rotation and gripper; the gripper points down.
    push: the closed gripper starts behind the block, near the table. At the goal the block is moved straight ahead.
    pick: the open gripper starts above the block. At the goal it holds the block in the air. place: the open gripper
    starts above the block. At the goal the block is on the mark, with the open gripper above it.

    Args:
        task: The task.
        domain: Determines only the frame of the problem's poses.
        seed: Seed of all problems.
        index: Number of the problem.
    """
    problem = _DRAW_PROBLEM[task](np.random.default_rng([seed, index, list(_DRAW_PROBLEM).index(task)]))
    poses = poses_in_base(downward_poses(_append(problem.flange, problem.turn)), domain)
    first, last = np.concatenate([poses, np.array(problem.gripper_position)[:, None]], axis=1)
    if problem.blocks is None:
        return TaskProblem(task, index, first, last)
    turns = problem.blocks[:, 3:] - np.deg2rad(domain.base_yaw_deg)
    blocks = np.concatenate([problem.blocks[:, :3] @ domain.base_pose()[:3, :3], turns], axis=1)
    return TaskProblem(task, index, first, last, *blocks)


@dataclass(frozen=True)
class _WorldProblem:
    """Start and goal of a problem in the world frame."""

    flange: Float[np.ndarray, "2 3"]
    turn: float  # rotation of the hand about the vertical, at start and goal
    gripper_position: tuple[float, float]
    blocks: Float[np.ndarray, "2 4"] | None = None


def _draw_reach(rng: np.random.Generator) -> _WorldProblem:
    recipe = MotionRecipe()
    low, high = np.array(recipe.low_m), np.array(recipe.high_m)
    start = rng.uniform(low, high)
    while not REACH_DISTANCE_M[0] <= np.linalg.norm((goal := rng.uniform(low, high)) - start) <= REACH_DISTANCE_M[1]:
        pass
    turn, gripper_position = rng.uniform(-recipe.max_turn_rad, recipe.max_turn_rad), float(rng.integers(2))
    return _WorldProblem(np.stack([start, goal]), turn, (gripper_position, gripper_position))


def _draw_push(rng: np.random.Generator) -> _WorldProblem:
    """Draw a problem of pushing forwards with the fingers' broad side, or sideways with one finger's outer side."""
    while True:
        turn = rng.uniform(-_MAX_TURN_RAD, _MAX_TURN_RAD)
        side = int(rng.integers(-1, 2))  # right, ahead, left
        angle = turn + side * np.pi / 2
        ahead = np.array([np.cos(angle), np.sin(angle)])
        touching = BLOCK_M / 2 + (FINGER_OUTSIDE_M if side else FINGER_HALF_M)
        gap, distance = rng.uniform(0.03, 0.07), rng.uniform(*PUSH_DISTANCE_M)
        block = rng.uniform(*_BLOCK_AREA)
        blocks = np.stack([block, block + distance * ahead])
        flange = blocks - ahead * np.array([[touching + gap], [touching]])
        if _is_inside(blocks, _BLOCK_AREA) and _is_inside(flange, _FLANGE_AREA):
            return _WorldProblem(
                _append(flange, _PUSHING_M), turn, (1.0, 1.0), _append(_append(blocks, BLOCK_M / 2), turn)
            )


def _draw_pick(rng: np.random.Generator) -> _WorldProblem:
    turn = rng.uniform(-_MAX_TURN_RAD, _MAX_TURN_RAD)
    block = np.append(rng.uniform(*_GRASP_AREA), BLOCK_M / 2)
    lifted = block + np.append(rng.uniform(-0.03, 0.03, size=2), rng.uniform(*LIFT_M))
    above = block + np.append(rng.uniform(-0.04, 0.04, size=2), GRASP_M + rng.uniform(0.07, 0.12))
    flange = np.stack([above, lifted + np.array([0.0, 0.0, GRASP_M])])
    return _WorldProblem(flange, turn, (0.0, HOLDING), _append(np.stack([block, lifted]), turn))


def _draw_place(rng: np.random.Generator) -> _WorldProblem:
    while True:
        turn, angle = rng.uniform(-_MAX_TURN_RAD, _MAX_TURN_RAD), rng.uniform(-np.pi, np.pi)
        block = rng.uniform(*_GRASP_AREA)
        ends = np.stack([block, block + rng.uniform(*PLACE_DISTANCE_M) * np.array([np.cos(angle), np.sin(angle)])])
        if _is_inside(ends, _GRASP_AREA):
            break
    blocks = _append(ends, BLOCK_M / 2)
    above = np.append(rng.uniform(-0.04, 0.04, size=2), GRASP_M + rng.uniform(0.07, 0.12))
    flange = blocks + np.stack([above, [0.0, 0.0, GRASP_M + rng.uniform(0.07, 0.10)]])
    return _WorldProblem(flange, turn, (0.0, 0.0), _append(blocks, turn))


_DRAW_PROBLEM: dict[TaskName, Callable[[np.random.Generator], _WorldProblem]] = {
    "reach": _draw_reach,
    "push": _draw_push,
    "pick": _draw_pick,
    "place": _draw_place,
}
"""Functions that draw a problem. The order matters: a task's index is part of the seed of its problems."""


def _is_inside(points: Float[np.ndarray, "points 2"], area: Float[np.ndarray, "2 2"]) -> bool:
    return bool(((points >= area[0]) & (points <= area[1])).all())


def _append(points: Float[np.ndarray, "points dim"], value: float) -> Float[np.ndarray, "points dim+1"]:
    """Append the same coordinate to all points."""
    return np.concatenate([points, np.full((len(points), 1), value)], axis=1)


def arm_for(task: TaskName, domain: Domain, *, size: tuple[int, int] = FRAME_SIZE, views: int = 1) -> SimulatedArm:
    """Return an arm for a task: without contacts for `reach`, with a mark on the table for `place`.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    if task == "reach":
        return SimulatedArm(domain, size=size, views=views)
    return ContactArm(domain, size=size, mark=task == "place", views=views)
