"""An RLDS data set: its episodes by dataset_info.json, its features by features.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import prod
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.shards import dataset_name, find_shards
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.init.found import Column, FoundData, Knob, Knobs, find_pose, idle_rule, pick_camera, short_name
from vjepa2_ac.storage.structured import read_json_object

DROID = "gs://gresearch/robotics/droid/1.0.1"
RANGES = "gs://openpi-assets/droid/droid_sample_ranges_v1_0_1.json"
_DROID_EPISODES, _DROID_STEPS = 95_658, 27_600_000
_DROID_CAMERA, _SEEN = "exterior_1_left", "what the released weights saw"
_DROID_FEATURE, _BRIDGE_FEATURE = "steps/observation/exterior_image_1_left", "steps/observation/state"
_DROID_NAMES = frozenset({"droid", "droid_100", "droid_101", "r2d2_faceblur"})  # as the sets call themselves
_BRIDGE_NAMES = frozenset({"bridge", "bridge_dataset", "bridge_orig"})
_DROID_RATE_HZ, _BRIDGE_RATE_HZ, _UNKNOWN_RATE_HZ = 15.0, 5.0, 10.0
_SIMULATION = "simulation.json"  # beside the shards of `vjepa2-ac simulate record`
_VELOCITIES = "steps/action_dict/joint_velocity"


@dataclass(frozen=True)
class _Feature:
    kind: str  # image, text, tensor
    dtype: str = ""
    width: int = 1


def droid() -> FoundData:
    """Return what is known of DROID 1.0.1 without a look at it."""
    published = Knob("published", "openpi's ranges; they are valid for 1.0.1 only")
    return replace(
        like_droid(DROID, _DROID_EPISODES, is_simulated=False),
        steps=_DROID_STEPS,
        idle={"rule": published, "ranges": Knob(RANGES)},
        about=(f"DROID 1.0.1, {_DROID_EPISODES:,} episodes, 1.7 TB, fetched from Google Cloud as they are needed",),
    )


def look_at_rlds(path: str) -> FoundData:
    """Look at an RLDS data set.

    Raises:
        InputError: It cannot be used, or has no images or no pose that could be recognized.
    """
    shards = find_shards(path)
    features = dict(_features(path))
    episodes = sum(shard.episodes for shard in shards)
    name = dataset_name(path)
    if name in _DROID_NAMES and _DROID_FEATURE in features:
        is_simulated = storage.exists(storage.join(path, _SIMULATION))
        return like_droid(path, episodes, is_simulated=is_simulated)
    images = [name for name, one in features.items() if one.kind == "image" and name.startswith("steps/")]
    if not images:
        where = storage.join(path, "features.json")
        raise InputError(where=where, found="no images among its features", needed="images of the robot at each step")
    is_bridge = name in _BRIDGE_NAMES and _BRIDGE_FEATURE in features
    rate = _rate(features, is_bridge=is_bridge)
    has_velocities = _VELOCITIES in features
    first, texts = pick_camera(images), [name for name, one in features.items() if one.kind == "text"]
    return FoundData(
        source="rlds",
        path=path,
        knobs={
            "camera": Knob(short_name(first), f"of {', '.join(map(short_name, images))}", is_guess=len(images) > 1),
            "fields": {
                **_state(path, features, is_bridge=is_bridge),
                "identity": Knob(_identity(features), "what tells episodes apart", is_guess=True),
                "cameras": Knob({short_name(name): name for name in images}),
                "language": Knob(next((name for name in texts if "instruction" in name), None)),
                "joint_velocity": Knob(_VELOCITIES if has_velocities else None),
                "control_rate_hz": rate,
            },
        },
        rate_hz=rate,
        episodes=episodes,
        idle=idle_rule(has_velocities=has_velocities),
        about=(f"RLDS {name}, {episodes:,} episodes, {rate.value:g} steps a second{' (guessed)' * rate.is_guess}",),
    )


def like_droid(path: str, episodes: int, *, is_simulated: bool) -> FoundData:
    """Return what is known of DROID, or of the simulated arm, whose data sets are called as DROID's."""
    camera = "a view from outside, as of DROID the released weights saw it" if is_simulated else _SEEN
    rule = "openpi's rule" + ("" if is_simulated else "; the published ranges are of DROID 1.0.1")
    title = "the simulated arm" if is_simulated else "DROID"
    return FoundData(
        source="rlds",
        path=path,
        knobs={"camera": Knob(_DROID_CAMERA, camera)},
        rate_hz=Knob(_DROID_RATE_HZ),
        episodes=episodes,
        idle={"rule": Knob("commands", rule)},
        about=(f"RLDS, {title}, {episodes:,} episodes, {_DROID_RATE_HZ:g} steps a second",),
    )


def _rate(features: Mapping[str, _Feature], *, is_bridge: bool) -> Knob:
    """Return the control rate: only the name of a known data set tells it."""
    if is_bridge:
        return Knob(_BRIDGE_RATE_HZ, "RLDS does not say; BridgeData's")
    if _DROID_FEATURE in features:
        why = "RLDS does not say; its cameras are called as DROID's, which has 15"
        return Knob(_DROID_RATE_HZ, why, is_guess=True)
    return Knob(_UNKNOWN_RATE_HZ, "RLDS does not say: your robot's control steps a second", is_guess=True)


def _features(path: str) -> Iterator[tuple[str, _Feature]]:
    """Yield the features by their names in a record."""
    where = storage.join(path, "features.json")
    try:
        content = read_json_object(where, needed="a description as TFDS writes it")
    except MissingFileError:
        fix = "Name the features in the config by hand: `vjepa2-ac config text builtin:bridge` is an example"
        needed = "the features, as TFDS writes them"
        raise InputError(where=where, found="no such file", needed=needed, fix=fix) from None
    yield from _inside(content, "")


def _inside(content: Any, name: str) -> Iterator[tuple[str, _Feature]]:
    if not isinstance(content, Mapping):
        return
    if "featuresDict" in content:
        for key, one in dict(content["featuresDict"].get("features", {})).items():
            yield from _inside(one, f"{name}/{key}" if name else key)
    elif "sequence" in content:
        yield from _inside(content["sequence"].get("feature"), name)
    else:
        kind = next((one for one in ("image", "text", "tensor") if one in content), "")
        about = content.get(kind) or {}
        sizes = [int(size) for size in about.get("shape", {}).get("dimensions", [])]
        yield name, _Feature(kind, str(about.get("dtype", "")), prod(sizes))


def _state(path: str, features: Mapping[str, _Feature], *, is_bridge: bool) -> Knobs:
    columns = {
        name: Column(one.width)
        for name, one in features.items()
        if name.startswith("steps/") and one.kind == "tensor" and one.dtype.startswith("float")
    }
    pose = find_pose(columns)
    if pose is None or pose.rotation != "euler_xyz":
        found = ", ".join(f"{name} [{one.width}]" for name, one in columns.items()) or "no numbers"
        fix = "If others are the robot's numbers, name them in a config with `states: vector` (builtin:joints)"
        needed = "x, y, z, three angles and the gripper, measured"
        raise InputError(where=storage.join(path, "features.json"), found=found, needed=needed, fix=fix)
    state = Knob(list(pose.columns), pose.why, pose.is_guess)
    gripper = Knob("closedness", "whether 1 is closed or open: `data check CONFIG --model` tells", is_guess=True)
    if is_bridge:
        state = Knob(list(pose.columns), "x, y, z, three angles, the gripper")
        gripper = Knob("openness", "1 is open in BridgeData")
    return {"state": state, "gripper": gripper}


def _identity(features: Mapping[str, _Feature]) -> list[str]:
    found = [name for name, one in features.items() if name.startswith("episode_metadata/") and one.kind != "image"]
    paths = [name for name in found if name.rsplit("/", 1)[-1] in {"file_path", "episode_id", "recording_folderpath"}]
    return paths or found or ["episode_metadata/file_path"]
