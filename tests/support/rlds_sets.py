"""RLDS data sets as third parties write them: any features, images in any encoding, and TFDS's two descriptions."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vjepa2_ac.data.sources.tfrecord import encode_example, write_record

Values = Mapping[str, Any]  # features of one record by name: list of bytes, or numbers


def encoded(image: np.ndarray, form: str = "PNG", mode: str | None = None) -> bytes:
    """Return an image as PNG or JPEG, converted to one of Pillow's modes if one is given."""
    file = io.BytesIO()
    picture = Image.fromarray(image)
    (picture if mode is None else picture.convert(mode)).save(file, form)
    return file.getvalue()


def write_rlds_set(folder: Path, records: Sequence[Values], features: Mapping[str, Any], *, name: str = "mine") -> Path:
    """Write records and their descriptions.

    Args:
        folder: Created.
        records: Features of each record.
        features: By name in a record: (dtype, shape) of a tensor, (dtype, shape, encoding) of an image, or "text".
        name: What the data set calls itself.
    """
    folder.mkdir(parents=True)
    with (folder / f"{name}-train.tfrecord-00000-of-00001").open("wb") as file:
        for record in records:
            write_record(file, encode_example({key: _typed(value) for key, value in record.items()}))
    split = {"name": "train", "shardLengths": [str(len(records))]}
    description = {"fileFormat": "tfrecord", "name": name, "version": "1.0.0", "splits": [split]}
    (folder / "dataset_info.json").write_text(json.dumps(description))
    (folder / "features.json").write_text(json.dumps(_nested(features)))
    return folder


def _typed(value: Any) -> tuple[Any, Any]:
    if isinstance(value, list):
        return "bytes_list", value
    numbers = np.asarray(value).ravel()
    if numbers.dtype.kind == "f":
        return "float_list", numbers.astype(np.float32)
    return "int64_list", numbers.astype(np.int64)


def _nested(features: Mapping[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, feature in features.items():
        *folders, last = name.split("/")
        node = tree
        for part in folders:
            node = node.setdefault(part, {})
        node[last] = feature
    return _described(tree)


def _described(tree: Any) -> dict[str, Any]:
    if isinstance(tree, dict):
        inner = {name: _described(subtree) for name, subtree in tree.items()}
        inner |= {"steps": {"sequence": {"feature": inner["steps"], "length": "-1"}}} if "steps" in inner else {}
        return {"featuresDict": {"features": inner}}
    if tree == "text":
        return {"text": {}}
    dtype, shape, *encoding = tree
    about = {"shape": {"dimensions": [str(size) for size in shape]}, "dtype": dtype}
    return {"image": {**about, "encodingFormat": encoding[0]}} if encoding else {"tensor": about}
