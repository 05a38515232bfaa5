"""Axis mapping: what a robot does and where it is, as a model of other axes sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.axes.axes_file import read_axes
from vjepa2_ac.planning.model_setup import Fingerprints
from vjepa2_ac.planning.state_integration import euler_from_matrices, matrices_from_euler

_POSITION, _ROTATION = slice(0, 3), slice(3, 6)


@dataclass(frozen=True)
class Axes:
    """A turn about a vertical axis, from the robot's axes into the model's.

    Plans are searched among the robot's own actions, so limits hold for what is executed; the model is given each
    action and state turned.

    Source: arXiv 2506.09985, appendix B.4, which rotates inferred moves by a measured angle.
    """

    yaw: float  # radians, counterclockwise from above
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y that stay where they are; the robot's base

    @classmethod
    def read(cls, path: str, known: Fingerprints) -> Axes:
        """Return the axes of a file that were fitted for a model.

        Raises:
            InputError: They cannot be planned by, or are another model's.
        """
        axes = read_axes(path)
        if (axes.model.encoder, axes.model.predictor) != (known.encoder, known.predictor):
            raise InputError(
                where=f"planning.axes: {path}",
                found=f"axes that were fitted for another model, {axes.model.subject}",
                needed="those of the model that plans, with its trained weights",
                fix="Fit them anew: `vjepa2-ac data calibrate CONFIG --axes MODEL`",
            )
        return cls(math.radians(axes.yaw_degrees.value), axes.centre_m)

    def poses(self, poses: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch numbers"]:
        """Return poses as the model sees them: x, y, z, three angles, and what does not turn (a gripper)."""
        with torch.autocast(poses.device.type, enabled=False):
            turn, centre = self._turn(poses), poses.new_tensor([*self.centre_m, 0.0])
            rotation = euler_from_matrices(turn @ matrices_from_euler(poses[..., _ROTATION]))
            position = (poses[..., _POSITION] - centre) @ turn.T + centre
            return torch.cat([position, rotation, poses[..., 6:]], dim=-1)

    def actions(self, actions: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7"]:
        """Return actions as the model sees them: the move and the axis of the rotation are turned."""
        with torch.autocast(actions.device.type, enabled=False):
            turn = self._turn(actions)
            rotation = euler_from_matrices(turn @ matrices_from_euler(actions[..., _ROTATION]) @ turn.T)
            return torch.cat([actions[..., _POSITION] @ turn.T, rotation, actions[..., 6:]], dim=-1)

    def _turn(self, like: Tensor) -> Float[Tensor, "3 3"]:
        return matrices_from_euler(like.new_tensor([0.0, 0.0, self.yaw]))
