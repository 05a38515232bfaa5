"""Kinematics of the arm, and random reaching motions whose commands the joints follow with a lag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from vjepa2_ac.simulation.domains import Domain
from vjepa2_ac.spaces import euler_from_matrices, matrices_from_euler

Joints = Float[np.ndarray, " 7"]  # angles in radians
Jacobian = Float[np.ndarray, "6 7"]

FLANGE_OFFSET_M = 0.107


LENGTH_M, TWIST_DEG, OFFSET_M, LOW, HIGH = np.array([
    [0.0, 0.0, 0.333, -2.8973, 2.8973],
    [0.0, -90.0, 0.0, -1.7628, 1.7628],
    [0.0, 90.0, 0.316, -2.8973, 2.8973],
    [0.0825, 90.0, 0.0, -3.0718, -0.0698],
    [-0.0825, -90.0, 0.384, -2.8973, 2.8973],
    [0.0, 90.0, 0.0, -0.0175, 3.7525],
    [0.088, 90.0, 0.0, -2.8973, 2.8973],
]).T  # fmt: skip
"""Seven revolute joints. The transform from the previous joint is Rx(twist) Tx(length) Rz(angle) Tz(offset).

LOW and HIGH are the joint limits in radians.

Source: Franka Emika, robot and interface specifications: DH parameters (Craig) and joint limits.
"""
HOME = np.array([0.0, -0.4, 0.0, -2.4, 0.0, 2.0, 0.8])
"""Rest position: the gripper points down in front of the robot; the flange is near (0.42, 0, 0.46) m."""

_TOLERANCE_M, _TOLERANCE_RAD, _ITERATIONS = 1e-5, 1e-4, 200


class OutOfReachError(ValueError):
    """No joint angles within the limits reach a pose of the flange."""


def forward_kinematics(joints: Float[np.ndarray, "*batch 7"]) -> Float[np.ndarray, "*batch 6"]:
    """Return the pose of the flange in the robot base frame."""
    frame = _frames(joints)[-1]
    return np.concatenate([frame[..., :3, 3], euler_from_matrices(frame[..., :3, :3])], axis=-1)


def inverse_kinematics(pose: Float[np.ndarray, " 6"], start: Joints = HOME, *, rest: Joints = HOME) -> Joints:
    """Return joint angles within the limits that reach a pose of the flange, to 0.01 mm and 0.006 degrees.

    The method is damped least squares with a damping that decreases with the error. The redundant degree of freedom is
    pulled towards `rest`. A smooth path of poses, each started at the previous solution, gives a smooth path of joints.

    Raises:
        OutOfReachError: The pose is reached neither from `start` nor from `rest`.
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


def _limited_step(jacobian: Jacobian, error: Float[np.ndarray, " 6"], joints: Joints, rest: Joints) -> Joints:
    """Return the joint angles after one step. A joint that would exceed its limit is fixed; the others compensate."""
    free = np.ones(7)
    for _ in range(3):
        step = _step(jacobian * free, error, (rest - joints) * free)
        pushing = ((joints + step < LOW) & (joints <= LOW)) | ((joints + step > HIGH) & (joints >= HIGH))
        if not pushing.any():
            break
        free[pushing] = 0.0
    return np.clip(joints + step * free, LOW, HIGH)


def _step(jacobian: Jacobian, error: Float[np.ndarray, " 6"], to_rest: Joints) -> Joints:
    """Return one damped step towards the pose, and in its null space towards the rest position.

    The pull to the rest position decreases with the error, so that it does not slow down the convergence.
    """
    size = float(np.linalg.norm(error))
    damped = jacobian @ jacobian.T + (1e-7 + 0.05 * size**2) * np.eye(6)
    pull = min(0.3, 3.0 * size) * to_rest
    step: np.ndarray = jacobian.T @ np.linalg.solve(damped, error - jacobian @ pull) + pull
    return step * min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))


def _jacobian(frames: list[Float[np.ndarray, "4 4"]]) -> Jacobian:
    axes = np.stack([frame[:3, 2] for frame in frames[:-1]])
    arms = frames[-1][:3, 3] - np.stack([frame[:3, 3] for frame in frames[:-1]])
    return np.concatenate([np.cross(axes, arms), axes], axis=1).T


def _frames(joints: Float[np.ndarray, "*batch 7"]) -> list[Float[np.ndarray, "*batch 4 4"]]:
    """Return the frames of the seven links and of the flange in the base frame."""
    cos, sin = np.cos(joints)[..., None], np.sin(joints)[..., None]
    links = _CONSTANT + _COSINE * cos[..., None] + _SINE * sin[..., None]
    frames = [links[..., 0, :, :]]
    for index in range(1, 7):
        frames.append(frames[-1] @ links[..., index, :, :])
    frames.append(frames[-1] @ _FLANGE)
    return frames


def _link_terms() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the link transforms as constant + cosine * cos(angle) + sine * sin(angle), each [7, 4, 4]."""
    constant, cosine, sine = (np.zeros((7, 4, 4)) for _ in range(3))
    for index, (length, twist_deg, offset) in enumerate(zip(LENGTH_M, TWIST_DEG, OFFSET_M, strict=True)):
        twist = np.deg2rad(twist_deg)
        ct, st = np.cos(twist), np.sin(twist)
        cosine[index, :3, :2] = [[1, 0], [0, ct], [0, st]]
        sine[index, :3, :2] = [[0, -1], [ct, 0], [st, 0]]
        constant[index, :3, 2] = [0, -st, ct]
        constant[index, :3, 3] = [length, -st * offset, ct * offset]
        constant[index, 3, 3] = 1.0
    return constant, cosine, sine


_CONSTANT, _COSINE, _SINE = _link_terms()
_FLANGE = np.eye(4)
_FLANGE[2, 3] = FLANGE_OFFSET_M


CONTROL_RATE_HZ = 15.0
GRIPPER_LAG_S = 0.12


@dataclass(frozen=True)
class MotionRecipe:
    """Ranges of random reaching motions. The box of flange positions is in the world frame."""

    stride: int = 4  # control steps per model step
    reach_m: float = 0.075  # largest displacement per axis and model step
    drift_m: tuple[float, float, float] | None = None  # displacement of every model step, instead of a random one
    low_m: tuple[float, float, float] = (0.32, -0.24, 0.20)
    high_m: tuple[float, float, float] = (0.60, 0.24, 0.48)
    turn_rad: float = 0.12  # largest rotation about the vertical per model step
    max_turn_rad: float = 0.6
    gripper_share: float = 0.12  # probability per model step that the gripper opens or closes


@dataclass(frozen=True)
class Motion:
    """Commands and measurements of every control step; poses are in the robot base frame."""

    commanded_joints: Float[np.ndarray, "steps 7"]
    commanded_gripper: Float[np.ndarray, " steps"]  # gripper position: 0 open .. 1 closed
    joints: Float[np.ndarray, "steps 7"]
    gripper: Float[np.ndarray, " steps"]

    @property
    def commanded_poses(self) -> Float[np.ndarray, "steps 6"]:
        """Commanded poses of the flange."""
        return forward_kinematics(self.commanded_joints)

    @property
    def poses(self) -> Float[np.ndarray, "steps 6"]:
        """Measured poses of the flange."""
        return forward_kinematics(self.joints)


def random_reaching(
    domain: Domain, steps: int, rng: np.random.Generator, recipe: MotionRecipe = MotionRecipe()
) -> Motion:
    """Return a random demonstration of `steps` control steps.

    The same generator gives the same motion in the *world*, independently of the mounting of the robot.
    """
    segments = -(-steps // recipe.stride) + 1
    times = np.arange(segments + 1) * recipe.stride
    positions, turns, closed = _waypoints(segments, rng, recipe)
    path = PchipInterpolator(times, np.concatenate([positions, turns[:, None]], axis=1))(np.arange(steps + 1))
    gripper = closed[np.arange(steps + 1) // recipe.stride]
    joints = [rest := rest_joints(domain)]
    for pose in poses_in_base(downward_poses(path), domain):
        joints.append(inverse_kinematics(pose, joints[-1], rest=rest))
    commanded = np.array(joints[1:])
    return Motion(
        commanded_joints=commanded[1:],
        commanded_gripper=gripper[1:],
        joints=follow(commanded, tracking_share(domain.lag_s)),
        gripper=follow(gripper[:, None], tracking_share(GRIPPER_LAG_S))[:, 0],
    )


def rest_joints(domain: Domain) -> Float[np.ndarray, " 7"]:
    """Return joint angles with the gripper over the middle of the table, for the mounting of the robot in a domain."""
    joints = HOME.copy()
    joints[0] -= np.deg2rad(domain.base_yaw_deg)
    return joints


def downward_poses(path: Float[np.ndarray, "steps 4"]) -> Float[np.ndarray, "steps 6"]:
    """Return poses with the gripper pointing down, from x, y, z and the rotation about the vertical.

    At a rotation of 0 the fingers open along the robot's left-right axis.
    """
    down = np.tile([np.pi, 0.0], (len(path), 1))
    return np.concatenate([path[:, :3], down, path[:, 3:] - np.pi / 4], axis=1)


def poses_in_base(poses: Float[np.ndarray, "steps 6"], domain: Domain) -> Float[np.ndarray, "steps 6"]:
    """Convert poses from the world frame to the robot base frame."""
    to_base = domain.base_pose()[:3, :3].T
    rotations = to_base @ matrices_from_euler(poses[:, 3:])
    return np.concatenate([poses[:, :3] @ to_base.T, euler_from_matrices(rotations)], axis=1)


def tracking_share(lag_s: float) -> float:
    """Return the share of the distance to the command that the arm covers in one control step."""
    return float(1.0 - np.exp(-1.0 / (CONTROL_RATE_HZ * lag_s)))


def follow(commands: Float[np.ndarray, "steps_and_one dim"], share: float) -> Float[np.ndarray, "steps dim"]:
    """Return the measurements of an arm that follows commands with a lag, starting at rest at the first command.

    The first command has no measurement. Measurement t is taken when command t is issued, so it depends only on earlier
    commands.
    """
    measured = np.empty_like(commands[1:], dtype=np.float64)
    measured[0] = commands[0]
    for step in range(1, len(measured)):
        measured[step] = measured[step - 1] + share * (commands[step] - measured[step - 1])
    return measured


def _waypoints(
    segments: int, rng: np.random.Generator, recipe: MotionRecipe
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return positions, rotations about the vertical, gripper positions. Steps out of the box are reversed."""
    low, high = np.append(recipe.low_m, -recipe.max_turn_rad), np.append(recipe.high_m, recipe.max_turn_rad)
    drift = np.append(recipe.drift_m or np.zeros(3), 0.0)
    reach = np.append(0.3 * drift[:3] if recipe.drift_m else [recipe.reach_m] * 3, recipe.turn_rad)
    points, closed = [rng.uniform(low, high - segments * drift)], [float(rng.uniform() < 0.5)]
    for _ in range(segments):
        step = drift + rng.uniform(-reach, reach)
        outside = (points[-1] + step < low) | (points[-1] + step > high)
        points.append(points[-1] + np.where(outside, -step, step))
        closed.append(1.0 - closed[-1] if rng.uniform() < recipe.gripper_share else closed[-1])
    path = np.array(points)
    return path[:, :3], path[:, 3], np.array(closed)
