"""Parquet bombs: a small file with huge content raises an error and is not decompressed beyond the limits."""

import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from paths import GOLDEN
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.files import EpisodeFiles
from vjepa2_ac.data.sources import parquet
from vjepa2_ac.data.sources.parquet import ParquetRows, read_table
from vjepa2_ac.errors import InputError

_MB = 1 << 20
STATE = "observation.state"


def repeated(value: str | bytes, rows: int) -> pa.Array:
    """Return a dictionary-encoded column of `rows` equal values, which stores the value once."""
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array([value]))


def test_repeated_texts_are_rejected_before_conversion_to_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tasks.parquet"
    lists = pa.ListArray.from_arrays(pa.array(np.arange(3001, dtype=np.int32)), repeated("x" * 100_000, 3000))
    pq.write_table(pa.table({"tasks": lists, "length": np.arange(3000)}), path, compression="zstd")
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(parquet, "MAX_TABLE_BYTES", 16 * _MB)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"tasks.parquet: more than 16,777,216 bytes of tasks, length"):
            read_table(str(path), str(path), lambda _: True)
        assert tracemalloc.get_traced_memory()[1] < 40 * _MB
    finally:
        tracemalloc.stop()
    assert read_table(str(path), str(path), lambda name: name == "length") == {"length": list(range(3000))}


@pytest.mark.parametrize(
    ("name", "message"),
    [("contradicting_footer", "Definition level histogram"), ("mistyped_footer", "ColumnMetaData type does not match")],
)
def test_inconsistent_footer_raises_without_aborting_the_process(name: str, message: str, tmp_path: Path) -> None:
    """Without the check, pyarrow 26 would abort the process when it reads the footer's entry of this column."""
    columns = ("frame_index", "timestamp", "observation.state.cartesian_position", "action.joint_velocity")
    with pytest.raises(InputError, match=rf"{name}\.parquet: the file is damaged: {message}"):
        rows_of(tmp_path, *columns).read_rows(str(GOLDEN / f"{name}.parquet"), 0)


def rows_of(path: Path, *columns: str) -> ParquetRows:
    return ParquetRows(
        EpisodeFiles(DataConfig(path="x", disk_cache={"dir": str(path), "limit_gb": 0.0})), columns or [STATE], ""
    )


def write(path: Path, rows: int, width: int = 7, row_group: int | None = None) -> Path:
    states = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(rows * width, np.float32)), width)
    pq.write_table(pa.table({"episode_index": np.zeros(rows, np.int64), STATE: states}), path, row_group_size=row_group)
    return path


def test_oversized_lists_are_rejected_from_the_footer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "rows.parquet", 10, width=70)
    assert rows_of(path).read_rows(str(path), 0)[STATE].shape == (10, 70)
    monkeypatch.setattr(parquet, "MAX_NUMBERS", 600)
    with pytest.raises(InputError, match=r"observation\.state.*: 700 numbers in a row group\. Expected at most 600"):
        rows_of(path).read_rows(str(path), 0)


def test_repeated_images_above_the_size_limit_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, image_bytes = tmp_path / "rows.parquet", b"\xff\xd8" + bytes(99_998)
    table = pa.table({"episode_index": np.repeat([0, 1], 50), "image": repeated(image_bytes, 100)})
    pq.write_table(table, path, compression="zstd")
    assert rows_of(path).read_images(str(path), "image", 1) == [image_bytes] * 50
    monkeypatch.setattr(parquet, "MAX_IMAGE_BYTES", 5 * _MB)
    with pytest.raises(InputError, match="more than 5,242,880 bytes of episode_index, image"):
        rows_of(path).read_images(str(path), "image", 1)
