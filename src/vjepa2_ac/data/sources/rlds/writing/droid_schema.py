"""The features.json and dataset_info.json of a data set in DROID's schema.

Source: measured on files that TFDS wrote (names, types and layout; no code).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_TFDS = "tensorflow_datasets.core.features"


def droid_features(sizes: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    """Return features.json of DROID's schema, for images of these heights and widths."""
    position = {
        "cartesian_position": _tensor("float64", 6),
        "gripper_position": _tensor("float64", 1),
        "joint_position": _tensor("float64", 7),
    }
    velocity = {name.replace("position", "velocity"): value for name, value in position.items()}
    steps = {
        "action": _tensor("float64", 7),
        "action_dict": _group(position | velocity),
        "discount": _tensor("float32"),
        "reward": _tensor("float32"),
        **{f"is_{name}": _tensor("bool") for name in ("first", "last", "terminal")},
        **{f"language_instruction{suffix}": _text() for suffix in ("", "_2", "_3")},
        "observation": _group(position | {camera: _image(*size) for camera, size in sizes.items()}),
    }
    sequence = {
        "pythonClassName": f"{_TFDS}.dataset_feature.Dataset",
        "sequence": {"feature": _group(steps), "length": "-1"},
    }
    return _group(
        {"episode_metadata": _group({"file_path": _text(), "recording_folderpath": _text()}), "steps": sequence}
    )


def dataset_info(name: str, version: str, counts: Sequence[int], num_bytes: int) -> dict[str, Any]:
    """Return dataset_info.json of one `train` split with these numbers of episodes per shard."""
    split = {
        "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
        "name": "train",
        "numBytes": str(num_bytes),
        "shardLengths": [str(count) for count in counts],
    }
    return {"fileFormat": "tfrecord", "moduleName": "__main__", "name": name, "splits": [split], "version": version}


def _tensor(dtype: str, *shape: int) -> dict[str, Any]:
    kind = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    dimensions = {"dimensions": [str(size) for size in shape]} if shape else {}
    return {"pythonClassName": f"{_TFDS}.{kind}", "tensor": {"dtype": dtype, "encoding": "none", "shape": dimensions}}


def _text() -> dict[str, Any]:
    return {"pythonClassName": f"{_TFDS}.text_feature.Text", "text": {}}


def _image(height: int, width: int) -> dict[str, Any]:
    shape = {"dimensions": [str(height), str(width), "3"]}
    image = {"dtype": "uint8", "encodingFormat": "jpeg", "shape": shape}
    return {"pythonClassName": f"{_TFDS}.image_feature.Image", "image": image}


def _group(features: Mapping[str, Any]) -> dict[str, Any]:
    return {"pythonClassName": f"{_TFDS}.features_dict.FeaturesDict", "featuresDict": {"features": dict(features)}}
