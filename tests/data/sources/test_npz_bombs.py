""".npz bombs: a small file with a huge stated size raises an error without being decompressed."""

import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.sources import npz
from vjepa2_ac.data.sources.npz import NpzSource
from vjepa2_ac.errors import InputError

STEPS = 20
ARRAYS = {
    "states": np.full((STEPS, 7), 0.3),
    "frames": np.zeros((STEPS, 8, 8, 3), np.uint8),
    "fps_hz": np.float64(15.0),
}
_MB = 1 << 20


def make_header(shape: tuple[int, ...], dtype: str, *, header_bytes: int | None = None) -> bytes:
    """Return the header of an array in version 1.0 of the format, or in version 2.0 with a stated header size."""
    text = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    if header_bytes is None:
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", header_bytes) + text


def write_bomb(path: Path, name: str, header: bytes, zeros: int, compression: int = zipfile.ZIP_DEFLATED) -> None:
    """Write an episode in which one array has this header and a content of this many zero bytes."""
    np.savez(path, **{key: value for key, value in ARRAYS.items() if key != name})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(zipfile.ZipInfo(f"{name}.npy"), header + bytes(zeros), compress_type=compression)


BOMBS: dict[str, tuple[Callable[[Path], None], str]] = {
    "too many numbers": (
        lambda path: write_bomb(path, "states", make_header((5_000_000, 7), "|u1"), 35_000_000),
        r"states: 35,000,000 numbers\. Expected at most 33,554,432",
    ),
    "too long text": (
        lambda path: write_bomb(path, "language", make_header((), f"<U{4 * _MB}"), 16 * _MB),
        r"language: a text of 16,777,216 bytes\. Expected at most 262,144",
    ),
    "too long header": (
        lambda path: write_bomb(path, "states", make_header((STEPS, 7), "<f8", header_bytes=32 * _MB), 32 * _MB),
        r"states: cannot be read \(an array in a format that numpy does not write",
    ),
    "unlimited compression": (
        lambda path: write_bomb(
            path,
            "frames",
            make_header((STEPS, 999, 999, 3), "|u1"),
            STEPS * 999 * 999 * 3,
            zipfile.ZIP_BZIP2,
        ),
        "frames: no such array",
    ),
    "fewer frames than stated": (
        lambda path: write_bomb(path, "frames", make_header((STEPS, 4_000_000, 4_000_000, 3), "|u1"), 1000),
        "frames: cannot be read .*does not match 1128 bytes",
    ),
    "rows without numbers": (
        lambda path: write_bomb(path, "states", make_header((1 << 40, 0), "<f8"), 0),
        r"states: shape \(1099511627776, 0\)",
    ),
}


def table_of(folder: Path) -> EpisodeTable:
    config = {"source": "npz", "path": str(folder), "disk_cache": {"dir": str(folder.parent / "cache")}}
    return NpzSource(DataConfig.model_validate(config)).infos()


@pytest.mark.parametrize("bomb", BOMBS)
def test_oversized_arrays_are_rejected_before_decompression(tmp_path: Path, bomb: str) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    np.savez(folder / "good.npz", **ARRAYS)
    build, message = BOMBS[bomb]
    build(folder / "bomb.npz")
    tracemalloc.start()
    try:
        table = table_of(folder)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    (problem,) = table.problems
    assert (problem.name, [info.id for info in table]) == ("bomb", ["good"])
    with pytest.raises(InputError, match=message):
        raise InputError(where=problem.where, found=problem.found, needed=problem.needed, fix=problem.fix)
    assert peak < 6 * _MB


def test_frames_above_the_compression_ratio_limit_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "_MAX_UNPACKED_BYTES", 1 << 20)
    folder = tmp_path / "set"
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 8, (STEPS, 150, 150, 3)).astype(np.uint8)
    np.savez_compressed(folder / "noisy.npz", **ARRAYS | {"frames": noise})
    np.savez(folder / "plain.npz", **ARRAYS | {"frames": noise * 0})
    np.savez_compressed(folder / "small.npz", **ARRAYS)
    write_bomb(folder / "bomb.npz", "frames", make_header((STEPS, 150, 150, 3), "|u1"), noise.nbytes)
    table = table_of(folder)
    (problem,) = table.problems
    assert ([info.id for info in table], problem.where) == (["noisy", "plain", "small"], f"{folder}/bomb.npz: frames")
    assert "bytes that unpack to 1,350,128; above 1,048,576 bytes the largest compression ratio is 100" in problem.found
