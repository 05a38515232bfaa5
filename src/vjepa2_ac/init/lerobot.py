"""A LeRobot data set: columns and cameras of its meta/info.json, and the gripper's range of its statistics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, read_info
from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.init.found import Column, FoundData, Knob, Knobs, Pose, find_pose, idle_rule, pick_camera, short_name
from vjepa2_ac.storage.structured import json_object

_STATISTICS = ("meta/stats.json", "meta/episodes_stats.jsonl")
_MOST_BYTES = 256 << 20  # of statistics
_NUMBERS = ("float", "int", "uint")
_OURS = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index", "subtask_index"})
_DROID_GRIPPER = "observation.state.gripper_position"
_OF_DROID = frozenset({"building", "collector_id"})  # columns of its ports to LeRobot
_METRES, _UNIT = 0.15, 1.05  # largest values of a gripper's opening in metres, and of a share


def look_at_lerobot(path: str) -> FoundData:
    """Look at a LeRobot data set.

    Raises:
        InputError: It cannot be used, or has no camera or no numbers of the robot.
    """
    info = read_info(path)
    cameras = {name: one for name, one in info.features.items() if one.is_camera}
    depth = [name for name, one in info.features.items() if one.is_depth]
    if not cameras:
        found = f"no camera, only depth maps ({', '.join(depth)})" if depth else "no camera"
        raise InputError(where=info.where, found=found, needed="videos or images of the robot")
    columns = {
        name: Column(one.width, one.names)
        for name, one in info.features.items()
        if one.dtype.startswith(_NUMBERS) and name not in _OURS
    }
    pose = find_pose(columns)
    first = pick_camera(list(cameras))
    short = {name: short_name(name) for name in cameras}
    used = list(short.values())
    names = {name: one if used.count(one) == 1 else name for name, one in short.items()}
    among = f"of {', '.join(names.values())}; the released weights saw DROID's exterior_1_left"
    fields = _pose_fields(info, pose) if pose else _vector_fields(info, columns)
    velocity = next((name for name in columns if "joint_vel" in name and name.startswith("action")), None)
    success = next((name for name in info.features if "success" in name), None)
    return FoundData(
        source="lerobot",
        path=path,
        knobs={
            "camera": Knob(names[first], among if len(names) > 1 else "", is_guess=len(cameras) > 1),
            "lerobot": {
                **fields,
                "cameras": Knob({short: name for name, short in names.items()}),
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


def _pose_fields(info: DatasetInfo, pose: Pose) -> Knobs:
    reason = pose.why + ("" if not pose.is_guess else "; docs/data.md says what a pose is")
    return {
        "state": Knob(list(pose.columns), reason, pose.is_guess),
        **({} if pose.select is None else {"select": Knob(list(pose.select))}),
        "rotation": Knob(pose.rotation, "the same guess" if pose.is_guess else "", pose.is_guess),
        **_gripper(info, pose),
    }


def _gripper(info: DatasetInfo, pose: Pose) -> Knobs:
    """Return which values are open and closed, by the range of the gripper's numbers."""
    column, number = pose.gripper
    if column == _DROID_GRIPPER and info.features.keys() >= _OF_DROID:
        return {"gripper_open": Knob(0.0, "DROID's"), "gripper_closed": Knob(1.0)}
    opened, closed, why = 0.0, 1.0, "no statistics say its range"
    if found := _range_of(info.root, column, number):
        low, high = found
        why = f"its numbers go from {low:.3g} to {high:.3g}"
        if 0 < high <= _METRES:
            opened, closed, why = round(high, 4), 0.0, f"{why}: metres apart?"
        elif high > _UNIT:
            opened, closed, why = round(high, 1), max(0.0, round(low, 1)), f"{why}: percent open?"
    why = f"{why}; `data check CONFIG --model` finds out whether it is inverted"
    return {"gripper_open": Knob(opened, why, is_guess=True), "gripper_closed": Knob(closed, "likewise", is_guess=True)}


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
