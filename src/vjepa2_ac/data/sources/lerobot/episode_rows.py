"""The rows of one LeRobot episode, checked for completeness: states, commands, outcome."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from vjepa2_ac.config import LeRobotData
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, missing
from vjepa2_ac.data.sources.lerobot.parquet import EPISODE
from vjepa2_ac.data.sources.lerobot.row_cache import Columns
from vjepa2_ac.data.sources.lerobot.states import states_of, vectors_of
from vjepa2_ac.errors import InputError

FRAME, TIME = "frame_index", "timestamp"

_FIX = "Copy the file again, or leave the episode out"


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
    columns = [_column(rows, name, info, where) for name in fields.state]
    poses = config.states == "pose"
    states = states_of(columns, fields, where) if poses else vectors_of(columns, fields.select, where)
    commands = None
    if config.actions == "recorded":
        commands = vectors_of([_column(rows, name, info, where) for name in fields.action], None, where)
    for name in (fields.joint_velocity, fields.success):
        if name is not None and name in info.features and name not in rows:
            raise missing("data.lerobot", "column", name, where, rows)
    velocities = None
    if fields.joint_velocity is not None and fields.joint_velocity in rows:
        velocities = _column(rows, fields.joint_velocity, info, where).astype(np.float64)
        if not np.isfinite(velocities).all():
            step = int((~np.isfinite(velocities)).any(axis=1).argmax())
            raise InputError(
                where=f"{where}: step {step}: {fields.joint_velocity}",
                found=f"{velocities[step]}",
                needed="finite numbers",
                fix="Leave the episode out, or set data.lerobot.joint_velocity: null",
            )
    success = bool(rows[fields.success].any()) if fields.success is not None and fields.success in rows else None
    return EpisodeContent(states, velocities, success, commands)


def _require_rows(rows: Columns, length: int, fps: float, where: str) -> None:
    """Check that the rows are those of the episode, complete, in order, at the data set's rate."""
    found = len(rows[EPISODE]) if rows else 0
    if found != length:
        raise InputError(where=where, found=f"{found} rows", needed=f"{length}, says the data set", fix=_FIX)
    order = np.arange(length)
    if FRAME in rows and not np.array_equal(rows[FRAME][:, 0], order):
        raise InputError(
            where=where, found=f"{FRAME} that is not 0 to {length - 1} in order", needed="a row for each step", fix=_FIX
        )
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
    if feature is None:
        return column
    if column.shape[1] != feature.width:
        raise InputError(
            where=f"{where}: {name}",
            found=f"{column.shape[1]} numbers a row",
            needed=f"{feature.width}, says {info.where}",
            fix=_FIX,
        )
    if feature.dtype.startswith("float") and column.dtype.kind != "f":
        raise InputError(
            where=f"{where}: {name}",
            found=f"values of type {column.dtype}",
            needed=f"{feature.dtype}, says {info.where}",
            fix=_FIX,
        )
    return column
