"""The simulated arm: follows commands with a lag and is filmed by three cameras."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from vjepa2_ac.geometry import euler_from_matrices
from vjepa2_ac.simulation.world.camera import FRAME_SIZE, RayCamera
from vjepa2_ac.simulation.world.domains import Domain
from vjepa2_ac.simulation.world.kinematics import OutOfReachError, forward_kinematics, inverse_kinematics
from vjepa2_ac.simulation.world.motion import GRIPPER_LAG_S, rest_joints, tracking_share
from vjepa2_ac.simulation.world.opengl_renderer import OpenGlCamera
from vjepa2_ac.simulation.world.projection import exterior_pose
from vjepa2_ac.simulation.world.scene import FINGER_TRAVEL_M, compile_scene, load_mujoco

Renderer = Literal["rays", "opengl"]
WRIST_FOV_DEG = 70.0


class SimulatedArm:
    """A Franka-like arm in a domain. Motion is kinematic: the joints are set, there are no collisions.

    States are *measured*, in the robot base frame (legend: episode.py).

    Args:
        domain: Its world.
        renderer: `rays` works everywhere; `opengl` needs a working `MUJOCO_GL`.
        size: Height and width of the images.

    Raises:
        InputError: MuJoCo is not installed, or OpenGL does not work here.
    """

    def __init__(self, domain: Domain, *, renderer: Renderer = "rays", size: tuple[int, int] = FRAME_SIZE) -> None:
        self.domain = domain
        self._mujoco = load_mujoco()
        self._model = self._compiled(domain)
        self._data = self._mujoco.MjData(self._model)
        self._renderer, self._size = renderer, size
        self._cameras: dict[str, Any] = {}
        self.set_joints(rest_joints(domain), 0.0)
        if renderer == "opengl":
            self._camera("exterior_1")  # fails now, not after an hour

    @property
    def joints(self) -> Float[np.ndarray, " 7"]:
        """Measured joint angles in radians."""
        return np.array(self._data.qpos[:7])

    @property
    def state(self) -> Float[np.ndarray, " 7"]:
        """Measured pose of the flange, and closedness of the gripper."""
        return np.append(forward_kinematics(self.joints), self.closedness)

    @property
    def closedness(self) -> float:
        """Measured closedness of the gripper: 0 open .. 1 closed."""
        return self._closedness

    @property
    def block(self) -> Float[np.ndarray, " 4"] | None:
        """Pose of the block, as in `TaskProblem`; None: there is none."""
        return None

    def place_block(self, block: Float[np.ndarray, " 4"]) -> None:
        """Put the block at a pose at once, at rest.

        Raises:
            ValueError: There is none.
        """
        raise ValueError(f"no block to be put at {block.tolist()}: this arm touches nothing")

    @property
    def mark(self) -> Float[np.ndarray, " 2"] | None:
        """Middle of the mark on the table, as in `TaskProblem`; None: there is none."""
        return None

    def place_mark(self, mark: Float[np.ndarray, " 2"]) -> None:
        """Put the mark at a place on the table.

        Raises:
            ValueError: There is none.
        """
        raise ValueError(f"no mark to be put at {mark.tolist()}: this arm has none on its table")

    def set_joints(self, joints: Float[np.ndarray, " 7"], closedness: float) -> None:
        """Put the arm at joint angles at once."""
        self._closedness = closedness
        self._data.qpos[:7] = joints
        self._data.qpos[7:9] = FINGER_TRAVEL_M * (1.0 - closedness)
        self._mujoco.mj_kinematics(self._model, self._data)

    def joints_for(self, state: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 7"]:
        """Return joint angles that bring the flange from here to a pose.

        Raises:
            OutOfReachError: There are none.
        """
        return inverse_kinematics(state[:6], self.joints, rest=rest_joints(self.domain))

    def set_state(self, state: Float[np.ndarray, " 7"]) -> None:
        """Put the flange at a pose, at once.

        Raises:
            OutOfReachError: No joint angles lead there.
        """
        self.set_joints(self.joints_for(state), float(state[6]))

    def can_reach(self, state: Float[np.ndarray, " 7"]) -> bool:
        """Return whether a command to move the flange from here to this pose can be followed."""
        try:
            self.joints_for(state)
        except OutOfReachError:
            return False
        return True

    def command(self, target: Float[np.ndarray, " 7"], control_steps: int = 1) -> Float[np.ndarray, " 7"]:
        """Move the flange towards a state for some control steps and return the measured state.

        Raises:
            OutOfReachError: No joint angles lead there.
        """
        return self.command_joints(self.joints_for(target), float(target[6]), control_steps)

    def command_joints(
        self, goal: Float[np.ndarray, " 7"], closedness: float, control_steps: int = 1
    ) -> Float[np.ndarray, " 7"]:
        """Move joints (radians) and gripper towards a target for some control steps; return the measured state."""
        left = (1.0 - tracking_share(self.domain.lag_s)) ** control_steps
        grip_left = (1.0 - tracking_share(GRIPPER_LAG_S)) ** control_steps
        joints = goal + left * (self.joints - goal)
        self.set_joints(joints, closedness + grip_left * (self._closedness - closedness))
        return self.state

    def image(self, camera: str = "exterior_1") -> UInt8[np.ndarray, "height width 3"]:
        """Return the current image of `exterior_1`, `exterior_2` or `wrist`."""
        eye = self._camera(camera)
        if camera == "wrist":
            eye.move(self._wrist_pose())
        return np.asarray(eye.image(self._data))

    def extrinsics(self, camera: str = "exterior_1") -> Float[np.ndarray, " 6"]:
        """Return the pose of a camera in the robot base frame: x right, y down, z into the image."""
        pose = np.linalg.inv(self.domain.base_pose()) @ self._camera_pose(camera)
        return np.concatenate([pose[:3, 3], euler_from_matrices(pose[:3, :3])])

    def _compiled(self, domain: Domain) -> Any:
        return compile_scene(domain)

    def _camera(self, name: str) -> Any:
        if name not in self._cameras:
            fov = WRIST_FOV_DEG if name == "wrist" else self.domain.camera.vertical_fov_deg
            kind = OpenGlCamera if self._renderer == "opengl" else RayCamera
            self._cameras[name] = kind(self._model, self.domain, self._camera_pose(name), fov, self._size)
        return self._cameras[name]

    def _camera_pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        if name == "wrist":
            return self._wrist_pose()
        return exterior_pose(self.domain, name)

    def _wrist_pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the frame of a camera on the hand that looks past the fingers."""
        site = self._data.site("flange")
        mount = np.eye(4)
        mount[:3, :3] = Rotation.from_euler("ZX", [45.0, 12.0], degrees=True).as_matrix()
        mount[:3, 3] = mount[:3, :3] @ [0.0, -0.09, -0.02]
        flange = np.eye(4)
        flange[:3, :3], flange[:3, 3] = site.xmat.reshape(3, 3), site.xpos
        return np.asarray(flange @ mount)
