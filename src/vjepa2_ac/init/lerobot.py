"""Read the properties of a LeRobot data set from meta/info.json and its first episodes."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.config.sources import JOINT_VELOCITY
from vjepa2_ac.data.files import EpisodeFiles
from vjepa2_ac.data.sources.lerobot_meta import DatasetInfo, fill_template, list_by_template, read_info
from vjepa2_ac.data.sources.parquet import ParquetRows
from vjepa2_ac.errors import UserError, counted
from vjepa2_ac.init.dataset_properties import DatasetProperties, is_not_camera, make_camera_values, make_idle_section
from vjepa2_ac.init.draft_values import DraftValue
from vjepa2_ac.init.poses import Column, Samples, find_pose, select_measured_columns, select_vector_state

_NUM_SAMPLED_EPISODES = 24  # episodes whose values are read to check what the column names suggest
_BOOKKEEPING_COLUMNS = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index", "subtask_index"})
_DROID_GRIPPER = "observation.state.gripper_position"
_DROID_COLUMNS = frozenset({"building", "collector_id"})  # columns of DROID's conversions to LeRobot


def read_lerobot_properties(path: str) -> DatasetProperties:
    """Read the properties of a LeRobot data set.

    Raises:
        InputError: The data set cannot be read, or has no camera or no measured numbers of the robot.
    """
    info = read_info(path)
    cameras = [name for name, feature in info.features.items() if feature.is_camera and not is_not_camera(name)]
    depth = [
        name
        for name, feature in info.features.items()
        if feature.is_depth or (feature.is_camera and is_not_camera(name))
    ]
    camera, all_cameras = make_camera_values(cameras, depth, info.where)
    columns = {
        name: Column(feature.width, feature.names)
        for name, feature in info.features.items()
        if feature.is_numbers and name not in _BOOKKEEPING_COLUMNS
    }
    samples = _read_sampled_rows(info, select_measured_columns(columns))
    pose = find_pose(columns, samples, control_rate_hz=info.fps)
    if pose and _DROID_GRIPPER in pose["state"].value and info.features.keys() >= _DROID_COLUMNS:
        pose |= {"gripper_open": DraftValue(0.0, "DROID's convention"), "gripper_closed": DraftValue(1.0)}
    success = next((name for name in info.features if "success" in name), None)
    return DatasetProperties(
        source="lerobot",
        path=path,
        config_values={
            "camera": camera,
            "lerobot": {
                **(pose or select_vector_state(columns, info.where)),
                "cameras": all_cameras,
                "success": DraftValue(success),
            },
        },
        rate_hz=DraftValue(info.fps, "read from meta/info.json"),
        states="pose" if pose else "vector",
        episodes=info.episodes,
        steps=info.frames,
        idle=make_idle_section(has_velocities=JOINT_VELOCITY in columns) if pose else None,
        descriptions=(
            f"LeRobot {info.version}, {counted(info.episodes, 'episode')}, {info.fps:g} control steps per second",
        )
        + ((f"unused depth maps: {', '.join(depth)}",) if depth else ()),
    )


def _read_sampled_rows(info: DatasetInfo, columns: Mapping[str, Column]) -> Samples:
    """Return the numbers of the first episodes, by column.

    Reading stops at an episode that cannot be read, without an error: `data check` reports it later.
    """
    values: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    with suppress(UserError, OSError, KeyError):
        files = list_by_template(info.root, info.data_path)
        first = next(iter(files.values()))
        parquet_rows = ParquetRows(
            EpisodeFiles(LeRobotData(path=info.root)), list(columns), f"{first.version} {first.size}"
        )
        for number in range(min(_NUM_SAMPLED_EPISODES, info.episodes)):
            file = fill_template(info.data_path, number // info.chunk_episodes, number if info.version == "v2.1" else 0)
            rows = parquet_rows.read_rows(storage.join(info.root, file), number)
            for name in columns:
                values[name].append(rows[name].astype(np.float64))
    return {name: episodes for name, episodes in values.items() if episodes}
