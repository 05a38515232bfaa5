"""Motion of a demonstration: smooth random reaching, as commanded and as measured.

At every model step the flange target moves by a random amount, inside a box over the table; the gripper points down,
rotates a little and sometimes opens or closes. The measured joints follow the commanded ones with a lag, as on a real
robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from vjepa2_ac.geometry import euler_from_matrices, matrices_from_euler
from vjepa2_ac.simulation.world.domains import Domain
from vjepa2_ac.simulation.world.kinematics import HOME, forward_kinematics, inverse_kinematics

CONTROL_RATE_HZ = 15.0
GRIPPER_LAG_S = 0.12


@dataclass(frozen=True)
class MotionRecipe:
    """Ranges of random reaching. The box is in the world frame, for the flange."""

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
    commanded_gripper: Float[np.ndarray, " steps"]  # closedness: 0 open .. 1 closed
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


def random_reaching(domain: Domain, steps: int, rng: np.random.Generator, recipe: MotionRecipe | None = None) -> Motion:
    """Return a random demonstration of `steps` control steps.

    The same generator gives the same motion in the *world*, whatever the mounting of the robot.
    """
    recipe = recipe or MotionRecipe()
    ways = -(-steps // recipe.stride) + 1
    times = np.arange(ways + 1) * recipe.stride
    positions, turns, closed = _waypoints(ways, rng, recipe)
    path = PchipInterpolator(times, np.concatenate([positions, turns[:, None]], axis=1))(np.arange(steps + 1))
    gripper = closed[np.arange(steps + 1) // recipe.stride]
    commanded = _joints_along(poses_in_base(downward_poses(path), domain), domain)
    return Motion(
        commanded_joints=commanded[1:],
        commanded_gripper=gripper[1:],
        joints=follow(commanded, tracking_share(domain.lag_s)),
        gripper=follow(gripper[:, None], tracking_share(GRIPPER_LAG_S))[:, 0],
    )


def rest_joints(domain: Domain) -> Float[np.ndarray, " 7"]:
    """Return joint angles with the gripper over the middle of the table, however the robot is mounted."""
    joints = HOME.copy()
    joints[0] -= np.deg2rad(domain.base_yaw_deg)
    return joints


def downward_poses(path: Float[np.ndarray, "steps 4"]) -> Float[np.ndarray, "steps 6"]:
    """Return poses with the gripper pointing down; a rotation of 0 holds the fingers across the robot's front."""
    down = np.tile([np.pi, 0.0], (len(path), 1))
    return np.concatenate([path[:, :3], down, path[:, 3:] - np.pi / 4], axis=1)


def poses_in_base(poses: Float[np.ndarray, "steps 6"], domain: Domain) -> Float[np.ndarray, "steps 6"]:
    """Return poses of the world frame in the robot base frame."""
    to_base = domain.base_pose()[:3, :3].T
    rotations = to_base @ matrices_from_euler(poses[:, 3:])
    return np.concatenate([poses[:, :3] @ to_base.T, euler_from_matrices(rotations)], axis=1)


def tracking_share(lag_s: float) -> float:
    """Return the share of the distance to the command that is covered in one control step."""
    return float(1.0 - np.exp(-1.0 / (CONTROL_RATE_HZ * lag_s)))


def follow(commands: Float[np.ndarray, "steps_and_one dim"], share: float) -> Float[np.ndarray, "steps dim"]:
    """Return the measurements if commands are followed with a lag, from rest at the first command, which is left out.

    Measurement t is taken when command t is issued, so it can follow only the commands before it.
    """
    measured = np.empty_like(commands[1:], dtype=np.float64)
    measured[0] = commands[0]
    for step in range(1, len(measured)):
        measured[step] = measured[step - 1] + share * (commands[step] - measured[step - 1])
    return measured


def _waypoints(
    ways: int, rng: np.random.Generator, recipe: MotionRecipe
) -> tuple[Float[np.ndarray, "ways 3"], Float[np.ndarray, " ways"], Float[np.ndarray, " ways"]]:
    """Return positions, rotations about the vertical and closedness; a step out of the box is mirrored back."""
    low, high = np.append(recipe.low_m, -recipe.max_turn_rad), np.append(recipe.high_m, recipe.max_turn_rad)
    drift = np.append(recipe.drift_m or np.zeros(3), 0.0)
    reach = np.append(0.3 * drift[:3] if recipe.drift_m else [recipe.reach_m] * 3, recipe.turn_rad)
    points, closed = [rng.uniform(low, high - ways * drift)], [float(rng.uniform() < 0.5)]
    for _ in range(ways):
        way = drift + rng.uniform(-reach, reach)
        outside = (points[-1] + way < low) | (points[-1] + way > high)
        points.append(points[-1] + np.where(outside, -way, way))
        closed.append(1.0 - closed[-1] if rng.uniform() < recipe.gripper_share else closed[-1])
    path = np.array(points)
    return path[:, :3], path[:, 3], np.array(closed)


def _joints_along(poses: Float[np.ndarray, "steps 6"], domain: Domain) -> Float[np.ndarray, "steps 7"]:
    rest = rest_joints(domain)
    joints = [inverse_kinematics(poses[0], rest, rest=rest)]
    for pose in poses[1:]:
        joints.append(inverse_kinematics(pose, joints[-1], rest=rest))
    return np.array(joints)
