"""Recognise RLDS data sets (dataset_info.json, features.json) and LeRobot data sets (meta/info.json)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.config.sources import JOINT_VELOCITY
from vjepa2_ac.data.files import EpisodeFiles
from vjepa2_ac.data.sources.lerobot_meta import DatasetInfo, filled, list_by_template, read_info
from vjepa2_ac.data.sources.parquet import ParquetRows
from vjepa2_ac.data.sources.rlds_episode import Record
from vjepa2_ac.data.sources.rlds_shards import Shard, dataset_name, find_shards, open_shard
from vjepa2_ac.data.sources.tfrecord import HEADER_BYTES, Kind, span_at
from vjepa2_ac.errors import InputError, MissingFileError, UserError, counted
from vjepa2_ac.init.found import FoundData, Knob, camera_knobs, idle_rule, is_no_camera
from vjepa2_ac.init.poses import Column, Samples, find_pose, measured_columns, vector_state
from vjepa2_ac.storage.paths import SIMULATION_FILE
from vjepa2_ac.storage.structured import read_json_object

DROID = "gs://gresearch/robotics/droid/1.0.1"
RANGES = "gs://openpi-assets/droid/droid_sample_ranges_v1_0_1.json"
_DROID_EPISODES, _DROID_STEPS = 95_658, 27_600_000
_DROID_CAMERA = "exterior_1_left"
_DROID_FEATURE, _BRIDGE_FEATURE = "steps/observation/exterior_image_1_left", "steps/observation/state"
_DROID_NAMES = frozenset({"droid", "droid_100", "droid_101", "r2d2_faceblur"})  # names in dataset_info.json
_BRIDGE_NAMES = frozenset({"bridge", "bridge_dataset", "bridge_orig"})
_BRIDGE_POSE = {
    "state": Knob([_BRIDGE_FEATURE], "x, y, z, three angles, the gripper"),
    "gripper_open": Knob(1.0, "BridgeData's"),
    "gripper_closed": Knob(0.0),
}
_DROID_RATE_HZ, _BRIDGE_RATE_HZ, _UNKNOWN_RATE_HZ = 15.0, 5.0, 10.0
_VELOCITIES = "steps/action_dict/joint_velocity"
_SAMPLED = 24  # number of records or episodes whose values are read to check what the column names suggest
_NUMBERS = ("float", "int", "uint", "bool")
_ALL_KINDS: tuple[Kind, ...] = ("bytes_list", "float_list", "int64_list")
_PATHS = frozenset({"file_path", "episode_id", "recording_folderpath"})


@dataclass(frozen=True)
class _Feature:
    kind: str  # image, text, tensor
    dtype: str = ""
    width: int = 1
    channels: int = 0  # of an image; 0: unknown


def droid() -> FoundData:
    """Return the properties of DROID 1.0.1 without reading the data set."""
    published = Knob("published", "openpi's ranges; they are valid for 1.0.1 only")
    return replace(
        like_droid(DROID, _DROID_EPISODES, "DROID 1.0.1"),
        steps=_DROID_STEPS,
        idle={"rule": published, "ranges": Knob(RANGES)},
        about=(f"DROID 1.0.1, {_DROID_EPISODES:,} episodes, 1.7 TB, fetched from Google Cloud as they are needed",),
    )


def look_at_rlds(path: str) -> FoundData:
    """Read the properties of an RLDS data set.

    Raises:
        InputError: The data set cannot be read, or has no images or no measured numbers of the robot.
    """
    shards = find_shards(path)
    features = dict(_features(path))
    episodes = sum(shard.episodes for shard in shards)
    name = dataset_name(path)
    if name in _DROID_NAMES and _DROID_FEATURE in features:
        is_simulated = storage.exists(storage.join(path, SIMULATION_FILE))
        return like_droid(path, episodes, "the simulated arm" if is_simulated else "DROID")
    images, depth = _cameras(features)
    where = storage.join(path, "features.json")
    camera, all_cameras = camera_knobs(images, depth, where)
    is_bridge = name in _BRIDGE_NAMES and _BRIDGE_FEATURE in features
    rate = _rate(features, is_bridge=is_bridge)
    has_velocities = _VELOCITIES in features
    texts = [name for name, feature in features.items() if feature.kind == "text"]
    columns = {
        name: Column(one.width)
        for name, one in features.items()
        if name.startswith("steps/") and one.kind == "tensor" and one.dtype.startswith(_NUMBERS) and one.width > 0
    }
    texts_of_episode = [
        name
        for name, one in features.items()
        if name.startswith("episode_metadata/") and (one.kind == "text" or one.dtype.startswith(("int", "uint", "str")))
    ]
    measured = measured_columns(columns)
    records = _sample_records(shards, [*measured, *texts_of_episode])
    pose = _BRIDGE_POSE if is_bridge else find_pose(columns, _samples(records, measured), control_rate_hz=rate.value)
    speed = f"{rate.value:g} steps a second{' (guessed)' * rate.is_guess}"
    return FoundData(
        source="rlds",
        path=path,
        knobs={
            "camera": camera,
            "fields": {
                **(pose or vector_state(columns, where)),
                "identity": _identity(records, texts_of_episode),
                "cameras": all_cameras,
                "language": Knob(next((name for name in texts if "instruction" in name), None)),
                "joint_velocity": Knob(_VELOCITIES if has_velocities else None),
                "control_rate_hz": rate,
            },
        },
        rate_hz=rate,
        states="pose" if pose else "vector",
        episodes=episodes,
        idle=idle_rule(has_velocities=has_velocities) if pose else None,
        about=(f"RLDS {name}, {counted(episodes, 'episode')}, {speed}",)
        + ((f"depth maps are not used: {', '.join(depth)}",) if depth else ()),
    )


def like_droid(path: str, episodes: int, title: str) -> FoundData:
    """Return the properties of a data set with the features of DROID, for example from the simulated arm."""
    return FoundData(
        source="rlds",
        path=path,
        knobs={"camera": Knob(_DROID_CAMERA)},
        rate_hz=Knob(_DROID_RATE_HZ),
        episodes=episodes,
        idle={"rule": Knob("commands", "openpi's rule")},
        about=(f"RLDS, {title}, {counted(episodes, 'episode')}, {_DROID_RATE_HZ:g} steps a second",),
    )


def _rate(features: Mapping[str, _Feature], *, is_bridge: bool) -> Knob:
    """Return the control rate, which RLDS does not store: it is known only for known data sets, otherwise a guess."""
    if is_bridge:
        return Knob(_BRIDGE_RATE_HZ, "RLDS does not say; BridgeData's")
    if _DROID_FEATURE in features:
        why = "RLDS does not say; its cameras are called as DROID's, which has 15"
        return Knob(_DROID_RATE_HZ, why, is_guess=True)
    return Knob(_UNKNOWN_RATE_HZ, "RLDS does not say: your robot's control steps a second", is_guess=True)


def _features(path: str) -> Iterator[tuple[str, _Feature]]:
    """Yield the features of an RLDS data set with their names in a record.

    Raises:
        InputError: features.json does not exist or is no valid description.
    """
    where = storage.join(path, "features.json")
    try:
        content = read_json_object(where, needed="a description as TFDS writes it")
    except MissingFileError:
        fix = "Name the features in the config by hand: `vjepa2-ac config text builtin:bridge` is an example"
        needed = "the features, as TFDS writes them"
        raise InputError(where=where, found="no such file", needed=needed, fix=fix) from None
    try:
        yield from _nested_features(content, "")
    except (AttributeError, TypeError, ValueError) as error:
        found = f"not a description of features ({error})"
        raise InputError(where=where, found=found, needed="the features, as TFDS writes them") from None


def _nested_features(content: Any, name: str) -> Iterator[tuple[str, _Feature]]:
    if not isinstance(content, Mapping):
        return
    if "featuresDict" in content:
        for key, feature in dict(content["featuresDict"].get("features", {})).items():
            yield from _nested_features(feature, f"{name}/{key}" if name else key)
    elif "sequence" in content:
        yield from _nested_features(content["sequence"].get("feature"), name)
    else:
        kind = next((kind for kind in ("image", "text", "tensor") if kind in content), "")
        about = content.get(kind) or {}
        sizes = [int(size) for size in about.get("shape", {}).get("dimensions", [])]
        yield name, _Feature(kind, str(about.get("dtype", "")), math.prod(sizes), sizes[-1] if len(sizes) == 3 else 0)


def _cameras(features: Mapping[str, _Feature]) -> tuple[list[str], list[str]]:
    """Return the features with camera images (colour, or grey if there are none), and those with depth maps."""
    images = {name: feature for name, feature in features.items() if feature.kind == "image" and _is_of_step(name)}
    depth = [name for name, image in images.items() if is_no_camera(name) or image.dtype not in {"", "uint8"}]
    colour = [name for name, image in images.items() if name not in depth and image.channels != 1]
    return colour or [name for name in images if name not in depth], depth


def _is_of_step(name: str) -> bool:
    return name.startswith("steps/")


def _sample_records(shards: Sequence[Shard], names: Sequence[str]) -> list[dict[str, tuple[Any, ...]]]:
    """Return the values of features in the first records.

    Reading stops at a record that cannot be read, without an error: `data check` reports it later.
    """
    records: list[dict[str, tuple[Any, ...]]] = []
    with suppress(UserError, OSError):
        for shard in shards[:_SAMPLED]:
            with open_shard(shard) as read:
                offset = 0
                for number in range(min(shard.episodes, -(-_SAMPLED // len(shards)))):
                    span = span_at(read(offset, HEADER_BYTES), shard.path, number, offset, shard.size)
                    record, offset = Record(read, span), span.end
                    present = [name for name in names if name in record.located]
                    records.append({name: tuple(record.values(name, *_ALL_KINDS)) for name in present})
    return records


def _samples(records: Sequence[Mapping[str, tuple[Any, ...]]], columns: Mapping[str, Column]) -> Samples:
    """Return the numbers of each record, by column; columns whose width differs from the description are left out."""
    return {
        name: [np.array(record[name], np.float64).reshape(-1, column.width) for record in records]
        for name, column in columns.items()
        if records and all(record.get(name) and len(record[name]) % column.width == 0 for record in records)
    }


def _identity(records: Sequence[Mapping[str, tuple[Any, ...]]], names: Sequence[str]) -> Knob:
    """Return the features that identify the sampled episodes; `record` if no features do."""
    paths = [name for name in names if name.rsplit("/", 1)[-1] in _PATHS]
    for candidates in (paths, names):
        values = [tuple(record.get(name, ()) for name in candidates) for record in records]
        is_named = all(any(part != b"" for feature in value for part in feature) for value in values)
        if candidates and values and is_named and len(set(values)) == len(values):
            return Knob(list(candidates), "what tells episodes apart", is_guess=True)
    if not records and names:
        return Knob(list(paths or names), "what tells episodes apart; no record could be read", is_guess=True)
    why = "no feature tells the episodes apart; writing the set again may move episodes between train and test"
    return Knob("record", why, is_guess=True)


# ---- LeRobot ----

_OURS = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index", "subtask_index"})
_DROID_GRIPPER = "observation.state.gripper_position"
_OF_DROID = frozenset({"building", "collector_id"})  # columns of DROID's conversions to LeRobot


def look_at_lerobot(path: str) -> FoundData:
    """Read the properties of a LeRobot data set.

    Raises:
        InputError: The data set cannot be read, or has no camera or no measured numbers of the robot.
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
    samples = _sampled_rows(info, measured_columns(columns))
    pose = find_pose(columns, samples, control_rate_hz=info.fps)
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


def _sampled_rows(info: DatasetInfo, columns: Mapping[str, Column]) -> Samples:
    """Return the numbers of the first episodes, by column.

    Reading stops at an episode that cannot be read, without an error: `data check` reports it later.
    """
    read: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    with suppress(UserError, OSError, KeyError):
        files = list_by_template(info.root, info.data_path)
        first = next(iter(files.values()))
        rows_in = ParquetRows(EpisodeFiles(LeRobotData(path=info.root)), list(columns), f"{first.version} {first.size}")
        for number in range(min(_SAMPLED, info.episodes)):
            file = filled(info.data_path, number // info.chunk_episodes, number if info.version == "v2.1" else 0)
            rows = rows_in.rows(storage.join(info.root, file), number)
            for name in columns:
                read[name].append(rows[name].astype(np.float64))
    return {name: episodes for name, episodes in read.items() if episodes}
