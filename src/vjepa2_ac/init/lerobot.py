"""A LeRobot data set: columns and cameras of its meta/info.json, and the gripper's range of its statistics."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from functools import partial

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.config.sources import JOINT_VELOCITY
from vjepa2_ac.data.files import EpisodeFiles
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, filled, list_by_template, read_info
from vjepa2_ac.data.sources.lerobot.parquet import ParquetRows
from vjepa2_ac.errors import UserError, counted
from vjepa2_ac.init.found import FoundData, Knob, camera_knobs, idle_rule, is_no_camera
from vjepa2_ac.init.poses import Column, Range, Samples, find_pose, measured_columns, vector_state
from vjepa2_ac.storage.structured import json_object

_STATISTICS = "meta/stats.json"  # without it (v2.1) the sampled episodes give the range
_MAX_BYTES = 16 << 20
_OURS = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index", "subtask_index"})
_DROID_GRIPPER = "observation.state.gripper_position"
_OF_DROID = frozenset({"building", "collector_id"})  # columns of its ports to LeRobot
_SAMPLED = 24  # episodes whose numbers are compared with the names


def look_at_lerobot(path: str) -> FoundData:
    """Look at a LeRobot data set.

    Raises:
        InputError: It cannot be used, or has no camera or no numbers of the robot.
    """
    info = read_info(path)
    cameras = [name for name, one in info.features.items() if one.is_camera and not is_no_camera(name)]
    depth = [name for name, one in info.features.items() if one.is_depth or (one.is_camera and is_no_camera(name))]
    camera, all_cameras = camera_knobs(cameras, depth, info.where)
    columns = {
        name: Column(one.width, one.names)
        for name, one in info.features.items()
        if one.is_numbers and name not in _OURS
    }
    samples = _sampled(info, measured_columns(columns))
    pose = find_pose(columns, samples, control_rate_hz=info.fps, range_of=partial(_range_of, path))
    if pose and _DROID_GRIPPER in pose["state"].value and info.features.keys() >= _OF_DROID:
        pose |= {"gripper_open": Knob(0.0, "DROID's"), "gripper_closed": Knob(1.0)}
    success = next((name for name in info.features if "success" in name), None)
    return FoundData(
        source="lerobot",
        path=path,
        knobs={
            "camera": camera,
            "lerobot": {
                **(pose or vector_state(columns, info.where)),
                "cameras": all_cameras,
                "success": Knob(success),
            },
        },
        rate_hz=Knob(info.fps, "of meta/info.json"),
        states="pose" if pose else "vector",
        episodes=info.episodes,
        steps=info.frames,
        idle=idle_rule(has_velocities=JOINT_VELOCITY in columns) if pose else None,
        about=(f"LeRobot {info.version}, {counted(info.episodes, 'episode')} at {info.fps:g} a second",)
        + ((f"depth maps are not used: {', '.join(depth)}",) if depth else ()),
    )


def _sampled(info: DatasetInfo, columns: Mapping[str, Column]) -> Samples:
    """Return the numbers of the first episodes; nothing if they cannot be read, which `data check` will explain."""
    read: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    with contextlib.suppress(UserError, OSError, KeyError):
        files = list_by_template(info.root, info.data_path)
        first = next(iter(files.values()))
        rows_in = ParquetRows(EpisodeFiles(LeRobotData(path=info.root)), list(columns), f"{first.version} {first.size}")
        for number in range(min(_SAMPLED, info.episodes)):
            file = filled(info.data_path, number // info.chunk_episodes, number if info.version == "v2.1" else 0)
            rows = rows_in.rows(storage.join(info.root, file), number)
            for name in columns:
                read[name].append(rows[name].astype(np.float64))
    return {name: episodes for name, episodes in read.items() if episodes}


def _range_of(root: str, column: str, index: int) -> Range | None:
    """Return the least and the greatest value of a number by the statistics of the data set; None: not known."""
    where = storage.join(root, _STATISTICS)
    with contextlib.suppress(OSError, UserError, KeyError, IndexError, TypeError, ValueError):
        statistics = json_object(storage.read_bounded(where, _MAX_BYTES), where=where)[column]
        low, high = float(statistics["min"][index]), float(statistics["max"][index])
        if math.isfinite(low) and math.isfinite(high):
            return low, high
    return None
