"""Tasks of the simulated robot: start and target of arm and block, and the criterion of success.

They are drawn in the world frame: a problem looks the same in every domain, however the robot is mounted.
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
"""Closer than this at the end is a success: the flange to its goal (reach), or the block's middle to its own.

place: as push, since the block lies on the table, too; its middle is on the mark then, with 1.5 cm to the edge. That is
not all: `TaskProblem.succeeded`.
"""

STEPS: dict[TaskName, int] = {"reach": 8, "push": 8, "pick": 12, "place": 18}
"""Default number of model steps of an episode; place: the paper's 4 + 10 + 4 of pick-and-place."""

REACH_WAY_M, PUSH_WAY_M, LIFT_M, PLACE_WAY_M = (0.12, 0.25), (0.10, 0.16), (0.10, 0.14), (0.10, 0.20)
"""Distance between start and goal: of the flange (reach), of the block (push, place), of the block upwards (pick)."""

GRASP_M = FINGERTIP_M - 0.02  # height of the flange over the middle of a block that is to be grasped

HOLDING = 1.0 - (BLOCK_M / 2 - FINGER_INSIDE_M) / FINGER_TRAVEL_M  # closedness of a gripper that holds the block

RELEASED = HOLDING - 0.1  # A gripper that is less closed than this holds no block: 4 mm are left on each side

_FLANGE_AREA = np.array([[0.32, -0.26], [0.62, 0.26]])  # low and high (x, y) in the world
_BLOCK_AREA = np.array([[0.36, -0.26], [0.64, 0.26]])
_PUSHING_M = 0.17  # height of the flange while pushing: the fingertips are 2 cm over the table
_GRASP_AREA = _FLANGE_AREA * 0.8 + 0.2 * _FLANGE_AREA.mean(axis=0)  # of a block that is to be picked up, or put down
_LIES_M = 0.01  # a block whose middle is at most this far from the height of a lying one lies on the table
_MOST_TURNED_RAD = 0.4  # of block and hand, from straight ahead


@dataclass(frozen=True)
class TaskProblem:
    """One start and one goal of the simulated arm. All poses are in its base frame (legend: episode.py).

    A block is given by its centre and its rotation about z: x, y, z in metres, radians.
    """

    task: TaskName
    index: int
    start: State
    goal: State  # of the arm in the goal image
    block_start: Block | None = None  # None: there is no block
    block_goal: Block | None = None

    @property
    def ends(self) -> Float[np.ndarray, "2 4"]:
        """Start and goal of the block.

        Raises:
            ValueError: There is none.
        """
        if self.block_start is None or self.block_goal is None:
            raise ValueError(f"{self.task} is done without a block")
        return np.stack([self.block_start, self.block_goal])

    @property
    def mark(self) -> Mark | None:
        """Middle of the mark on the table, x and y: under the block's goal (place); None: there is none."""
        return self.block_goal[:2] if self.task == "place" and self.block_goal is not None else None

    def distance_m(self, state: State, block: Block | None = None) -> float:
        """Return the distance of the moved object to its goal: of the block if there is one, else of the flange.

        Rotations and the gripper do not count.

        Raises:
            ValueError: The problem has a block, and none is given.
        """
        if self.block_goal is None:
            return float(np.linalg.norm(state[:3] - self.goal[:3]))
        if block is None:
            raise ValueError(f"{self.task} is done by a block, and there is none")
        return float(np.linalg.norm(block[:3] - self.block_goal[:3]))

    def succeeded(self, state: State, block: Block | None = None) -> bool:
        """Return whether the task is done in a state of arm and block.

        The distance is below `SUCCESS_M`; place: and the block lies on the table, and the gripper has released it.

        Raises:
            ValueError: The problem has a block, and none is given.
        """
        near = self.distance_m(state, block) < SUCCESS_M[self.task]
        if self.task != "place" or block is None or self.block_goal is None:
            return near
        return near and bool(abs(block[2] - self.block_goal[2]) < _LIES_M and state[6] < RELEASED)


def make_problem(task: TaskName, domain: Domain, seed: int, index: int) -> TaskProblem:
    """Return a problem: a pure function of its arguments, and the same in the world in every domain.

    reach: both ends in the box of `MotionRecipe`, gripper pointing down, the same rotation and gripper at both.
    push: the closed gripper is behind the block, low; the goal is straight ahead, the gripper still behind the block.
    pick: the open gripper is over the block; at the goal it holds the block in the air.
    place: the open gripper is over the block; at the goal the block lies on the mark, and the gripper is over it, open.

    Args:
        task: The task.
        domain: Determines only the frame of the problem.
        seed: Of the problems.
        index: Of the problem.
    """
    drawn = _DRAWN[task](np.random.default_rng([seed, index, list(_DRAWN).index(task)]))
    poses = poses_in_base(downward_poses(_with(drawn.flange, drawn.turn)), domain)
    first, last = np.concatenate([poses, np.array(drawn.closedness)[:, None]], axis=1)
    if drawn.blocks is None:
        return TaskProblem(task, index, first, last)
    turns = drawn.blocks[:, 3:] - np.deg2rad(domain.base_yaw_deg)
    blocks = np.concatenate([drawn.blocks[:, :3] @ domain.base_pose()[:3, :3], turns], axis=1)
    return TaskProblem(task, index, first, last, *blocks)


@dataclass(frozen=True)
class _Drawn:
    """Start and goal in the world frame."""

    flange: Float[np.ndarray, "2 3"]
    turn: float  # rotation of the hand about the vertical, at both
    closedness: tuple[float, float]
    blocks: Float[np.ndarray, "2 4"] | None = None


def _reach(rng: np.random.Generator) -> _Drawn:
    recipe = MotionRecipe()
    low, high = np.array(recipe.low_m), np.array(recipe.high_m)
    start = rng.uniform(low, high)
    while not REACH_WAY_M[0] <= np.linalg.norm((goal := rng.uniform(low, high)) - start) <= REACH_WAY_M[1]:
        pass
    turn, closedness = rng.uniform(-recipe.max_turn_rad, recipe.max_turn_rad), float(rng.integers(2))
    return _Drawn(np.stack([start, goal]), turn, (closedness, closedness))


def _push(rng: np.random.Generator) -> _Drawn:
    """Push forwards with the fingers' broad side, or to the left or right with a finger's outer side."""
    while True:
        turn = rng.uniform(-_MOST_TURNED_RAD, _MOST_TURNED_RAD)
        side = int(rng.integers(-1, 2))  # right, ahead, left
        angle = turn + side * np.pi / 2
        ahead = np.array([np.cos(angle), np.sin(angle)])
        touching = BLOCK_M / 2 + (FINGER_OUTSIDE_M if side else FINGER_HALF_M)
        before, way = rng.uniform(0.03, 0.07), rng.uniform(*PUSH_WAY_M)
        block = rng.uniform(*_BLOCK_AREA)
        blocks = np.stack([block, block + way * ahead])
        flange = blocks - ahead * np.array([[touching + before], [touching]])
        if _inside(blocks, _BLOCK_AREA) and _inside(flange, _FLANGE_AREA):
            return _Drawn(_with(flange, _PUSHING_M), turn, (1.0, 1.0), _with(_with(blocks, BLOCK_M / 2), turn))


def _pick(rng: np.random.Generator) -> _Drawn:
    turn = rng.uniform(-_MOST_TURNED_RAD, _MOST_TURNED_RAD)
    block = np.append(rng.uniform(*_GRASP_AREA), BLOCK_M / 2)
    lifted = block + np.append(rng.uniform(-0.03, 0.03, size=2), rng.uniform(*LIFT_M))
    above = block + np.append(rng.uniform(-0.04, 0.04, size=2), GRASP_M + rng.uniform(0.07, 0.12))
    flange = np.stack([above, lifted + np.array([0.0, 0.0, GRASP_M])])
    return _Drawn(flange, turn, (0.0, HOLDING), _with(np.stack([block, lifted]), turn))


def _place(rng: np.random.Generator) -> _Drawn:
    while True:
        turn, angle = rng.uniform(-_MOST_TURNED_RAD, _MOST_TURNED_RAD), rng.uniform(-np.pi, np.pi)
        block = rng.uniform(*_GRASP_AREA)
        places = np.stack([block, block + rng.uniform(*PLACE_WAY_M) * np.array([np.cos(angle), np.sin(angle)])])
        if _inside(places, _GRASP_AREA):
            break
    blocks = _with(places, BLOCK_M / 2)
    above = np.append(rng.uniform(-0.04, 0.04, size=2), GRASP_M + rng.uniform(0.07, 0.12))
    flange = blocks + np.stack([above, [0.0, 0.0, GRASP_M + rng.uniform(0.07, 0.10)]])
    return _Drawn(flange, turn, (0.0, 0.0), _with(blocks, turn))


_DRAWN: dict[TaskName, Callable[[np.random.Generator], _Drawn]] = {
    "reach": _reach,
    "push": _push,
    "pick": _pick,
    "place": _place,
}
"""The functions that draw a problem; a task's place among them is the number of its random stream."""


def _inside(places: Float[np.ndarray, "places 2"], area: Float[np.ndarray, "2 2"]) -> bool:
    return bool(((places >= area[0]) & (places <= area[1])).all())


def _with(places: Float[np.ndarray, "places dim"], value: float) -> Float[np.ndarray, "places dim+1"]:
    """Return places with one more coordinate, the same for all."""
    return np.concatenate([places, np.full((len(places), 1), value)], axis=1)


def arm_for(task: TaskName, domain: Domain, *, size: tuple[int, int] = FRAME_SIZE, views: int = 1) -> SimulatedArm:
    """Return an arm for a task: `reach` needs no contacts, `place` a mark on the table.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    if task == "reach":
        return SimulatedArm(domain, size=size, views=views)
    return ContactArm(domain, size=size, mark=task == "place", views=views)
