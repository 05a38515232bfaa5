"""Inferred moves: the action that a model takes for the cause of the next frame, searched as a planner searches it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import CemConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, evaluate_actions
from vjepa2_ac.evaluation.action_use.turned_errors import turned, turned_errors
from vjepa2_ac.evaluation.axis_fit import AxisFit, fit_axes, yaw_of_least_error
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.planning.axes.mapping import Axes
from vjepa2_ac.planning.planner import Planner

_ROOM = 1.25  # extent of the search along each axis, relative to the longest executed move
_LEAST_M = 0.01
_MOVE = slice(0, 3)
_SEARCH = PlanningConfig(samples=48, iterations=6, start_std=0.67, cem=CemConfig(elites=6))


def infer_axes(
    model: Predictor, starts: Sequence[RolloutStart], *, at_once: int, progress: Progress = no_progress
) -> AxisFit:
    """Find the angle by which a model's axes are turned, infer the moves of the starts, and fit them to the executed.

    A move is inferred from the state turned by the angle: a model that is given the state in axes not its own takes it
    for another place (docs/planning.md has what this changes).

    Args:
        model: The predictor.
        starts: Of poses in the robot's base frame; one or more.
        at_once: Samples per batch.
        progress: Called with the number of finished starts.
    """
    names = [start.episode_id for start in starts]
    centre_m, errors = _turn_of_least_error(model, starts, at_once)
    axes = Axes(math.radians(yaw_of_least_error(errors, names).value), centre_m)
    executed = np.stack([_numbers(start.action)[_MOVE] for start in starts])
    reach = min(1.0, max(_LEAST_M, _ROOM * float(np.linalg.norm(executed, axis=1).max())))
    planner = Planner(
        _SEARCH.model_copy(update={"limits": LimitsConfig(xyz=(reach, reach, reach), gripper_mode="held")})
    )
    inferred = []
    for done, start in enumerate(starts, start=1):
        inferred.append(_inferred(model, turned(start, axes), planner, at_once))
        progress(done, len(starts))
    return fit_axes(np.stack(inferred), executed, errors, names, centre_m)


def _turn_of_least_error(
    model: Predictor, starts: Sequence[RolloutStart], at_once: int
) -> tuple[tuple[float, float], Float[np.ndarray, "starts angles"]]:
    """Return the better of two places to turn about, and the errors there.

    A robot that is mounted turned is turned about its base; a camera, rather about what it looks at: the middle of the
    motion.
    """
    middle = np.mean([_numbers(start.state)[:2] for start in starts], axis=0)
    places = ((0.0, 0.0), (float(middle[0]), float(middle[1])))
    tried = {place: turned_errors(model, starts, place, at_once=at_once) for place in places}
    best = min(places, key=lambda place: tried[place].sum(axis=0).min())
    return best, tried[best]


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
