"""Oracles: scripts that know the position of the block, push and pick. Upper bound and source of demonstrations."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.simulation.closed_loop.policies import Moves, Oracle, Policy, shortened
from vjepa2_ac.simulation.closed_loop.tasks import GRASP_M, HOLDING, TaskName, TaskProblem
from vjepa2_ac.simulation.world.arm import SimulatedArm

_PUSH_M = 0.035  # per model step: a block that is hit faster slides on
_NEAR_M = 0.006  # a block closer to its goal is not moved
_OVER_M = 0.012  # closer to the place of the grasp than this, fingers can close
_CLEAR_M = 0.065  # above the place of the grasp, fingers pass over the block


class _Scripted:
    """Base of the oracles: observes the block.

    Args:
        limits: The allowed actions.
        arm: The arm whose block is observed.
    """

    name, why, moves = "oracle", "scripted", Moves.FLANGE

    def __init__(self, limits: LimitsConfig, arm: SimulatedArm) -> None:
        self._limits, self._arm = limits, arm


class PushOracle(_Scripted):
    """Pushes the block along the line to its goal. Does not rotate."""

    def reset(self, problem: TaskProblem, goal_image: UInt8[np.ndarray, "height width 3"]) -> None:  # noqa: ARG002
        """Set the goal."""
        self._goal, self._end = _block(problem.block_goal)[:2], problem.goal
        way = self._goal - _block(problem.block_start)[:2]
        self._ahead = way / np.linalg.norm(way)

    def act(
        self,
        image: UInt8[np.ndarray, "height width 3"],  # noqa: ARG002 - of the protocol
        state: Float[np.ndarray, " 7"],
    ) -> Float[np.ndarray, " 7"]:
        """Return the next step of the push: forwards, straight behind the block."""
        block = _block(self._arm.block)[:2]
        if (self._goal - block) @ self._ahead < _NEAR_M:  # the rest is too short, or it slid past
            return np.zeros(ACTION_DIM)
        to_block = block - state[:2]
        beside = to_block - self._ahead * (to_block @ self._ahead)
        ahead = self._ahead * ((self._end[:2] - state[:2]) @ self._ahead)
        way = np.zeros(ACTION_DIM)
        way[:2], way[2], way[6] = ahead + beside, self._end[2] - state[2], 1.0 - state[6]
        way[:3] *= min(1.0, _PUSH_M / float(np.linalg.norm(way[:3])))
        return shortened(way, self._limits)


class PickOracle(_Scripted):
    """Moves over the block, down, closes, and lifts. Does not rotate."""

    def reset(self, problem: TaskProblem, goal_image: UInt8[np.ndarray, "height width 3"]) -> None:  # noqa: ARG002
        """Set the goal."""
        self._end = problem.goal

    def act(
        self,
        image: UInt8[np.ndarray, "height width 3"],  # noqa: ARG002 - of the protocol
        state: Float[np.ndarray, " 7"],
    ) -> Float[np.ndarray, " 7"]:
        """Return the next step of the grasp."""
        place = _block(self._arm.block)[:3] + np.array([0.0, 0.0, GRASP_M])
        way = np.zeros(ACTION_DIM)
        to_place = place - state[:3]
        if np.linalg.norm(to_place) < _OVER_M * 1.5 and state[6] > HOLDING - 0.1:
            way[:3], way[6] = self._end[:3] - state[:3], 1.0 - state[6]  # it is held: lift, and keep closing
        elif np.linalg.norm(to_place) < _OVER_M:
            way[6] = 1.0 - state[6]
        else:
            way[:3], way[6] = to_place, -state[6]
            if np.linalg.norm(to_place[:2]) > _OVER_M:
                way[2] = max(way[2], min(0.0, way[2] + _CLEAR_M))  # not down on the block's edge
        return shortened(way, self._limits)


def oracle_for(task: TaskName, limits: LimitsConfig, arm: SimulatedArm) -> Policy:
    """Return the oracle of a task, for an arm from `arm_for`."""
    if task == "push":
        return PushOracle(limits, arm)
    return PickOracle(limits, arm) if task == "pick" else Oracle(limits)


def _block(block: Float[np.ndarray, " 4"] | None) -> Float[np.ndarray, " 4"]:
    if block is None:
        raise ValueError("no block to push or pick")
    return block
