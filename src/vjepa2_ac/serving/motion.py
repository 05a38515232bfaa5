"""Motion: the poses at each control step on the way to a target, and a last check of all that is sent."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.planning.search_space import Workspace, is_allowed
from vjepa2_ac.spaces import StateSpace, apply_action, euler_from_matrices, matrices_from_euler


def waypoints(
    state: Float[np.ndarray, " 7"], action: Float[np.ndarray, " 7"], steps: int
) -> Float[np.ndarray, "steps 7"]:
    """Return evenly spaced poses to the target, which is the last: x, y, z, extrinsic xyz angles, closedness 0 .. 1.

    Positions go straight, rotations about one axis at one speed (R_delta^share @ R).

    Args:
        state: Measured: metres, radians, closedness.
        action: Its change in a model step.
        steps: Control steps of a model step.
    """
    shares = np.arange(1, steps + 1)[:, None] / steps
    turn = Rotation.from_matrix(matrices_from_euler(action[3:6])).as_rotvec()
    turns = Rotation.from_rotvec(shares * turn).as_matrix()
    poses = np.concatenate(
        [
            state[:3] + shares * action[:3],
            euler_from_matrices(turns @ matrices_from_euler(state[3:6])),
            state[6:] + shares * action[6:],
        ],
        axis=1,
    )
    poses[-1] = apply_action(state, action)  # to the last bit
    poses[:, 6] = poses[:, 6].clip(0.0, 1.0)
    return poses


_ROUNDING = 1e-6  # limits are float32 where actions are searched


def why_not_sent(
    state: Float[np.ndarray, " dim"], changes: Float[np.ndarray, "steps dim"], limits: LimitsConfig, space: StateSpace
) -> str:
    """Return why changes of a state must not be sent to a robot, as text; empty: they may.

    Args:
        state: Measured.
        changes: Of each model step, one after another.
        limits: Which they have to be within.
        space: What the numbers are.
    """
    if not np.isfinite(changes).all():
        return "a number that is not finite"
    if not space.is_pose:
        largest = np.array(limits.axes if isinstance(limits.axes, tuple) else (0.0,))
        return "more than planning.limits.axes" if (abs(changes) > largest + _ROUNDING).any() else ""
    if not all(is_allowed(change, limits, _ROUNDING) for change in changes[:, :3]):
        return "more than planning.limits.xyz or its ball"
    if (abs(changes[:, 3:6]) > min(limits.rotation + _ROUNDING, math.pi)).any():
        return "more than planning.limits.rotation"
    if abs(changes[:, 6]).max() > 1.0:  # open and close are changes of 1, whatever the limit
        return "more than a gripper can change"
    box, targets = Workspace.of(limits, space), state[:3] + np.cumsum(changes[:, :3], axis=0)
    is_out = box is not None and changes[:, :3].any() and (abs(box.way_back(targets)) > _ROUNDING).any()
    return "out of planning.limits.workspace" if is_out else ""
