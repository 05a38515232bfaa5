"""Forward and inverse kinematics of the arm: the flange pose of joint angles, and joint angles for a pose.

Franka's published kinematics as plain arithmetic: no simulator is needed to know where the arm is. Poses are 6 numbers
in the robot base frame: x, y, z in metres; roll, pitch, yaw in radians, extrinsic xyz Euler (legend: episode.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.geometry import euler_from_matrices, matrices_from_euler

FLANGE_OFFSET_M = 0.107


@dataclass(frozen=True)
class Joint:
    """A revolute joint and its frame in that of the previous joint: Rx(twist) Tx(length) Rz(angle) Tz(offset)."""

    length_m: float
    twist_deg: float
    offset_m: float
    low_rad: float
    high_rad: float


JOINTS = (  # Source: Franka Emika, robot and interface specifications: DH parameters (Craig) and joint limits
    Joint(0.0, 0.0, 0.333, -2.8973, 2.8973),
    Joint(0.0, -90.0, 0.0, -1.7628, 1.7628),
    Joint(0.0, 90.0, 0.316, -2.8973, 2.8973),
    Joint(0.0825, 90.0, 0.0, -3.0718, -0.0698),
    Joint(-0.0825, -90.0, 0.384, -2.8973, 2.8973),
    Joint(0.0, 90.0, 0.0, -0.0175, 3.7525),
    Joint(0.088, 90.0, 0.0, -2.8973, 2.8973),
)
LOW = np.array([joint.low_rad for joint in JOINTS])
HIGH = np.array([joint.high_rad for joint in JOINTS])
HOME = np.array([0.0, -0.4, 0.0, -2.4, 0.0, 2.0, 0.8])
"""The gripper points down in front of the robot; the flange is near (0.42, 0, 0.46)."""

_TOLERANCE_M, _TOLERANCE_RAD, _ITERATIONS = 1e-5, 1e-4, 200


class OutOfReachError(ValueError):
    """No joint angles within the limits bring the flange to this pose."""


def forward_kinematics(joints: Float[np.ndarray, "*batch 7"]) -> Float[np.ndarray, "*batch 6"]:
    """Return the pose of the flange in the robot base frame."""
    frame = _frames(joints)[-1]
    return np.concatenate([frame[..., :3, 3], euler_from_matrices(frame[..., :3, :3])], axis=-1)


def inverse_kinematics(
    pose: Float[np.ndarray, " 6"], start: Float[np.ndarray, " 7"] = HOME, *, rest: Float[np.ndarray, " 7"] = HOME
) -> Float[np.ndarray, " 7"]:
    """Return joint angles that bring the flange to a pose: to 0.01 mm and 0.006 degrees, within the limits.

    Damped least squares, the damping falling with the error; the redundant degree of freedom is pulled to `rest`: a
    smooth path of poses, each started at the previous solution, gives a smooth path of joints.

    Raises:
        OutOfReachError: The pose was not reached from `start`, nor from `rest`.
    """
    rotation = matrices_from_euler(pose[3:])
    for first in (start, rest):
        joints = np.clip(np.asarray(first, dtype=np.float64), LOW, HIGH)
        for _ in range(_ITERATIONS):
            frames = _frames(joints)
            turn = Rotation.from_matrix(rotation @ frames[-1][:3, :3].T).as_rotvec()
            error = np.concatenate([pose[:3] - frames[-1][:3, 3], turn])
            if np.abs(error[:3]).max() < _TOLERANCE_M and np.abs(error[3:]).max() < _TOLERANCE_RAD:
                return joints
            joints = _limited_step(_jacobian(frames), error, joints, rest)
    raise OutOfReachError(f"no joint angles within the limits bring the flange to {np.round(pose, 3).tolist()}")


def _limited_step(
    jacobian: Float[np.ndarray, "6 7"],
    error: Float[np.ndarray, " 6"],
    joints: Float[np.ndarray, " 7"],
    rest: Float[np.ndarray, " 7"],
) -> Float[np.ndarray, " 7"]:
    """Return the joints after one step; a joint pushed against its limit stays, and the others compensate."""
    free = np.ones(7)
    for _ in range(3):
        step = _step(jacobian * free, error, (rest - joints) * free)
        pushing = ((joints + step < LOW) & (joints <= LOW)) | ((joints + step > HIGH) & (joints >= HIGH))
        if not pushing.any():
            break
        free[pushing] = 0.0
    return np.clip(joints + step * free, LOW, HIGH)


def _step(
    jacobian: Float[np.ndarray, "6 7"], error: Float[np.ndarray, " 6"], to_rest: Float[np.ndarray, " 7"]
) -> Float[np.ndarray, " 7"]:
    """Return one damped step towards the pose, and in its null space towards rest.

    The pull to rest fades with the error: near the pose it must not disturb the convergence.
    """
    size = float(np.linalg.norm(error))
    damped = jacobian @ jacobian.T + (1e-7 + 0.05 * size**2) * np.eye(6)
    pull = min(0.3, 3.0 * size) * to_rest
    step: np.ndarray = jacobian.T @ np.linalg.solve(damped, error - jacobian @ pull) + pull
    return step * min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))


def _jacobian(frames: list[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "6 7"]:
    axes = np.stack([frame[:3, 2] for frame in frames[:-1]])
    arms = frames[-1][:3, 3] - np.stack([frame[:3, 3] for frame in frames[:-1]])
    return np.concatenate([np.cross(axes, arms), axes], axis=1).T


def _frames(joints: Float[np.ndarray, "*batch 7"]) -> list[Float[np.ndarray, "*batch 4 4"]]:
    """Return the frames of the seven links and of the flange in the base frame."""
    cos, sin = np.cos(joints)[..., None], np.sin(joints)[..., None]
    links = _CONSTANT + _COSINE * cos[..., None] + _SINE * sin[..., None]
    frames = [links[..., 0, :, :]]
    for index in range(1, len(JOINTS)):
        frames.append(frames[-1] @ links[..., index, :, :])
    frames.append(frames[-1] @ _FLANGE)
    return frames


def _link_terms() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the link transforms as constant + cosine * cos(angle) + sine * sin(angle), each [7, 4, 4]."""
    constant, cosine, sine = (np.zeros((len(JOINTS), 4, 4)) for _ in range(3))
    for index, joint in enumerate(JOINTS):
        twist = np.deg2rad(joint.twist_deg)
        ct, st = np.cos(twist), np.sin(twist)
        cosine[index, :3, :2] = [[1, 0], [0, ct], [0, st]]
        sine[index, :3, :2] = [[0, -1], [ct, 0], [st, 0]]
        constant[index, :3, 2] = [0, -st, ct]
        constant[index, :3, 3] = [joint.length_m, -st * joint.offset_m, ct * joint.offset_m]
        constant[index, 3, 3] = 1.0
    return constant, cosine, sine


_CONSTANT, _COSINE, _SINE = _link_terms()
_FLANGE = np.eye(4)
_FLANGE[2, 3] = FLANGE_OFFSET_M
