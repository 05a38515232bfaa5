"""Write data sets in exactly DROID's RLDS schema, so that TFDS can read them.

Source: files that TFDS wrote in DROID's schema (layout, types of lists, names; no code was used).
"""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from jaxtyping import Float

from vjepa2_ac import storage
from vjepa2_ac.data.sources.tfrecord import Kind, encode_example, write_record
from vjepa2_ac.errors import InputError, counted

CAMERAS = ("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left")

_NAME = "r2d2_faceblur"
_INFO, _FEATURES = "dataset_info.json", "features.json"
_ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "droid"


@dataclass(frozen=True)
class DroidEpisode:
    """One demonstration with the fields of DROID.

    Discount, reward and the first, last and terminal flags follow from the length and `/success/` in the path.
    """

    file_path: str  # …/success/… or …/failure/…; together with the folder it identifies the episode
    recording_folderpath: str
    arrays: Mapping[str, Float[np.ndarray, "steps width"]]  # by feature, for example `action_dict/joint_position`
    images: Mapping[str, Sequence[bytes]]  # one JPEG per step for each of CAMERAS
    language_instruction: str = ""


def write_droid_rlds(
    folder: str | Path, episodes: Iterable[DroidEpisode], *, shards: int, notes: Mapping[str, str] | None = None
) -> Path:
    """Write episodes as a data set in DROID's RLDS schema and return its folder; one episode is in memory at a time.

    Episodes are assigned to the shards in turn. An interrupted call leaves no folder that is read as a data set.

    Args:
        folder: A new or empty folder.
        episodes: The episodes to write.
        shards: Number of TFRecord files.
        notes: Contents of additional text files in the folder, by name.

    Raises:
        InputError: The folder exists and is not empty, or cannot be written, or there are fewer episodes than shards.
    """
    folder, described = Path(folder), json.loads((_ASSETS / _FEATURES).read_text())
    steps = described["featuresDict"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    cameras = steps["observation"]["featuresDict"]["features"]
    counts, num_bytes = [0] * shards, 0
    storage.require_new_folder(folder)
    with storage.folder_writer(folder, _INFO) as partial, ExitStack() as stack:
        names = [f"{_NAME}-train.tfrecord-{shard:05d}-of-{shards:05d}" for shard in range(shards)]
        files = [stack.enter_context(storage.atomic_writer(partial / name)) for name in names]
        for number, episode in enumerate(episodes):
            for name, jpegs in episode.images.items():
                height, width = simplejpeg.decode_jpeg_header(jpegs[0])[:2]
                cameras[name]["image"]["shape"]["dimensions"] = [str(height), str(width), "3"]
            record = encode_example(_features_of(episode))
            write_record(files[number % shards], record)
            counts[number % shards] += 1
            num_bytes += len(record)
        stack.close()
        if min(counts) == 0:
            problem, needed = counted(sum(counts), "episode"), f"at least one for each of {shards} shards"
            raise InputError(where=str(folder), found=problem, needed=needed)
        texts = {
            _FEATURES: json.dumps(described, indent=4, sort_keys=True),
            _INFO: json.dumps(dataset_info(_NAME, "1.0.0", counts, num_bytes), indent=2, sort_keys=True),
        }
        for file, text in {**(notes or {}), **texts}.items():
            storage.write_atomically(partial / file, text)
    return folder


def dataset_info(name: str, version: str, counts: Sequence[int], num_bytes: int) -> dict[str, Any]:
    """Return the content of dataset_info.json for one split, `train`, with the given numbers of episodes per shard."""
    split = {
        "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
        "name": "train",
        "numBytes": str(num_bytes),
        "shardLengths": [str(count) for count in counts],
    }
    return {"fileFormat": "tfrecord", "moduleName": "__main__", "name": name, "splits": [split], "version": version}


def _features_of(episode: DroidEpisode) -> dict[str, tuple[Kind, Sequence[Any] | np.ndarray]]:
    steps = len(episode.arrays["action"])
    first, last = np.eye(1, steps, 0, dtype=int)[0], np.eye(1, steps, steps - 1, dtype=int)[0]
    texts = {"": episode.language_instruction.encode(), "_2": b"", "_3": b""}
    return {
        "episode_metadata/file_path": ("bytes_list", [episode.file_path.encode()]),
        "episode_metadata/recording_folderpath": ("bytes_list", [episode.recording_folderpath.encode()]),
        "steps/discount": ("float_list", np.ones(steps)),
        "steps/reward": ("float_list", last * float("/success/" in episode.file_path)),
        "steps/is_first": ("int64_list", first),
        "steps/is_last": ("int64_list", last),
        "steps/is_terminal": ("int64_list", last),
        **{f"steps/language_instruction{end}": ("bytes_list", [text] * steps) for end, text in texts.items()},
        **{f"steps/{name}": ("float_list", array.ravel()) for name, array in episode.arrays.items()},
        **{f"steps/observation/{camera}": ("bytes_list", images) for camera, images in episode.images.items()},
    }
