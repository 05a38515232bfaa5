"""Does TFDS itself read what we write, value for value?

    python benchmarks/tfds_reads.py --tfds-python /path/to/an/environment/bin/python [--path FOLDER]

That environment needs tensorflow-cpu and tensorflow-datasets; this project does not. Without a folder, a set of
synthetic episodes is written first. Exits with 1 when a feature differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

TFDS_SCRIPT = """
import hashlib, json, sys
import numpy as np
import tensorflow_datasets as tfds

def flat(values, prefix=""):
    for key, value in values.items():
        yield from flat(value, prefix + key + "/") if isinstance(value, dict) else [(prefix + key, value)]

def digest(column):
    if isinstance(column[0], bytes):
        return hashlib.sha256(b"|".join(column)).hexdigest()
    array = np.stack([np.asarray(value) for value in column])
    array = array if array.dtype == np.uint8 else array.astype(np.float64)
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()

for episode in tfds.builder_from_directory(sys.argv[1]).as_dataset(split="train", shuffle_files=False):
    columns = {"episode_metadata/" + key: [value.numpy()] for key, value in flat(episode["episode_metadata"])}
    for step in episode["steps"].as_numpy_iterator():
        for key, value in flat(step):
            columns.setdefault("steps/" + key, []).append(value)
    print(json.dumps({key: digest(column) for key, column in columns.items()}), flush=True)
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare every feature of every episode; print the differences and a count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tfds-python", required=True)
    parser.add_argument("--path", type=Path)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.path or write_synthetic(Path(scratch) / "set")
        command = [options.tfds_python, "-c", TFDS_SCRIPT, str(folder)]
        answer = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603 - the user's interpreter
        theirs = [json.loads(line) for line in answer.stdout.splitlines()]
        ours = [digests(record) for record in records(folder)]
    different = [
        f"episode {number}: {key}"
        for number, (one, other) in enumerate(zip(ours, theirs, strict=True))
        for key in sorted(one.keys() | other.keys())
        if one.get(key) != other.get(key)
    ]
    print("\n".join(different))
    print(f"{len(ours)} episodes of {len(ours[0])} features; {len(different)} differ from what TFDS reads")
    return 1 if different else 0


def write_synthetic(folder: Path) -> Path:
    """Write a few drawn episodes with the tests' own helper."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
    from synthetic import write_synthetic_droid

    return write_synthetic_droid(folder, episodes=6, steps=40, shards=2)


def records(folder: Path) -> list[dict[str, Any]]:
    """Return every record's features, in order."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
    from tfrecords import decode_example, index_set, read_record

    return [decode_example(read_record(span)) for span in index_set(folder)]


def digests(record: dict[str, Any]) -> dict[str, str]:
    """Return a hash of every feature's values, as `digest` in the script for TFDS makes it."""
    steps = len(record["steps/is_first"][1])
    return {key: digest(key, list(values), steps) for key, (_, values) in record.items()}


def digest(key: str, values: list[Any], steps: int) -> str:
    """Return the hash of one feature: pictures decoded, numbers as float64 (TFDS widens what is stored as float32)."""
    if "image" in key:
        pixels = np.stack([simplejpeg.decode_jpeg(value, fastdct=True) for value in values])
        return hashlib.sha256(pixels.tobytes()).hexdigest()
    if isinstance(values[0], bytes):
        return hashlib.sha256(b"|".join(values)).hexdigest()
    return hashlib.sha256(np.asarray(values, np.float64).reshape(steps, -1).tobytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
