"""A small synthetic data set in DROID's schema, and copies with a changed record."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from synthetic import write_synthetic_droid
from tfrecords import decode_example, index_records, read_record
from vjepa2_ac.data.sources.tfrecord import encode_example, write_record

Features = dict[str, tuple[Any, Any]]


@pytest.fixture(scope="session")
def droid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes of 12 to 17 steps in two shards, with small images. Read only."""
    return write_synthetic_droid(
        tmp_path_factory.mktemp("droid") / "1.0.0", steps=range(12, 18), episodes=6, size=(48, 96), shards=2
    )


@pytest.fixture
def write_with_changed_record(droid: Path, tmp_path: Path) -> Callable[[Callable[[Features], None]], Path]:
    """Copy the data set, and change the features of the first record by a function; the CRC is correct."""

    def write_changed(change: Callable[[Features], None]) -> Path:
        folder = tmp_path / "changed"
        shutil.copytree(droid, folder)
        shard = sorted(folder.glob("*.tfrecord-*"))[0]
        records = [read_record(span) for span in index_records(shard)]
        features: Features = {name: (kind, list(values)) for name, (kind, values) in decode_example(records[0]).items()}
        change(features)
        with shard.open("wb") as file:
            for record in [encode_example(features), *records[1:]]:
                write_record(file, record)
        return folder

    return write_changed
