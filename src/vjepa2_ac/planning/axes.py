"""The file of calibrated axes (`data calibrate --axes`), read to plan by. PyTorch is not imported."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import read_json_object, record_of

AXES_FILE = "axes.json"
FORMAT = 1  # incremented when a reader of the file would have to change
_FIX = "Fit them with `vjepa2-ac data calibrate CONFIG --axes MODEL`, and name the axes.json that it writes"

_Number = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True)
class FittedNumber:
    """A number; its interval is there for people."""

    value: _Number


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
    centre_m: tuple[_Number, _Number] = (0.0, 0.0)  # x, y about which is turned


def read_axes(path: str | Path) -> AxesFile:
    """Return calibrated axes that can be planned by.

    Raises:
        InputError: There is no such file, it is none of calibrated axes, or the fit is not good enough.
    """
    where, needed = f"planning.axes: {path}", f"calibrated axes of format {FORMAT}"
    values = read_json_object(path, needed=needed, fix=_FIX)
    if values.get("format") != FORMAT:
        raise InputError(where=where, found=f"format {values.get('format')!r}", needed=needed, fix=_FIX)
    known = {one.name: values[one.name] for one in fields(AxesFile) if one.name in values}
    axes = record_of(AxesFile, known, where=where, needed=needed, fix=_FIX)
    if axes.problem is not None:
        fix = "Record varied moves and fit to more pairs (--limit); or the model does not see the actions: adapt it"
        raise InputError(where=where, found=f"axes that are {axes.problem}", fix=fix)
    return axes


def require_axes(config: Config) -> None:
    """Refuse calibrated axes that cannot be planned by, before a model is loaded.

    Raises:
        InputError: As `read_axes`; or the states are no poses in the robot's base frame.
    """
    if config.planning.axes is not None:
        read_axes(config.planning.axes)
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
