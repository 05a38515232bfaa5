"""Oracles: scripts that know where the block is, for push, pick and place. Upper bound, source of demonstrations."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.simulation.closed_loop.policies import Oracle, Policy, Reference
from vjepa2_ac.simulation.closed_loop.tasks import GRASP_M, RELEASED, TaskName
from vjepa2_ac.simulation.world.arm import SimulatedArm

_PUSH_M = 0.035  # per model step: a block that is hit faster slides on
_NEAR_M = 0.006  # a block closer to its goal is not moved
_OVER_M = 0.012  # closer to the place of the grasp than this, fingers can close
_CLEAR_M = 0.065  # above the place of the grasp, fingers pass over the block
_PLACED_M, _LOW_M = 0.02, 0.01  # a block that is closer to the mark's middle and to the table is let go
_CARRY_M, _LIFTED_M = 0.08, 0.03  # height over the table of a carried block, and the least before it is carried
_TO_MARK_M = 0.03  # a block that is closer to the mark's middle goes down


class _BlockOracle(Reference):
    """Base of the oracles with a block, which they observe.

    Args:
        limits: The allowed actions.
        arm: The arm whose block is observed.
    """

    def __init__(self, limits: LimitsConfig, arm: SimulatedArm) -> None:
        super().__init__(limits)
        self._arm = arm


class PushOracle(_BlockOracle):
    """Pushes the block along the line to its goal: forwards, straight behind the block. Does not rotate."""

    def _way(self, state: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 7"]:
        goal, end = _block(self._problem.block_goal)[:2], self._problem.goal
        direction = goal - _block(self._problem.block_start)[:2]
        direction = direction / np.linalg.norm(direction)
        block, way = _block(self._arm.block)[:2], np.zeros_like(state)
        if (goal - block) @ direction < _NEAR_M:  # the rest is too short, or it slid past
            return way
        to_block = block - state[:2]
        beside = to_block - direction * (to_block @ direction)
        ahead = direction * ((end[:2] - state[:2]) @ direction)
        way[:2], way[2], way[6] = ahead + beside, end[2] - state[2], 1.0 - state[6]
        way[:3] *= min(1.0, _PUSH_M / float(np.linalg.norm(way[:3])))
        return way


class PickOracle(_BlockOracle):
    """Moves over the block, down, closes, and lifts. Does not rotate."""

    def _way(self, state: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 7"]:
        if not self._holds(state):
            return self._grasp(state)
        way = np.zeros_like(state)
        way[:3], way[6] = self._problem.goal[:3] - state[:3], 1.0 - state[6]  # lift, and keep closing
        return way

    def _holds(self, state: Float[np.ndarray, " 7"]) -> bool:
        return bool(np.linalg.norm(self._to_grasp(state)) < _OVER_M * 1.5 and state[6] > RELEASED)

    def _to_grasp(self, state: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 3"]:
        return np.asarray(_block(self._arm.block)[:3] + np.array([0.0, 0.0, GRASP_M]) - state[:3])

    def _grasp(self, state: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 7"]:
        """Return the way over the block, down, and closing."""
        way, to_place = np.zeros_like(state), self._to_grasp(state)
        if np.linalg.norm(to_place) < _OVER_M:
            way[6] = 1.0 - state[6]
        else:
            way[:3], way[6] = to_place, -state[6]
            if np.linalg.norm(to_place[:2]) > _OVER_M:
                way[2] = max(way[2], min(0.0, way[2] + _CLEAR_M))  # not down on the block's edge
        return way


class PlaceOracle(PickOracle):
    """Picks the block up, carries it over the mark, puts it down, opens, and moves up. Does not rotate."""

    def _way(self, state: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 7"]:
        block, goal = _block(self._arm.block)[:3], _block(self._problem.block_goal)[:3]
        to_goal, way = goal - block, np.zeros_like(state)
        if np.linalg.norm(to_goal[:2]) < _PLACED_M and -to_goal[2] < _LOW_M:
            way[6] = -state[6]
            if state[6] < RELEASED:
                way[:3] = self._problem.goal[:3] - state[:3]
            return way
        if not self._holds(state):
            return self._grasp(state)
        way[:3], way[6] = to_goal, 1.0 - state[6]
        if np.linalg.norm(to_goal[:2]) > _TO_MARK_M:
            way[2] += _CARRY_M
            way[:2] *= float(block[2] - goal[2] > _LIFTED_M)  # first up
        return way


def oracle_for(task: TaskName, limits: LimitsConfig, arm: SimulatedArm) -> Policy:
    """Return the oracle of a task, for an arm from `arm_for`."""
    kinds: dict[TaskName, type[_BlockOracle]] = {"push": PushOracle, "pick": PickOracle, "place": PlaceOracle}
    return kinds[task](limits, arm) if task in kinds else Oracle(limits)


def _block(block: Float[np.ndarray, " 4"] | None) -> Float[np.ndarray, " 4"]:
    if block is None:
        raise ValueError("no block to push, pick or place")
    return block
