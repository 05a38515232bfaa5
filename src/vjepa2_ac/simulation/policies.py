"""Policies of the simulated robot: a planner, and its references: zero actions, random actions and an oracle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.data.transforms import frame_of_seen, split_views
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.evaluation.imagined import imagined_next
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.arm import Block, SimulatedArm, State
from vjepa2_ac.simulation.tasks import GRASP_M, RELEASED, Problem, TaskName, TaskProblem

GoalsOf = Callable[[Any], Sequence[SubGoal]]  # of a problem of its world
Image = UInt8[np.ndarray, "height width 3"]

_ALMOST = 1 - 1e-9  # of a limit: rounding must not exceed it


class Moves(Enum):
    """What a policy observes and changes: the flange's pose, or the joints; and the gripper."""

    FLANGE = 7
    JOINTS = 8


class Policy(Protocol):
    """Chooses the action of the next model step (legend of actions: episode.py; of joints, radians and closedness)."""

    name: str
    why: str  # reason of the last action, short enough to be counted
    moves: Moves  # what its states and actions are: poses of the flange, or joint angles and gripper

    def reset(self, problem: Problem, goal_image: Image) -> None:
        """Begin an episode. Only an oracle uses more of the problem than the images."""

    def act(self, image: Image, state: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
        """Return the action of the next model step from the camera image and the measured state, in base frame."""


class ZeroActions:
    """Does not move the arm. Base of the references, which look at no image.

    Args:
        limits: The allowed actions.
    """

    name, why, moves = "zero action", "nothing", Moves.FLANGE

    def __init__(self, limits: LimitsConfig | None = None) -> None:
        self._limits = limits or LimitsConfig()

    def reset(self, problem: Problem, goal_image: Image) -> None:
        """Begin an episode."""

    def act(self, image: Image, state: State) -> State:  # noqa: ARG002 - of the protocol
        """Return the next action, within the limits."""
        return shortened(self._way(state), self._limits)

    def _way(self, state: State) -> State:
        """Return the action before it is shortened."""
        return np.zeros_like(state)


class RandomActions(ZeroActions):
    """Draws actions uniformly from the allowed ones; the same problem gets the same actions.

    Args:
        limits: The allowed actions: `xyz`, `rotation` and `gripper` of each axis, and the ball.
        seed: Of the actions, with the problem's number.
    """

    name, why = "random", "random"

    def __init__(self, limits: LimitsConfig, seed: int = 0) -> None:
        super().__init__(limits)
        self._seed, self._rng = seed, np.random.default_rng(seed)

    def reset(self, problem: Problem, goal_image: Image) -> None:  # noqa: ARG002
        """Seed the generator for this problem."""
        self._rng = np.random.default_rng([self._seed, problem.index])

    def _way(self, state: State) -> State:
        return np.asarray(self._rng.uniform(-1.0, 1.0, size=len(state)) * farthest(self._limits))


class Oracle(ZeroActions):
    """Knows the goal state and observes the block, and does the task as fast as allowed. Does not rotate.

    Args:
        limits: The allowed actions.
        arm: The arm whose block is observed; None: the task is `reach`, which has none.
    """

    name, why = "oracle", "scripted"

    def __init__(self, limits: LimitsConfig, arm: SimulatedArm | None = None) -> None:
        super().__init__(limits)
        self._arm = arm

    def reset(self, problem: Problem, goal_image: Image) -> None:  # noqa: ARG002
        """Set the goal.

        Raises:
            ValueError: It is a problem of another world.
        """
        self._problem = TaskProblem.of(problem)

    def _way(self, state: State) -> State:
        way = _WAYS.get(self._problem.task)
        block = None if self._arm is None else self._arm.block
        return _reach_way(self._problem, state) if way is None or block is None else way(self._problem, state, block)


class Planning:
    """A world model that plans from the images and the measured state.

    Args:
        controller: Plans with the model; its last `decision` can be read after every action.
        name: Of the model, as shown in tables.
        decoder: Shows what it imagines, on the model's device; None: nothing does.
        goals_of: Returns the goals on the way of a problem, with the last one; None: the problem's goal image only.
            Their gripper modes are left out for a robot of joints, whose gripper is a number like the others.
    """

    def __init__(
        self,
        controller: Controller,
        name: str = "model",
        decoder: TrainedDecoder | None = None,
        goals_of: GoalsOf | None = None,
    ) -> None:
        self.controller, self.name, self.why, self._goals_of = controller, name, "", goals_of
        self._decoder = None if decoder is None else decoder.to(controller.device)
        self._size = (0, 0)  # of the last image
        self.moves = Moves.FLANGE if controller.spaces.state.position is not None else Moves.JOINTS

    def reset(self, problem: Problem, goal_image: Image) -> None:
        """Give the planner the goal image, or the goals on the way."""
        if self._goals_of is None:
            self.controller.reset(goal_image)
            return
        goals, has_gripper = self._goals_of(problem), self.controller.spaces.state.is_pose
        self.controller.follow(goals if has_gripper else [replace(goal, gripper=None) for goal in goals])

    def act(self, image: Image, state: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
        """Return the first action of a plan; for joints as a change, whatever the model was taught."""
        action = self.controller.act(image, state)
        self._size = image.shape[0], image.shape[1]
        self.why = self.controller.decision.why if self.controller.decision else ""
        return action - state if self.controller.spaces.action.follows == "target" else action

    def imagined(self) -> Image | None:
        """Return the next camera image as it was imagined with the last action; white where the model sees nothing.

        None: there is no decoder, or nothing was imagined, for example since the goal is reached.
        """
        decision = self.controller.decision
        found = None if self._decoder is None or decision is None else imagined_next(decision, self._decoder)
        if found is None:
            return None
        height, width, views = *self._size, self.controller.config.views
        parts = split_views(found[None], views)
        return np.hstack([frame_of_seen(part, height, width // views, self.controller.crop) for part in parts])


def farthest(limits: LimitsConfig) -> Float[np.ndarray, " 7"]:
    """Return the largest size of each component of an action, without the ball; 0 where it is fixed."""
    gripper = 0.0 if limits.gripper_mode == "held" else limits.gripper
    return np.array([*limits.xyz_m, *[limits.rotation] * 3, gripper])


def shortened(way: Float[np.ndarray, " 7"], limits: LimitsConfig) -> Float[np.ndarray, " 7"]:
    """Return the displacement of a model step, in its direction, clipped to the limits.

    Position, rotation and gripper are scaled independently; a fixed axis is left out.
    """
    reach = farthest(limits)
    way = np.where(reach > 0, way, 0.0)
    for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
        beyond = np.abs(way[part]) / np.where(reach[part] > 0, reach[part], 1.0)
        way[part] *= min(1.0, _ALMOST / max(float(beyond.max()), 1e-12))
    if limits.ball != "none":
        length = float(np.linalg.norm(way[:3], ord=1 if limits.ball == "l1" else 2))
        way[:3] *= min(1.0, _ALMOST * limits.radius / max(length, 1e-12))
    return way


_PUSH_M = 0.035  # per model step: a block that is hit faster slides on
_NEAR_M = 0.006  # a block closer to its goal is not moved
_OVER_M = 0.012  # closer to the place of the grasp than this, fingers can close
_CLEAR_M = 0.065  # above the place of the grasp, fingers pass over the block
_PLACED_M, _LOW_M = 0.02, 0.01  # a block that is closer to the mark's middle and to the table is let go
_CARRY_M, _LIFTED_M = 0.08, 0.03  # height over the table of a carried block, and the least before it is carried
_TO_MARK_M = 0.03  # a block that is closer to the mark's middle goes down


def _reach_way(problem: TaskProblem, state: State) -> State:
    """Straight to the goal."""
    way: np.ndarray = problem.goal - state
    way[3:6] = 0.0
    return way


def _push_way(problem: TaskProblem, state: State, block: Block) -> State:
    """Push the block along the line to its goal: forwards, straight behind the block."""
    goal, way = problem.ends[1, :2], np.zeros_like(state)
    direction = goal - problem.ends[0, :2]
    direction = direction / np.linalg.norm(direction)
    if (goal - block[:2]) @ direction < _NEAR_M:  # the rest is too short, or it slid past
        return way
    to_block = block[:2] - state[:2]
    beside = to_block - direction * (to_block @ direction)
    ahead = direction * ((problem.goal[:2] - state[:2]) @ direction)
    way[:2], way[2], way[6] = ahead + beside, problem.goal[2] - state[2], 1.0 - state[6]
    way[:3] *= min(1.0, _PUSH_M / float(np.linalg.norm(way[:3])))
    return way


def _pick_way(problem: TaskProblem, state: State, block: Block) -> State:
    """Move over the block, down, close, and lift."""
    if not _holds(state, block):
        return _grasp_way(state, block)
    way = np.zeros_like(state)
    way[:3], way[6] = problem.goal[:3] - state[:3], 1.0 - state[6]  # lift, and keep closing
    return way


def _place_way(problem: TaskProblem, state: State, block: Block) -> State:
    """Pick the block up, carry it over the mark, put it down, open, and move up."""
    goal, way = problem.ends[1], np.zeros_like(state)
    to_goal = goal[:3] - block[:3]
    if np.linalg.norm(to_goal[:2]) < _PLACED_M and -to_goal[2] < _LOW_M:
        way[6] = -state[6]
        if state[6] < RELEASED:
            way[:3] = problem.goal[:3] - state[:3]
        return way
    if not _holds(state, block):
        return _grasp_way(state, block)
    way[:3], way[6] = to_goal, 1.0 - state[6]
    if np.linalg.norm(to_goal[:2]) > _TO_MARK_M:
        way[2] += _CARRY_M
        way[:2] *= float(block[2] - goal[2] > _LIFTED_M)  # first up
    return way


_WAYS: dict[TaskName, Callable[[TaskProblem, np.ndarray, np.ndarray], np.ndarray]] = {
    "push": _push_way,
    "pick": _pick_way,
    "place": _place_way,
}


def _to_grasp(state: State, block: Block) -> Float[np.ndarray, " 3"]:
    return np.asarray(block[:3] + np.array([0.0, 0.0, GRASP_M]) - state[:3])


def _holds(state: State, block: Block) -> bool:
    return bool(np.linalg.norm(_to_grasp(state, block)) < _OVER_M * 1.5 and state[6] > RELEASED)


def _grasp_way(state: State, block: Block) -> State:
    """Move over the block, down, and close."""
    way, to_place = np.zeros_like(state), _to_grasp(state, block)
    if np.linalg.norm(to_place) < _OVER_M:
        way[6] = 1.0 - state[6]
    else:
        way[:3], way[6] = to_place, -state[6]
        if np.linalg.norm(to_place[:2]) > _OVER_M:
            way[2] = max(way[2], min(0.0, way[2] + _CLEAR_M))  # not down on the block's edge
    return way
