"""Writer of data sets in DROID's RLDS schema, field for field, so that TFDS itself reads them.

Source: measured on files that TFDS wrote in DROID's schema (layout, kinds of lists, names; no code).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from jaxtyping import Float

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.tfrecord import Kind, encode_example, write_record
from vjepa2_ac.data.sources.rlds.writing.droid_schema import dataset_info, droid_features
from vjepa2_ac.errors import InputError

CAMERAS = ("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left")

_INFO = "dataset_info.json"


@dataclass(frozen=True)
class DroidCommands:
    """The controller's commands at every control step (DROID's `action_dict`)."""

    cartesian_position: Float[np.ndarray, "steps 6"]  # metres, extrinsic xyz Euler angles
    cartesian_velocity: Float[np.ndarray, "steps 6"]
    gripper_position: Float[np.ndarray, "steps 1"]  # closedness: 0 open .. 1 closed
    gripper_velocity: Float[np.ndarray, "steps 1"]
    joint_position: Float[np.ndarray, "steps 7"]
    joint_velocity: Float[np.ndarray, "steps 7"]


@dataclass(frozen=True)
class DroidMeasurements:
    """The robot's measurements at every control step (DROID's `observation`, without images)."""

    cartesian_position: Float[np.ndarray, "steps 6"]  # metres, extrinsic xyz Euler angles
    gripper_position: Float[np.ndarray, "steps 1"]  # closedness: 0 open .. 1 closed
    joint_position: Float[np.ndarray, "steps 7"]


@dataclass(frozen=True)
class DroidEpisode:
    """One demonstration as DROID records it.

    Discount, reward and the first, last and terminal flags follow from the length and `/success/` in the path.
    """

    file_path: str  # …/success/… or …/failure/…; with the folder it is the episode's identity
    recording_folderpath: str
    action: Float[np.ndarray, "steps 7"]  # commanded pose and gripper
    action_dict: DroidCommands
    observation: DroidMeasurements
    images: Mapping[str, Sequence[bytes]]  # one JPEG per step for each of CAMERAS
    language_instruction: str = ""

    @property
    def num_steps(self) -> int:
        """Control steps."""
        return len(self.action)


def write_droid_rlds(
    folder: str | Path,
    episodes: Iterable[DroidEpisode],
    *,
    shards: int,
    name: str = "r2d2_faceblur",
    version: str = "1.0.0",
    notes: Mapping[str, str] | None = None,
) -> Path:
    """Write episodes as a data set in DROID's RLDS schema and return its folder; one episode is in memory at a time.

    Episodes are assigned to the shards in turn. An incomplete folder is never a data set.

    Args:
        folder: New or empty.
        episodes: What is written.
        shards: TFRecord files.
        name: Of the data set.
        version: Of the data set.
        notes: Other text files beside the shards, by name; TFDS and our reader use only those that they know.

    Raises:
        InputError: The folder exists and is not empty, or cannot be written, or there are fewer episodes than shards.
        ValueError: An episode's arrays and images are inconsistent.
    """
    folder = Path(folder)
    storage.require_new_folder(folder)
    with storage.folder_writer(folder, _INFO) as partial:
        counts, num_bytes, sizes = _write_shards(partial, episodes, shards, name)
        if min(counts) == 0:
            found, needed = f"{sum(counts)} episodes", f"at least one for each of {shards} shards"
            raise InputError(where=str(folder), found=found, needed=needed)
        for file, text in (notes or {}).items():
            storage.write_atomically(partial / file, text)
        _write_json(partial / "features.json", droid_features(sizes), indent=4)
        _write_json(partial / _INFO, dataset_info(name, version, counts, num_bytes), indent=2)
    return folder


def _write_shards(
    folder: Path, episodes: Iterable[DroidEpisode], shards: int, name: str
) -> tuple[list[int], int, dict[str, tuple[int, int]]]:
    counts, num_bytes, sizes = [0] * shards, 0, dict[str, tuple[int, int]]()
    with ExitStack() as stack:
        names = [f"{name}-train.tfrecord-{shard:05d}-of-{shards:05d}" for shard in range(shards)]
        files = [stack.enter_context(storage.atomic_writer(folder / name)) for name in names]
        for number, episode in enumerate(episodes):
            _check(episode, sizes)
            record = encode_example(_features_of(episode))
            write_record(files[number % shards], record)
            counts[number % shards] += 1
            num_bytes += len(record)
    return counts, num_bytes, sizes


def _check(episode: DroidEpisode, sizes: dict[str, tuple[int, int]]) -> None:
    """Refuse an episode whose parts differ in length or shape; the images of a camera share one size."""
    steps = episode.num_steps
    arrays = {"action": (episode.action, 7)}
    for group in (episode.action_dict, episode.observation):
        for item in fields(group):
            width = {"cart": 6, "grip": 1, "join": 7}[item.name[:4]]
            arrays[f"{type(group).__name__}.{item.name}"] = (getattr(group, item.name), width)
    for label, (array, width) in arrays.items():
        if array.shape != (steps, width) or not np.isfinite(array).all():
            raise ValueError(f"{episode.file_path}: {label} must be {steps} x {width} finite numbers, is {array.shape}")
    if steps == 0 or sorted(episode.images) != sorted(CAMERAS):
        raise ValueError(f"{episode.file_path}: {steps} steps, cameras {sorted(episode.images)}; needed: {CAMERAS}")
    for camera, images in episode.images.items():
        height, width, _, _ = simplejpeg.decode_jpeg_header(images[0])
        expected = sizes.setdefault(camera, (height, width))
        if len(images) != steps or expected != (height, width):
            found, needed = f"{len(images)} images of {height}x{width}", f"{steps} of {expected[0]}x{expected[1]}"
            raise ValueError(f"{episode.file_path}: {camera} has {found}; needed: {needed}")


def _features_of(episode: DroidEpisode) -> dict[str, tuple[Kind, Sequence[Any] | np.ndarray]]:
    steps = episode.num_steps
    first, last = np.eye(1, steps, 0, dtype=int)[0], np.eye(1, steps, steps - 1, dtype=int)[0]
    features: dict[str, tuple[Kind, Sequence[Any] | np.ndarray]] = {
        "episode_metadata/file_path": ("bytes_list", [episode.file_path.encode()]),
        "episode_metadata/recording_folderpath": ("bytes_list", [episode.recording_folderpath.encode()]),
        "steps/action": ("float_list", episode.action.ravel()),
        "steps/discount": ("float_list", np.ones(steps)),
        "steps/reward": ("float_list", last * float("/success/" in episode.file_path)),
        "steps/is_first": ("int64_list", first),
        "steps/is_last": ("int64_list", last),
        "steps/is_terminal": ("int64_list", last),
        "steps/language_instruction": ("bytes_list", [episode.language_instruction.encode()] * steps),
        "steps/language_instruction_2": ("bytes_list", [b""] * steps),
        "steps/language_instruction_3": ("bytes_list", [b""] * steps),
    }
    for prefix, group in (("action_dict", episode.action_dict), ("observation", episode.observation)):
        for item in fields(group):
            features[f"steps/{prefix}/{item.name}"] = ("float_list", getattr(group, item.name).ravel())
    for camera, images in episode.images.items():
        features[f"steps/observation/{camera}"] = ("bytes_list", images)
    return features


def _write_json(path: Path, value: Mapping[str, Any], *, indent: int) -> None:
    storage.write_atomically(path, json.dumps(value, indent=indent, sort_keys=True))
