"""The simulated arm with contacts: servos in MuJoCo's dynamics, and a block to move.

Its joints follow the same commands with the same lag as those of `SimulatedArm`, as long as there is no contact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.simulation.world.arm import SimulatedArm
from vjepa2_ac.simulation.world.block_scene import SUBSTEPS, compile_contact_scene
from vjepa2_ac.simulation.world.domains import Domain
from vjepa2_ac.simulation.world.motion import GRIPPER_LAG_S
from vjepa2_ac.simulation.world.scene import FINGER_TRAVEL_M

_GRIP_STAYS = 0.05  # a gripper command that changes by less keeps the last command, and so its force
_MOVED, _FINGERS, _BLOCK = slice(0, 9), slice(7, 9), slice(9, 16)  # of qpos


class ContactArm(SimulatedArm):
    """A Franka-like arm that pushes and grasps a block. States are measured, in the robot base frame.

    A gripper that is stopped by an object is measured at its position, as on a real robot; commanded to stay there, it
    keeps holding.

    Args:
        domain: Its world.
        renderer: `rays` works everywhere; `opengl` needs a working `MUJOCO_GL`.
        size: Height and width of the images.

    Raises:
        InputError: MuJoCo is not installed, or OpenGL does not work here.
    """

    _has_mark = False

    @property
    def closedness(self) -> float:
        """Measured closedness of the gripper, from the positions of its fingers."""
        return float(np.clip(1.0 - self._data.qpos[_FINGERS].mean() / FINGER_TRAVEL_M, 0.0, 1.0))

    @property
    def block(self) -> Float[np.ndarray, " 4"]:
        """Position of the block's centre and its rotation about z, in the robot base frame: metres, radians."""
        turn, place = self.domain.base_pose()[:3, :3], self._data.qpos[_BLOCK]
        rotation = turn.T @ Rotation.from_quat(place[3:], scalar_first=True).as_matrix()
        return np.append(turn.T @ place[:3], np.arctan2(rotation[1, 0], rotation[0, 0]))

    def place_block(self, block: Float[np.ndarray, " 4"]) -> None:
        """Put the block at a pose at once, upright and at rest."""
        turn = Rotation.from_matrix(self.domain.base_pose()[:3, :3])
        rotation = turn * Rotation.from_euler("z", block[3])
        self._data.qpos[_BLOCK] = [*turn.apply(block[:3]), *rotation.as_quat(scalar_first=True)]
        self._data.qvel[9:] = 0.0
        self._mujoco.mj_kinematics(self._model, self._data)

    def set_joints(self, joints: Float[np.ndarray, " 7"], closedness: float) -> None:
        """Put the arm at joint angles at once, at rest; it drops what it held."""
        super().set_joints(joints, closedness)
        self._data.qvel[_MOVED] = 0.0
        self._data.qacc_warmstart[:] = 0.0
        self._wanted = self._data.qpos[_MOVED].copy()
        self._grip = closedness

    def command_joints(
        self, goal: Float[np.ndarray, " 7"], closedness: float, control_steps: int = 1
    ) -> Float[np.ndarray, " 7"]:
        """Move joints (radians) and gripper towards a target for some control steps; return the measured state."""
        if abs(closedness - self.closedness) > _GRIP_STAYS:
            self._grip = closedness
        ends = np.append(goal, [FINGER_TRAVEL_M * (1.0 - self._grip)] * 2)
        for _ in range(control_steps * SUBSTEPS):
            way = self._share * (ends - self._wanted)
            self._wanted += way
            self._data.ctrl[:] = self._wanted + self._ahead * way  # the servos have no lag of their own
            self._mujoco.mj_step(self._model, self._data)
        self._mujoco.mj_kinematics(self._model, self._data)
        return self.state

    def _compiled(self, domain: Domain) -> Any:
        model = compile_contact_scene(domain, mark=self._has_mark)
        lags = np.array([domain.lag_s] * 7 + [GRIPPER_LAG_S] * 2)
        self._share = 1.0 - np.exp(-model.opt.timestep / lags)
        self._ahead = -model.actuator_biasprm[:, 2] / model.actuator_gainprm[:, 0] / model.opt.timestep
        return model


class MarkedArm(ContactArm):
    """An arm with contacts and a mark on its table: a flat disc that is seen, and touched by nothing.

    Args:
        domain: Its world.
        renderer: `rays` works everywhere; `opengl` needs a working `MUJOCO_GL`.
        size: Height and width of the images.

    Raises:
        InputError: MuJoCo is not installed, or OpenGL does not work here.
    """

    _has_mark = True

    @property
    def mark(self) -> Float[np.ndarray, " 2"]:
        """Middle of the mark in the robot base frame: x and y in metres."""
        place = self.domain.base_pose()[:3, :3].T @ self._data.mocap_pos[0]
        return np.asarray(place[:2])

    def place_mark(self, mark: Float[np.ndarray, " 2"]) -> None:
        """Put the mark at a place on the table at once."""
        self._data.mocap_pos[0, :2] = self.domain.base_pose()[:2, :2] @ mark
        self._mujoco.mj_kinematics(self._model, self._data)
