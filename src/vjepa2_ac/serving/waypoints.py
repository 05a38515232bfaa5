"""Waypoints: the poses at each control step of a model step, from the measured one to the target."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.geometry import apply_action, euler_from_matrices, matrices_from_euler


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
