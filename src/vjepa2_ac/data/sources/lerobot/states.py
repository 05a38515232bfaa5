"""The numbers of one LeRobot episode, checked for completeness: states in our convention, commands, outcome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped
from scipy.spatial.transform import Rotation

from vjepa2_ac.config import LeRobotData, LeRobotFields
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, missing
from vjepa2_ac.data.sources.lerobot.parquet import EPISODE, Columns
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import POSE, require_finite

FRAME, TIME = "frame_index", "timestamp"

_FIX = "Copy the file again, or leave the episode out"
_FIX_STATES = "Check data.lerobot: state, select, rotation, gripper_open and gripper_closed"
_FIX_VECTORS = "Leave the episode out, check data.lerobot: state, action, or set data.lerobot.joint_velocity: null"
_UNIT_TOLERANCE = 1e-2


@dataclass(frozen=True)
class EpisodeContent:
    """The data of an episode except its frames."""

    states: Float[np.ndarray, "steps state_dim"]
    joint_velocities: Float[np.ndarray, "steps joints"] | None
    success: bool | None
    commands: Float[np.ndarray, "steps action_dim"] | None = None


def wanted_columns(config: LeRobotData) -> list[str]:
    """Return the columns that are read if a file has them."""
    fields = config.lerobot
    optional = [name for name in (fields.joint_velocity, fields.success) if name is not None]
    commands = fields.action if config.actions == "recorded" else ()
    return [EPISODE, FRAME, TIME, *fields.state, *commands, *optional]


def content_of(rows: Columns, length: int, info: DatasetInfo, config: LeRobotData, where: str) -> EpisodeContent:
    """Return the data in the rows of an episode.

    Args:
        rows: As `ParquetRows.rows` returns them.
        length: Their expected number.
        info: The description of the data set's columns.
        config: Names and conventions of the columns, and the kind of state.
        where: File and episode, for messages.

    Raises:
        InputError: Rows or columns are missing, have another width, or are implausible states.
    """
    _require_rows(rows, length, info.fps, where)
    fields = config.lerobot

    def joined(names: Sequence[str]) -> Float[np.ndarray, "steps width"]:
        numbers = np.concatenate([_column(rows, name, info, where).astype(np.float64) for name in names], axis=1)
        require_finite(numbers, where, fix=_FIX_VECTORS)
        return numbers

    def has(name: str | None) -> bool:
        if name is not None and name in info.features and name not in rows:
            raise missing("data.lerobot", "column", name, where, rows)
        return name is not None and name in rows

    states = joined(fields.state)
    if fields.select is not None:
        states = states[:, list(fields.select)]
    return EpisodeContent(
        states=_poses(states, fields, where) if config.states == "pose" else states,
        commands=joined(fields.action) if config.actions == "recorded" else None,
        joint_velocities=joined([str(fields.joint_velocity)]) if has(fields.joint_velocity) else None,
        success=bool(rows[str(fields.success)].any()) if has(fields.success) else None,
    )


def _poses(numbers: Float[np.ndarray, "steps _"], fields: LeRobotFields, where: str) -> Float[np.ndarray, "steps 7"]:
    """Return states (legend: `vjepa2_ac.episode`) from the numbers of an episode.

    Raises:
        InputError: They are implausible under these settings: no unit quaternion, out of reach.
    """
    gripper = (numbers[:, -1:] - fields.gripper_open) / (fields.gripper_closed - fields.gripper_open)
    states = np.concatenate([numbers[:, POSE.position], _euler(numbers[:, 3:-1], fields, where), gripper], axis=1)
    POSE.require_plausible(states, where, fix=_FIX_STATES)
    return states


def _euler(rotation: Float[np.ndarray, "steps _"], fields: LeRobotFields, where: str) -> Float[np.ndarray, "steps 3"]:
    if fields.rotation == "euler_xyz":
        return rotation
    lengths = np.linalg.norm(rotation, axis=1)
    if (wrong := abs(lengths - 1) > _UNIT_TOLERANCE).any():
        step = int(wrong.argmax())
        found = f"the quaternion {np.array2string(rotation[step], precision=4)} of length {lengths[step]:.4g}"
        raise InputError(where=f"{where}: step {step}", found=found, needed="a unit quaternion", fix=_FIX_STATES)
    x_first = rotation if fields.rotation == "quaternion_xyzw" else np.roll(rotation, -1, axis=1)
    return np.asarray(Rotation.from_quat(x_first).as_euler("xyz"))


def _require_rows(rows: Columns, length: int, fps: float, where: str) -> None:
    """Check that the rows are those of the episode, complete, in order, at the data set's rate."""
    count = len(rows[EPISODE]) if rows else 0
    if count != length:
        raise InputError(where=where, found=f"{count} rows", needed=f"{length}, says the data set", fix=_FIX)
    order = np.arange(length)
    if FRAME in rows and not np.array_equal(rows[FRAME][:, 0], order):
        found = f"{FRAME} that is not 0 to {length - 1} in order"
        raise InputError(where=where, found=found, needed="a row for each step", fix=_FIX)
    if TIME in rows and not (wrong := abs(rows[TIME][:, 0] - order / fps)).max() < 0.5 / fps:  # NaN is wrong, too
        step = int(np.argmax(~(wrong < 0.5 / fps)))
        raise InputError(
            where=f"{where}: step {step}",
            found=f"the {TIME} {rows[TIME][step, 0]:.4g} s",
            needed=f"{step / fps:.4g} s, at the {fps:g} rows per second that meta/info.json says",
            fix="Correct fps in meta/info.json, or leave the episode out",
        )


def _column(rows: Columns, name: str, info: DatasetInfo, where: str) -> Shaped[np.ndarray, "steps _"]:
    if name not in rows:
        raise missing("data.lerobot", "column", name, where, rows)
    column, feature = rows[name], info.features.get(name)
    found = needed = ""
    if feature is not None and column.shape[1] != feature.width:
        found, needed = f"{column.shape[1]} numbers a row", f"{feature.width}"
    elif feature is not None and feature.dtype.startswith("float") and column.dtype.kind != "f":
        found, needed = f"values of type {column.dtype}", feature.dtype
    if found:
        raise InputError(where=f"{where}: {name}", found=found, needed=f"{needed}, says {info.where}", fix=_FIX)
    return column
