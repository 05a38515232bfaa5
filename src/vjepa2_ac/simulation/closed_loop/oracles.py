"""Oracles: scripts that know the position of the block, push and pick. Upper bound and source of demonstrations."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.simulation.closed_loop.policies import Oracle, Policy, Reference
from vjepa2_ac.simulation.closed_loop.tasks import GRASP_M, HOLDING, TaskName
from vjepa2_ac.simulation.world.arm import SimulatedArm

_PUSH_M = 0.035  # per model step: a block that is hit faster slides on
_NEAR_M = 0.006  # a block closer to its goal is not moved
_OVER_M = 0.012  # closer to the place of the grasp than this, fingers can close
_CLEAR_M = 0.065  # above the place of the grasp, fingers pass over the block


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
        place = _block(self._arm.block)[:3] + np.array([0.0, 0.0, GRASP_M])
        way, to_place = np.zeros_like(state), place - state[:3]
        if np.linalg.norm(to_place) < _OVER_M * 1.5 and state[6] > HOLDING - 0.1:
            way[:3], way[6] = self._problem.goal[:3] - state[:3], 1.0 - state[6]  # it is held: lift, and keep closing
        elif np.linalg.norm(to_place) < _OVER_M:
            way[6] = 1.0 - state[6]
        else:
            way[:3], way[6] = to_place, -state[6]
            if np.linalg.norm(to_place[:2]) > _OVER_M:
                way[2] = max(way[2], min(0.0, way[2] + _CLEAR_M))  # not down on the block's edge
        return way


def oracle_for(task: TaskName, limits: LimitsConfig, arm: SimulatedArm) -> Policy:
    """Return the oracle of a task, for an arm from `arm_for`."""
    if task == "push":
        return PushOracle(limits, arm)
    return PickOracle(limits, arm) if task == "pick" else Oracle(limits)


def _block(block: Float[np.ndarray, " 4"] | None) -> Float[np.ndarray, " 4"]:
    if block is None:
        raise ValueError("no block to push or pick")
    return block
