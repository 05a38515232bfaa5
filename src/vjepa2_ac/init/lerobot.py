"""A LeRobot data set: columns and cameras of its meta/info.json, and the gripper's range of its statistics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.data.files import EpisodeFiles
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, filled, list_by_template, read_info
from vjepa2_ac.data.sources.lerobot.parquet import ParquetRows
from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.init.found import FoundData, Knob, Knobs, camera_names, idle_rule, is_no_camera, pick_camera
from vjepa2_ac.init.poses import Column, Pose, Samples, find_pose, gripper_knobs, measured_columns, range_in
from vjepa2_ac.storage.structured import json_object

_STATISTICS = ("meta/stats.json", "meta/episodes_stats.jsonl")
_MOST_BYTES = 256 << 20  # of statistics
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
    if not cameras:
        found = f"no camera, only depth maps ({', '.join(depth)})" if depth else "no camera"
        raise InputError(where=info.where, found=found, needed="videos or images of the robot")
    columns = {
        name: Column(one.width, one.names)
        for name, one in info.features.items()
        if one.is_numbers and name not in _OURS
    }
    samples = _sampled(info, measured_columns(columns))
    pose = find_pose(columns, samples, control_rate_hz=info.fps)
    names = camera_names(cameras)
    first = names[pick_camera(cameras)]
    among = f"of {', '.join(names.values())}; the released weights were trained on DROID's exterior_1_left"
    fields = pose.knobs(_gripper(info, pose, samples)) if pose else _vector_fields(info, columns)
    velocity = next((name for name in columns if "joint_vel" in name and name.startswith("action")), None)
    success = next((name for name in info.features if "success" in name), None)
    return FoundData(
        source="lerobot",
        path=path,
        knobs={
            "camera": Knob(first, among if len(names) > 1 else "", is_guess=len(names) > 1),
            "lerobot": {
                **fields,
                "cameras": Knob({name: feature for feature, name in names.items()}),
                "joint_velocity": Knob(velocity),
                "success": Knob(success),
            },
        },
        rate_hz=Knob(info.fps, "of meta/info.json"),
        states="pose" if pose else "vector",
        episodes=info.episodes,
        steps=info.frames,
        idle=idle_rule(has_velocities=velocity is not None) if pose else None,
        about=(f"LeRobot {info.version}, {info.episodes:,} episodes at {info.fps:g} a second",)
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


def _gripper(info: DatasetInfo, pose: Pose, samples: Samples) -> Knobs:
    """Return which values are open and closed, by the range in the statistics or in the sampled episodes."""
    column, number = pose.gripper
    if column == _DROID_GRIPPER and info.features.keys() >= _OF_DROID:
        return {"gripper_open": Knob(0.0, "DROID's"), "gripper_closed": Knob(1.0)}
    names = info.features[column].names
    name = names[number] if len(names) > number else column.rsplit(".", 1)[-1]
    return gripper_knobs(name, _range_of(info.root, column, number) or range_in(samples, column, number))


def _range_of(root: str, column: str, number: int) -> tuple[float, float] | None:
    """Return the least and the greatest value that the statistics of a column give, None where none do."""
    lows, highs = [], []
    for statistics in _statistics(root):
        try:
            of_column = statistics[column]
            lows.append(float(of_column["min"][number]))
            highs.append(float(of_column["max"][number]))
        except (KeyError, IndexError, TypeError, ValueError):
            continue
    return (min(lows), max(highs)) if lows else None


def _statistics(root: str) -> Iterator[Mapping[str, Any]]:
    """Yield the statistics of the set (v3.0), or of each episode (v2.1); nothing, where they cannot be read."""
    for name in _STATISTICS:
        with contextlib.suppress(OSError, UserError):
            data = storage.read_bounded(storage.join(root, name), _MOST_BYTES)
            for line in [data] if name.endswith(".json") else data.splitlines():
                found = json_object(line, where=name)
                yield found.get("stats", found)


def _vector_fields(info: DatasetInfo, columns: Mapping[str, Column]) -> Knobs:
    """Return the numbers of a robot that says no pose: its joints, most often."""
    states = [name for name in columns if name.startswith("observation")]
    chosen = next((name for name in states if name == "observation.state"), states[0] if states else None)
    if chosen is None:
        found, needed = f"no column of measured numbers among {', '.join(columns) or 'none'}", "observation.state"
        raise InputError(where=info.where, found=found, needed=needed)
    why = f"{columns[chosen].width} numbers, and no pose among them that could be recognized"
    return {"state": Knob([chosen], why, is_guess=True)}
