"""The OpenGL renderer: camera images by MuJoCo's own renderer, where OpenGL works."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.world.camera import FRAME_SIZE
from vjepa2_ac.simulation.world.domains import Domain
from vjepa2_ac.simulation.world.scene import load_mujoco


class OpenGlCamera:
    """The same camera by MuJoCo's own renderer, if `MUJOCO_GL` works. Colours as in the MJCF, without patterns.

    Raises:
        InputError: OpenGL does not work here.
    """

    def __init__(
        self,
        model: Any,
        domain: Domain,
        pose: Float[np.ndarray, "4 4"],
        vertical_fov_deg: float,
        size: tuple[int, int] = FRAME_SIZE,
    ) -> None:
        del domain  # the light and the colours are in the model
        self._mujoco, self._model = load_mujoco(), model
        self._fov = vertical_fov_deg
        self.move(pose)
        try:
            self._renderer = self._mujoco.Renderer(model, *size)
        except Exception as error:  # each back end fails in its own way: ImportError, AttributeError, FatalError, ...
            raise InputError(
                where="renderer: opengl",
                found=f"OpenGL does not work here ({type(error).__name__}: {error})",
                needed="a display, or MUJOCO_GL=egl or osmesa with its system library",
                fix="Use renderer: rays, which needs neither",
            ) from error

    def move(self, pose: Float[np.ndarray, "4 4"]) -> None:
        """Move the camera."""
        forward = pose[:3, 2]
        self._eye = self._mujoco.MjvCamera()
        self._eye.type = self._mujoco.mjtCamera.mjCAMERA_FREE
        self._eye.distance = 1.0
        self._eye.lookat[:] = pose[:3, 3] + forward
        self._eye.azimuth = np.rad2deg(np.arctan2(forward[1], forward[0]))
        self._eye.elevation = np.rad2deg(np.arcsin(forward[2]))

    def image(self, data: Any) -> UInt8[np.ndarray, "height width 3"]:
        """Return the image of this `mujoco.MjData`."""
        self._model.vis.global_.fovy = self._fov
        self._renderer.update_scene(data, camera=self._eye)
        return np.asarray(self._renderer.render())
