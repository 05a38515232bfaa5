"""A git-lfs pointer instead of a file raises an error with its path, in every format, locally and behind a URL."""

from pathlib import Path

import pytest

from copied_sets import STEPS, WRITERS
from gcs import Gcs
from lerobot_sets import recorded, write_v21
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.errors import InputError

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 12345678\n"
DATA_FORMATS = WRITERS | {
    "lerobot v2.1": lambda folder, numbers: write_v21(folder, [recorded(number, STEPS) for number in numbers])
}


def replace_by_pointers(folder: Path, pattern: str) -> Path:
    """Replace the files that match a pattern with git-lfs pointers."""
    files = [*folder.rglob(pattern)]
    assert files
    for file in files:
        file.write_bytes(POINTER)
    return folder


def config_of(data_format: str, path: str | Path, tmp_path: Path) -> DataConfig:
    source = data_format.split(maxsplit=1)[0]
    values = {"source": source, "path": str(path), "frames": 3, "stride": 2, "disk_cache": {"dir": str(tmp_path)}}
    return DataConfig.model_validate(values)


@pytest.mark.parametrize(
    ("data_format", "pattern"),
    [
        ("rlds", "*.tfrecord-*"),
        ("rlds", "*.tfrecord-00001-*"),
        ("rlds", "dataset_info.json"),
        ("lerobot", "info.json"),
        ("lerobot", "data/**/*.parquet"),
        ("lerobot", "meta/**/*.parquet"),
        ("lerobot", "*file-001.mp4"),
        ("lerobot v2.1", "episodes.jsonl"),
        ("npz", "*.npz"),
        ("droid_raw", "*.h5"),
        ("droid_raw", "*.mp4"),
        ("droid_raw", "metadata_*.json"),
    ],
)
def test_lfs_pointer_raises_when_the_data_set_is_opened(data_format: str, pattern: str, tmp_path: Path) -> None:
    folder = replace_by_pointers(DATA_FORMATS[data_format](tmp_path / "set", range(3)), pattern)
    with pytest.raises(InputError, match=r"a git-lfs pointer.*`git lfs pull`") as raised:
        open_dataset(config_of(data_format, folder, tmp_path / "cache"))
    path = raised.value.where.split(": ")[0]
    assert Path(path).read_bytes() == POINTER


@pytest.mark.parametrize(("data_format", "pattern"), [("rlds", "*.tfrecord-*"), ("lerobot", "*.mp4"), ("npz", "*.npz")])
def test_remote_lfs_pointer_raises(data_format: str, pattern: str, gcs: Gcs, tmp_path: Path) -> None:
    gcs.upload(replace_by_pointers(DATA_FORMATS[data_format](tmp_path / "set", range(3)), pattern), "robots/set")
    with pytest.raises(InputError, match=r"gs://robots/set/.*a git-lfs pointer"):
        open_dataset(config_of(data_format, "gs://robots/set", tmp_path / "cache"))
