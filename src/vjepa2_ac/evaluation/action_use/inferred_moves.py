"""Inferred moves: the action that a model takes for the cause of the next frame, searched as a planner searches it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import CemConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, evaluate_actions
from vjepa2_ac.evaluation.axis_fit import AxisFit, fit_axes
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.planning.axes.mapping import Axes
from vjepa2_ac.planning.planner import Planner

_ROOM = 1.25  # extent of the search along each axis, relative to the longest executed move
_LEAST_M = 0.01
_MOVE = slice(0, 3)
_SEARCH = PlanningConfig(samples=48, iterations=6, start_std=0.67, cem=CemConfig(elites=6))


def infer_axes(
    model: Predictor,
    starts: Sequence[RolloutStart],
    *,
    at_once: int,
    rounds: int = 2,
    progress: Progress = no_progress,
) -> AxisFit:
    """Infer the move of each start and fit them to the executed ones.

    The model is given the robot's states, and a move of the rest of its action, in axes that are not its own: so moves
    are inferred again with these turned by the angle that was found. In the simulator's world with a robot turned by 60
    degrees this takes the angle from 66 [57, 73] to 62 [56, 67].

    Args:
        model: The predictor.
        starts: Of poses in the robot's base frame; one or more.
        at_once: Samples per batch.
        rounds: Times that moves are inferred.
        progress: Called with the number of finished starts, of all rounds.
    """
    executed = np.stack([_numbers(start.action)[_MOVE] for start in starts])
    reach = min(1.0, max(_LEAST_M, _ROOM * float(np.linalg.norm(executed, axis=1).max())))
    planner = Planner(
        _SEARCH.model_copy(update={"limits": LimitsConfig(xyz=(reach, reach, reach), gripper_mode="held")})
    )
    seen, inferred, names = starts, executed, [start.episode_id for start in starts]
    for number in range(rounds):
        if number:
            axes = Axes(math.radians(fit_axes(inferred, executed, names).yaw_degrees.value))
            seen = [_turned(start, axes) for start in starts]
        found = []
        for start in seen:
            found.append(_inferred(model, start, planner, at_once))
            progress(number * len(starts) + len(found), rounds * len(starts))
        inferred = np.stack(found)
    return fit_axes(inferred, executed, names)


def _turned(start: RolloutStart, axes: Axes) -> RolloutStart:
    """Return a start as a model of these axes sees it, but for the move, which is searched."""
    return replace(
        start,
        state=axes.poses(start.state),
        action=torch.cat([start.action[_MOVE], axes.actions(start.action)[_MOVE.stop :]]),
        extrinsics=None if start.extrinsics is None else axes.poses(start.extrinsics),
    )


def _inferred(model: Predictor, start: RolloutStart, planner: Planner, at_once: int) -> Float[np.ndarray, " 3"]:
    """Return the move (dx, dy, dz) that predicts the next frame best; the rest of the action is the true one."""
    true = _numbers(start.action)

    def cost(actions: Float[Tensor, "samples 1 7"]) -> Float[Tensor, " samples"]:
        tried = np.tile(true, (len(actions), 1))
        tried[:, _MOVE] = actions[:, 0, _MOVE].double().numpy()
        return torch.from_numpy(evaluate_actions(model, start, tried, at_once=at_once).energy)

    drawn = int(start.generator(0).integers(2**62))
    return _numbers(planner.plan(cost, torch.Generator().manual_seed(drawn)).actions[0, _MOVE])


def _numbers(values: Tensor) -> Float[np.ndarray, " numbers"]:
    return values.detach().cpu().double().numpy()
