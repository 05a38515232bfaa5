"""Calibrated axes: the turn of a model's axes about the vertical, as `data calibrate --axes` fits it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import Fingerprints
from vjepa2_ac.spaces import euler_from_matrices, matrices_from_euler
from vjepa2_ac.storage.structured import read_json_object, record_of

_POSITION, _ROTATION = slice(0, 3), slice(3, 6)
AXES_FILE = "axes.json"
AXES_FORMAT = 1  # incremented when a reader of the file would have to change
_FIX = "Fit them with `vjepa2-ac data calibrate CONFIG --axes MODEL`, and name the axes.json that it writes"


@dataclass(frozen=True)
class FittedNumber:
    """A number; its interval is there for people."""

    value: Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True)
class FittedModel:
    """Whose axes they are: the name as given, and hashes of the weights."""

    subject: str
    encoder: str
    predictor: str


@dataclass(frozen=True)
class AxesFile:
    """What is planned by, of the content of the file."""

    yaw_degrees: FittedNumber  # about z, counterclockwise from above: what the model infers, from what was executed
    model: FittedModel
    problem: str | None  # why nothing can be planned by it
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y about which is turned


def read_axes(path: str | Path) -> AxesFile:
    """Return calibrated axes that can be planned by.

    Raises:
        InputError: There is no such file, it is none of calibrated axes, or the fit is not good enough.
    """
    where, needed = f"planning.axes: {path}", f"calibrated axes of format {AXES_FORMAT}"
    values = read_json_object(path, needed=needed, fix=_FIX)
    if values.get("format") != AXES_FORMAT:
        raise InputError(where=where, found=f"format {values.get('format')!r}", needed=needed, fix=_FIX)
    known = {one.name: values[one.name] for one in fields(AxesFile) if one.name in values}
    axes = record_of(AxesFile, known, where=where, needed=needed, fix=_FIX)
    if axes.problem is not None:
        fix = "Record varied moves and fit to more pairs (--limit); or the model does not see the actions: adapt it"
        raise InputError(where=where, found=f"axes that are {axes.problem}", fix=fix)
    return axes


def require_axes(config: Config) -> None:
    """Refuse the axes of `planning.axes` if they cannot be planned by, before a model is loaded.

    Raises:
        InputError: As `read_axes`; or the states are no poses in the robot's base frame.
    """
    read_axes(str(config.planning.axes))
    is_base = config.data.states == "pose" and config.data.pose_frame == "base"
    require_base_frame(f"planning.axes: {config.planning.axes}", is_base=is_base)


def require_base_frame(where: str, *, is_base: bool) -> None:
    """Refuse states that have no vertical axis to turn about.

    Raises:
        InputError: They are no poses in the robot's base frame.
    """
    if not is_base:
        found = "states that are no poses in the robot's base frame"
        needed = "data.states: pose and data.pose_frame: base, whose vertical axis moves are turned about"
        raise InputError(where=where, found=found, needed=needed)


def require_axes_in(data: DataConfig) -> None:
    """Refuse data in which there are no axes to calibrate, before a model is loaded.

    Raises:
        InputError: The states are no poses in the base frame, or the stride is still to be chosen.
    """
    require_base_frame("data calibrate --axes", is_base=data.states == "pose" and data.pose_frame == "base")
    require_stride(data, to="calibrate axes, for axes are those of a model step")


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
            found = f"axes that were fitted for another model, {axes.model.subject}"
            fix = "Fit them anew: `vjepa2-ac data calibrate CONFIG --axes MODEL`"
            raise InputError(where=f"planning.axes: {path}", found=found, fix=fix)
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
        turn: Tensor = matrices_from_euler(like.new_tensor([0.0, 0.0, self.yaw]))
        return turn
