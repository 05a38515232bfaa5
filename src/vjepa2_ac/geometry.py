"""Conversions between poses and actions: Euler angles, rotation matrices, camera frame.

Euler angles wrap at pi (a gripper that points down has roll near pi), so differences are always computed with rotation
matrices.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def matrices_from_euler(angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return rotation matrices of extrinsic xyz Euler angles in radians: R = Rz(yaw) @ Ry(pitch) @ Rx(roll)."""
    flat = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_matrix()
    return np.asarray(flat).reshape(*angles.shape[:-1], 3, 3)


def euler_from_matrices(matrices: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return extrinsic xyz Euler angles in radians; roll and yaw in (-pi, pi], pitch in [-pi/2, pi/2]."""
    flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_euler("xyz")
    return np.asarray(flat).reshape(*matrices.shape[:-2], 3)


def actions_from_states(states: Float[np.ndarray, "time 7"]) -> Float[np.ndarray, "time-1 7"]:
    """Return the action from each state to the next.

    Translation and gripper subtract; rotation is R[t+1] @ R[t].T as extrinsic xyz Euler angles, so an action acts on
    the left. Legend of states and actions: `vjepa2_ac.episode`.

    Raises:
        ValueError: Fewer than two states.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/droid.py, poses_to_diffs.
    """
    if len(states) < 2:
        raise ValueError(f"an action needs two states; got {len(states)}")
    delta = rotation_differences(states[:, 3:6])
    return np.concatenate([np.diff(states[:, :3], axis=0), delta, np.diff(states[:, 6:], axis=0)], axis=-1)


def rotation_differences(angles: Float[np.ndarray, "time 3"]) -> Float[np.ndarray, "time-1 3"]:
    """Return R[t+1] @ R[t].T as extrinsic xyz Euler angles."""
    rotations = matrices_from_euler(angles)
    return euler_from_matrices(rotations[1:] @ rotations[:-1].swapaxes(-1, -2))


def apply_action(
    state: Float[np.ndarray, "*batch 7"], action: Float[np.ndarray, "*batch 7"]
) -> Float[np.ndarray, "*batch 7"]:
    """Return the state that an action leads to: xyz and gripper add, R' = R_delta @ R.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, compute_new_pose.
    """
    rotation = matrices_from_euler(action[..., 3:6]) @ matrices_from_euler(state[..., 3:6])
    return np.concatenate(
        [state[..., :3] + action[..., :3], euler_from_matrices(rotation), state[..., 6:] + action[..., 6:]], axis=-1
    )


def states_in_camera_frame(
    states: Float[np.ndarray, "time 7"], extrinsics: Float[np.ndarray, "time 6"]
) -> Float[np.ndarray, "time 7"]:
    """Return states whose pose is given in the camera's frame: inverse(camera pose) @ pose. The gripper stays.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/droid.py, transform_frame.
    """
    camera = matrices_from_euler(extrinsics[:, 3:6]).swapaxes(-1, -2)
    position = (camera @ (states[:, :3] - extrinsics[:, :3])[..., None])[..., 0]
    rotation = euler_from_matrices(camera @ matrices_from_euler(states[:, 3:6]))
    return np.concatenate([position, rotation, states[:, 6:]], axis=-1)
