"""Read the properties of an RLDS data set from dataset_info.json, features.json and its first records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds_episode import Record
from vjepa2_ac.data.sources.rlds_shards import Shard, find_shards, open_shard, read_dataset_name
from vjepa2_ac.data.sources.tfrecord import HEADER_BYTES, Kind, parse_header
from vjepa2_ac.errors import InputError, MissingFileError, UserError, counted
from vjepa2_ac.init.dataset_properties import DatasetProperties, is_not_camera, make_camera_values, make_idle_section
from vjepa2_ac.init.draft_values import DraftValue
from vjepa2_ac.init.poses import Column, Samples, find_pose, select_measured_columns, select_vector_state
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
    "state": DraftValue([_BRIDGE_FEATURE], "x, y, z, three Euler angles, gripper"),
    "gripper_open": DraftValue(1.0, "BridgeData's convention"),
    "gripper_closed": DraftValue(0.0),
}
_DROID_RATE_HZ, _BRIDGE_RATE_HZ, _UNKNOWN_RATE_HZ = 15.0, 5.0, 10.0
_VELOCITIES = "steps/action_dict/joint_velocity"
_NUM_SAMPLED_RECORDS = 24  # number of records whose values are read to check what the column names suggest
_NUMBER_DTYPES = ("float", "int", "uint", "bool")
_ALL_KINDS: tuple[Kind, ...] = ("bytes_list", "float_list", "int64_list")
_PATHS = frozenset({"file_path", "episode_id", "recording_folderpath"})


@dataclass(frozen=True)
class _Feature:
    kind: str  # image, text, tensor
    dtype: str = ""
    width: int = 1
    channels: int = 0  # of an image; 0: unknown


def make_published_droid_properties() -> DatasetProperties:
    """Return the properties of DROID 1.0.1 without reading the data set."""
    published = DraftValue("published", "openpi's list of non-idle ranges, valid for DROID 1.0.1 only")
    return replace(
        make_droid_properties(DROID, _DROID_EPISODES, "DROID 1.0.1"),
        steps=_DROID_STEPS,
        idle={"rule": published, "ranges": DraftValue(RANGES)},
        descriptions=(f"DROID 1.0.1, {_DROID_EPISODES:,} episodes, 1.7 TB, streamed from Google Cloud",),
    )


def read_rlds_properties(path: str) -> DatasetProperties:
    """Read the properties of an RLDS data set.

    Raises:
        InputError: The data set cannot be read, or has no images or no measured numbers of the robot.
    """
    shards = find_shards(path)
    features = dict(_read_features(path))
    episodes = sum(shard.episodes for shard in shards)
    name = read_dataset_name(path)
    if name in _DROID_NAMES and _DROID_FEATURE in features:
        is_simulated = storage.exists(storage.join(path, SIMULATION_FILE))
        return make_droid_properties(path, episodes, "simulated arm" if is_simulated else "DROID")
    images, depth = _find_cameras(features)
    where = storage.join(path, "features.json")
    camera, all_cameras = make_camera_values(images, depth, where)
    is_bridge = name in _BRIDGE_NAMES and _BRIDGE_FEATURE in features
    rate = _choose_control_rate(features, is_bridge=is_bridge)
    has_velocities = _VELOCITIES in features
    text_features = [name for name, feature in features.items() if feature.kind == "text"]
    columns = {
        name: Column(feature.width)
        for name, feature in features.items()
        if name.startswith("steps/")
        and feature.kind == "tensor"
        and feature.dtype.startswith(_NUMBER_DTYPES)
        and feature.width > 0
    }
    episode_texts = [
        name
        for name, feature in features.items()
        if name.startswith("episode_metadata/")
        and (feature.kind == "text" or feature.dtype.startswith(("int", "uint", "str")))
    ]
    measured = select_measured_columns(columns)
    records = _sample_records(shards, [*measured, *episode_texts])
    pose = (
        _BRIDGE_POSE
        if is_bridge
        else find_pose(columns, _collect_samples(records, measured), control_rate_hz=rate.value)
    )
    control_rate = f"{rate.value:g} control steps per second{' (guessed)' if rate.is_guess else ''}"
    return DatasetProperties(
        source="rlds",
        path=path,
        config_values={
            "camera": camera,
            "fields": {
                **(pose or select_vector_state(columns, where)),
                "identity": _choose_identity(records, episode_texts),
                "cameras": all_cameras,
                "language": DraftValue(next((name for name in text_features if "instruction" in name), None)),
                "joint_velocity": DraftValue(_VELOCITIES if has_velocities else None),
                "control_rate_hz": rate,
            },
        },
        rate_hz=rate,
        states="pose" if pose else "vector",
        episodes=episodes,
        idle=make_idle_section(has_velocities=has_velocities) if pose else None,
        descriptions=(f"RLDS ({name}), {counted(episodes, 'episode')}, {control_rate}",)
        + ((f"unused depth maps: {', '.join(depth)}",) if depth else ()),
    )


def make_droid_properties(path: str, episodes: int, title: str) -> DatasetProperties:
    """Return the properties of a data set with the features of DROID, for example from the simulated arm."""
    return DatasetProperties(
        source="rlds",
        path=path,
        config_values={"camera": DraftValue(_DROID_CAMERA)},
        rate_hz=DraftValue(_DROID_RATE_HZ),
        episodes=episodes,
        idle={
            "rule": DraftValue(
                "commands", "openpi's rule: removes steps in which the commanded joint velocities do not change"
            )
        },
        descriptions=(f"RLDS ({title}), {counted(episodes, 'episode')}, {_DROID_RATE_HZ:g} control steps per second",),
    )


def _choose_control_rate(features: Mapping[str, _Feature], *, is_bridge: bool) -> DraftValue:
    """Return the control rate of a known data set, or else a guess, because RLDS does not store the rate."""
    if is_bridge:
        return DraftValue(_BRIDGE_RATE_HZ, "BridgeData's control rate, which RLDS does not store")
    if _DROID_FEATURE in features:
        reason = "RLDS does not store the control rate; the cameras have the names of DROID, which has 15 Hz"
        return DraftValue(_DROID_RATE_HZ, reason, is_guess=True)
    return DraftValue(
        _UNKNOWN_RATE_HZ,
        "RLDS does not store the control rate. Enter the number of control steps per second of your robot",
        is_guess=True,
    )


def _read_features(path: str) -> Iterator[tuple[str, _Feature]]:
    """Yield the features of an RLDS data set with their names in a record.

    Raises:
        InputError: features.json does not exist or is not a valid description.
    """
    where = storage.join(path, "features.json")
    try:
        content = read_json_object(where, needed="a feature description written by TFDS")
    except MissingFileError:
        fix = "Or list the features in a config: `vjepa2-ac config text builtin:bridge` prints an example"
        needed = "a feature description written by TFDS"
        raise InputError(where=where, found="no such file", needed=needed, fix=fix) from None
    try:
        yield from _iterate_features(content, "")
    except (AttributeError, TypeError, ValueError) as error:
        problem = f"an invalid feature description ({error})"
        raise InputError(where=where, found=problem, needed="a feature description written by TFDS") from None


def _iterate_features(content: Any, name: str) -> Iterator[tuple[str, _Feature]]:
    if not isinstance(content, Mapping):
        return
    if "featuresDict" in content:
        for key, feature in dict(content["featuresDict"].get("features", {})).items():
            yield from _iterate_features(feature, f"{name}/{key}" if name else key)
    elif "sequence" in content:
        yield from _iterate_features(content["sequence"].get("feature"), name)
    else:
        kind = next((kind for kind in ("image", "text", "tensor") if kind in content), "")
        description = content.get(kind) or {}
        sizes = [int(size) for size in description.get("shape", {}).get("dimensions", [])]
        yield (
            name,
            _Feature(kind, str(description.get("dtype", "")), math.prod(sizes), sizes[-1] if len(sizes) == 3 else 0),
        )


def _find_cameras(features: Mapping[str, _Feature]) -> tuple[list[str], list[str]]:
    """Return the features with camera images (colour, or grey if there are none), and those with depth maps."""
    images = {name: feature for name, feature in features.items() if feature.kind == "image" and _is_step_feature(name)}
    depth = [name for name, image in images.items() if is_not_camera(name) or image.dtype not in {"", "uint8"}]
    colour = [name for name, image in images.items() if name not in depth and image.channels != 1]
    return colour or [name for name in images if name not in depth], depth


def _is_step_feature(name: str) -> bool:
    return name.startswith("steps/")


def _sample_records(shards: Sequence[Shard], names: Sequence[str]) -> list[dict[str, tuple[Any, ...]]]:
    """Return the values of features in the first records.

    Reading stops at a record that cannot be read, without an error: `data check` reports it later.
    """
    records: list[dict[str, tuple[Any, ...]]] = []
    with suppress(UserError, OSError):
        for shard in shards[:_NUM_SAMPLED_RECORDS]:
            with open_shard(shard) as read:
                offset = 0
                for number in range(min(shard.episodes, -(-_NUM_SAMPLED_RECORDS // len(shards)))):
                    span = parse_header(read(offset, HEADER_BYTES), shard.path, number, offset, shard.size)
                    record, offset = Record(read, span), span.end
                    present = [name for name in names if name in record.feature_ranges]
                    records.append({name: tuple(record.read_values(name, *_ALL_KINDS)) for name in present})
    return records


def _collect_samples(records: Sequence[Mapping[str, tuple[Any, ...]]], columns: Mapping[str, Column]) -> Samples:
    """Return the numbers of each record, by column; columns whose width differs from the description are left out."""
    return {
        name: [np.array(record[name], np.float64).reshape(-1, column.width) for record in records]
        for name, column in columns.items()
        if records and all(record.get(name) and len(record[name]) % column.width == 0 for record in records)
    }


def _choose_identity(records: Sequence[Mapping[str, tuple[Any, ...]]], names: Sequence[str]) -> DraftValue:
    """Return the features that identify the sampled episodes; `record` if no features do."""
    paths = [name for name in names if name.rsplit("/", 1)[-1] in _PATHS]
    for candidates in (paths, names):
        values = [tuple(record.get(name, ()) for name in candidates) for record in records]
        is_named = all(any(part != b"" for feature in value for part in feature) for value in values)
        if candidates and values and is_named and len(set(values)) == len(values):
            return DraftValue(list(candidates), "features that identify an episode", is_guess=True)
    if not records and names:
        return DraftValue(
            list(paths or names), "features that may identify an episode; no record could be read", is_guess=True
        )
    reason = "no feature identifies an episode: rewriting the data set may move episodes between train and test"
    return DraftValue("record", reason, is_guess=True)
