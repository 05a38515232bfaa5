"""The simulated arm, which follows commands with a lag, has three cameras, and can push and grasp a block."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from vjepa2_ac.simulation.camera import FRAME_SIZE, RayCamera
from vjepa2_ac.simulation.domains import FINGER_TRAVEL_M, MOVING, SUBSTEPS, Domain, compile_scene, load_mujoco
from vjepa2_ac.simulation.motion import (
    CONTROL_RATE_HZ,
    GRIPPER_LAG_S,
    Joints,
    OutOfReachError,
    forward_kinematics,
    inverse_kinematics,
    rest_joints,
    tracking_share,
)
from vjepa2_ac.spaces import euler_from_matrices

State = Float[np.ndarray, " 7"]  # a state or an action; conventions: episode.py
Block = Float[np.ndarray, " 4"]  # pose of the block, as in `TaskProblem`
Mark = Float[np.ndarray, " 2"]  # centre of the mark, as in `TaskProblem`

WRIST_FOV_DEG = 70.0
_EXTERIOR_TURNS_DEG = {"exterior_1": 0.0, "exterior_2": -100.0}  # azimuth of the fixed cameras, relative to the domain


class SimulatedArm:
    """A Franka-like arm in a domain. Its motion is kinematic: joints are set directly, without collisions.

    States are *measured*, in the robot base frame (conventions: episode.py).

    Args:
        domain: The world of the arm.
        size: Height and width of the images.
        views: Number of fixed cameras whose images are concatenated if no camera is named.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """

    def __init__(self, domain: Domain, *, size: tuple[int, int] = FRAME_SIZE, views: int = 1) -> None:
        self.domain, self._views = domain, tuple(_EXTERIOR_TURNS_DEG)[:views]
        self._mujoco = load_mujoco()
        self._model = self._compile(domain)
        self._data = self._mujoco.MjData(self._model)
        self._size = size
        self._cameras: dict[str, RayCamera] = {}
        self._circles, self._time_s = _Circles(self._model, domain), 0.0
        self.set_joints(rest_joints(domain), 0.0)

    def reset_clock(self) -> None:
        """Reset the time of the moving objects, so that they start as for a new arm at the next `set_joints`."""
        self._time_s = 1 / CONTROL_RATE_HZ  # as after `__init__`, which sets the joints once

    @property
    def joints(self) -> Joints:
        """Measured joint angles in radians."""
        return np.array(self._data.qpos[:7])

    @property
    def state(self) -> State:
        """Measured pose of the flange, and gripper position."""
        return np.append(forward_kinematics(self.joints), self.gripper_position)

    @property
    def gripper_position(self) -> float:
        """Measured gripper position: 0 open .. 1 closed."""
        return self._gripper_position

    @property
    def block(self) -> Block | None:
        """Pose of the block; None if there is no block."""
        return None

    def place(self, block: Block | None, mark: Mark | None) -> None:
        """Set the poses of the block and of the mark. This arm has neither, so the call has no effect."""

    def set_joints(self, joints: Joints, gripper_position: float, control_steps: int = 1) -> None:
        """Set the joint angles directly, and advance the moving objects by `control_steps`."""
        self._gripper_position = gripper_position
        self._data.qpos[:7] = joints
        self._data.qpos[7:9] = FINGER_TRAVEL_M * (1.0 - gripper_position)
        self._pass_time(control_steps)
        self._mujoco.mj_kinematics(self._model, self._data)

    def joints_for(self, state: State) -> Joints:
        """Return joint angles for a pose of the flange, starting from the current joint angles.

        Raises:
            OutOfReachError: No joint angles within the limits reach the pose.
        """
        return inverse_kinematics(state[:6], self.joints, rest=rest_joints(self.domain))

    def set_state(self, state: State) -> None:
        """Set the pose of the flange and the gripper directly.

        Raises:
            OutOfReachError: No joint angles within the limits reach the pose.
        """
        self.set_joints(self.joints_for(state), float(state[6]))

    def can_reach(self, state: State) -> bool:
        """Return whether the flange can be commanded from its current pose to this pose."""
        with suppress(OutOfReachError):
            self.joints_for(state)
            return True
        return False

    def command(self, target: State, control_steps: int = 1) -> State:
        """Move the flange towards a state for some control steps and return the measured state.

        Raises:
            OutOfReachError: No joint angles within the limits reach the state.
        """
        return self.command_joints(self.joints_for(target), float(target[6]), control_steps)

    def command_joints(self, goal: Joints, gripper_position: float, control_steps: int = 1) -> State:
        """Move joints (radians) and gripper towards a target for some control steps; return the measured state."""
        remaining = (1.0 - tracking_share(self.domain.lag_s)) ** control_steps  # share of the distance to the target
        grip_remaining = (1.0 - tracking_share(GRIPPER_LAG_S)) ** control_steps
        joints = goal + remaining * (self.joints - goal)
        self.set_joints(
            joints, gripper_position + grip_remaining * (self._gripper_position - gripper_position), control_steps
        )
        return self.state

    def image(self, camera: str | None = None) -> UInt8[np.ndarray, "height width 3"]:
        """Return the current image of `exterior_1`, `exterior_2` or `wrist`; None: of all views, side by side.

        Raises:
            ValueError: There is no such camera.
        """
        names = self._views if camera is None else (camera,)
        return np.concatenate([self._camera(name).image(self._data) for name in names], axis=1)

    def silhouette(self, camera: str = "exterior_1") -> Bool[np.ndarray, "height width"]:
        """Return which pixels of the current image of a camera show the arm, the block, or moving objects."""
        return self._camera(camera).silhouette(self._data)

    def _camera(self, camera: str) -> RayCamera:
        pose = self._camera_pose(camera)
        if camera not in self._cameras:
            fov = WRIST_FOV_DEG if camera == "wrist" else self.domain.camera.vertical_fov_deg
            self._cameras[camera] = RayCamera(self._model, self.domain, pose, fov, self._size)
        elif camera == "wrist":
            self._cameras[camera].move(pose)
        return self._cameras[camera]

    def extrinsics(self, camera: str = "exterior_1") -> Float[np.ndarray, " 6"]:
        """Return the pose of a camera in the robot base frame: x right, y down, z into the image."""
        pose = np.linalg.inv(self.domain.base_pose()) @ self._camera_pose(camera)
        return np.concatenate([pose[:3, 3], euler_from_matrices(pose[:3, :3])])

    def _compile(self, domain: Domain) -> Any:
        return compile_scene(domain)

    def _pass_time(self, control_steps: int) -> None:
        self._time_s += control_steps / CONTROL_RATE_HZ
        self._circles.move(self._data, self._time_s)

    def _camera_pose(self, camera: str) -> Float[np.ndarray, "4 4"]:
        """Return the frame of a camera in the world. The wrist camera is mounted on the hand, next to the fingers."""
        if camera in _EXTERIOR_TURNS_DEG:
            return self.domain.camera.turned(_EXTERIOR_TURNS_DEG[camera]).pose()
        if camera != "wrist":
            raise ValueError(f"camera: {camera!r}. Expected wrist, {' or '.join(_EXTERIOR_TURNS_DEG)}")
        site = self._data.site("flange")
        mount, flange = np.eye(4), np.eye(4)
        mount[:3, :3] = Rotation.from_euler("ZX", [45.0, 12.0], degrees=True).as_matrix()
        mount[:3, 3] = mount[:3, :3] @ [0.0, -0.09, -0.02]
        flange[:3, :3], flange[:3, 3] = site.xmat.reshape(3, 3), site.xpos
        return np.asarray(flange @ mount)


class _Circles:
    """Objects that move on circles around their initial positions on the table, with different radii and speeds."""

    def __init__(self, model: Any, domain: Domain) -> None:
        bodies = [body for body in map(model.body, range(model.nbody)) if body.name.startswith(MOVING)]
        count, rng = len(bodies), np.random.default_rng([domain.clutter_seed, domain.moving])
        self._mocap_ids = [body.mocapid[0] for body in bodies]
        self._middles_m = np.array([body.pos[:2] for body in bodies]).reshape(count, 2)
        self._radii_m, self._phases = rng.uniform(0.05, 0.12, count), rng.uniform(0.0, 2 * np.pi, count)
        self._speeds = rng.uniform(0.5, 2.0, count) * rng.choice([-1.0, 1.0], count)  # radians per second

    def move(self, data: Any, seconds: float) -> None:
        """Set the positions of the objects at a time; the kinematics must be updated afterwards."""
        angles = self._phases + self._speeds * seconds
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        data.mocap_pos[self._mocap_ids, :2] = self._middles_m + self._radii_m[:, None] * directions


StepCallback = Callable[[SimulatedArm], None]  # called at every control step, at the time of its measurements

_MIN_GRIP_CHANGE = 0.05  # smaller changes of the gripper command are ignored, so that the gripping force is constant
_ACTUATED, _FINGERS, _BLOCK = slice(0, 9), slice(7, 9), slice(9, 16)  # indices in qpos; the first also in qvel


class ContactArm(SimulatedArm):
    """A Franka-like arm that can push and grasp a block. States are measured, in the robot base frame.

    If an object stops the gripper, the measured gripper position is that of its real position, as on a real robot. A
    command to stay at this gripper position keeps the gripping force.

    Args:
        domain: The world of the arm.
        size: Height and width of the images.
        mark: Whether there is a mark on the table: a flat disc without collisions.
        views: As for `SimulatedArm`.
    """

    def __init__(
        self, domain: Domain, *, size: tuple[int, int] = FRAME_SIZE, mark: bool = False, views: int = 1
    ) -> None:
        self._has_mark = mark
        super().__init__(domain, size=size, views=views)

    @property
    def gripper_position(self) -> float:
        """Measured gripper position, from the positions of its fingers."""
        return float(np.clip(1.0 - self._data.qpos[_FINGERS].mean() / FINGER_TRAVEL_M, 0.0, 1.0))

    @property
    def block(self) -> Block:
        """Position of the block's centre and its rotation about z, in the robot base frame: metres, radians."""
        turn, pose = self.domain.base_pose()[:3, :3], self._data.qpos[_BLOCK]
        rotation = turn.T @ Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
        return np.append(turn.T @ pose[:3], np.arctan2(rotation[1, 0], rotation[0, 0]))

    def place(self, block: Block | None, mark: Mark | None) -> None:
        """Set the pose of the block, upright and at rest, and the position of the mark; None: unchanged."""
        base = self.domain.base_pose()[:3, :3]
        if block is not None:
            turn = Rotation.from_matrix(base)
            rotation = turn * Rotation.from_euler("z", block[3])
            self._data.qpos[_BLOCK] = [*turn.apply(block[:3]), *rotation.as_quat(scalar_first=True)]
            self._data.qvel[9:] = 0.0
        if mark is not None:
            self._data.mocap_pos[0, :2] = base[:2, :2] @ mark
        self._mujoco.mj_kinematics(self._model, self._data)

    def set_joints(self, joints: Joints, gripper_position: float, control_steps: int = 1) -> None:
        """Set the joint angles directly, at rest; a grasped object is released."""
        super().set_joints(joints, gripper_position, control_steps)
        self._data.qvel[_ACTUATED] = 0.0
        self._data.qacc_warmstart[:] = 0.0
        self._setpoint = self._data.qpos[_ACTUATED].copy()
        self._grip = gripper_position

    def command_joints(self, goal: Joints, gripper_position: float, control_steps: int = 1) -> State:
        """Move joints (radians) and gripper towards a target for some control steps; return the measured state."""
        if abs(gripper_position - self.gripper_position) > _MIN_GRIP_CHANGE:
            self._grip = gripper_position
        target = np.append(goal, [FINGER_TRAVEL_M * (1.0 - self._grip)] * 2)
        for _ in range(control_steps * SUBSTEPS):
            change = self._tracking_share * (target - self._setpoint)
            self._setpoint += change
            self._data.ctrl[:] = self._setpoint + self._lead * change  # compensates the servos' damping
            self._mujoco.mj_step(self._model, self._data)
        self._pass_time(control_steps)
        self._mujoco.mj_kinematics(self._model, self._data)
        return self.state

    def _compile(self, domain: Domain) -> Any:
        model = compile_scene(domain, block=True, mark=self._has_mark)
        lags = np.array([domain.lag_s] * 7 + [GRIPPER_LAG_S] * 2)
        self._tracking_share = 1.0 - np.exp(-model.opt.timestep / lags)  # per physics step
        self._lead = -model.actuator_biasprm[:, 2] / model.actuator_gainprm[:, 0] / model.opt.timestep
        return model
