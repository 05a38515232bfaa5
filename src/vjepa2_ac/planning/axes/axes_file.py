"""The file of calibrated axes (`data calibrate --axes`), read to plan by. PyTorch is not imported."""

from __future__ import annotations

from dataclasses import dataclass
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
_Row = tuple[_Number, _Number, _Number]


@dataclass(frozen=True)
class FittedNumber:
    """A number with its 95 % interval."""

    value: _Number
    low: _Number | None
    high: _Number | None


@dataclass(frozen=True)
class FittedModel:
    """Whose axes they are: the name as given, and hashes of the weights."""

    subject: str
    encoder: str
    base: str
    predictor: str


@dataclass(frozen=True)
class AxesFile:
    """The content of the file, but for what is there for people only."""

    yaw_degrees: FittedNumber  # about z, counterclockwise from above: what the model infers, from what was executed
    gain: FittedNumber
    matrix: tuple[_Row, _Row, _Row]
    model: FittedModel
    problem: str | None  # why nothing can be planned by it
    centre_m: tuple[_Number, _Number] = (0.0, 0.0)  # x, y about which is turned


def read_axes(path: str | Path) -> AxesFile:
    """Return calibrated axes that can be planned by.

    Raises:
        InputError: There is no such file, it is none of calibrated axes, or the fit is not good enough.
    """
    where = f"planning.axes: {path}"
    try:
        values = read_json_object(Path(path), needed="calibrated axes", fix=_FIX)
    except OSError as error:
        raise InputError(
            where=where, found=f"cannot be read ({error.strerror})", needed="calibrated axes", fix=_FIX
        ) from None
    if values.get("format") != FORMAT:
        found = f"format {values.get('format')!r}"
        raise InputError(where=where, found=found, needed=f"calibrated axes of format {FORMAT}", fix=_FIX)
    known = {name: values[name] for name in AxesFile.__dataclass_fields__ if name in values}
    axes = record_of(AxesFile, known, where=where, needed="calibrated axes", fix=_FIX)
    if axes.problem is not None:
        raise InputError(
            where=where,
            found=f"axes that are {axes.problem}",
            needed="a fit whose angle is known",
            fix="Record varied moves and fit to more pairs (--limit); or the model does not see the actions: adapt it",
        )
    return axes


def require_axes(config: Config) -> None:
    """Refuse calibrated axes that cannot be planned by, before a model is loaded.

    Raises:
        InputError: As `read_axes`; or the states are no poses in the robot's base frame.
    """
    if config.planning.axes is None:
        return
    read_axes(config.planning.axes)
    require_base_frame(config.data, f"planning.axes: {config.planning.axes}")


def require_base_frame(data: DataConfig, where: str) -> None:
    """Refuse states that have no vertical axis to turn about.

    Raises:
        InputError: They are no poses in the robot's base frame.
    """
    if data.states != "pose" or data.pose_frame != "base":
        raise no_vertical_axis(where)


def no_vertical_axis(where: str) -> InputError:
    """Return the error of states that are no poses in the robot's base frame."""
    return InputError(
        where=where,
        found="states that are no poses in the robot's base frame",
        needed="data.states: pose and data.pose_frame: base, whose vertical axis moves are turned about",
    )


def require_axes_in(data: DataConfig) -> None:
    """Refuse data in which there are no axes to calibrate, before a model is loaded.

    Raises:
        InputError: The states are no poses in the base frame, or the stride is still to be chosen.
    """
    require_base_frame(data, "data calibrate --axes")
    require_stride(data, to="calibrate axes, for axes are those of a model step")
