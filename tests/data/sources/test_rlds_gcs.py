"""RLDS on Google Cloud Storage: read like local RLDS, with few bytes, over networks that fail."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs import Gcs
from run_fixtures import Popen
from synthetic import write_synthetic_droid
from tfrecords import in_any_order
from vjepa2_ac.config import DataConfig, RldsFields
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.episode import Episode

SHARD = r"GET /download/.*tfrecord"
URL = "gs://robots/droid/1.0.0"


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of 80 steps in one shard, with the proportions of DROID: nearly all bytes are images."""
    return write_synthetic_droid(
        tmp_path_factory.mktemp("long") / "1.0.0", episodes=4, steps=80, size=(96, 160), shards=1
    )


@pytest.fixture
def far(gcs: Gcs, tmp_path: Path) -> Callable[..., RldsSource]:
    """Put a folder on the storage, once, and open it there with a cache of its own."""
    there: set[Path] = set()

    def put(folder: Path, **knobs: Any) -> RldsSource:
        if folder not in there:
            gcs.upload(folder, URL.removeprefix("gs://"))
            there.add(folder)
        disk_cache = {"dir": str(tmp_path / "cache"), "limit_gb": knobs.pop("limit_gb", 1.0)}
        return RldsSource(DataConfig(path=URL, disk_cache=disk_cache, **knobs))

    return put


def same(one: Episode, other: Episode, steps: list[int]) -> bool:
    assert one.joint_velocities is not None
    assert other.joint_velocities is not None
    return (
        one.info == other.info
        and one.metadata == other.metadata
        and np.array_equal(one.states, other.states)
        and np.array_equal(one.joint_velocities, other.joint_velocities)
        and np.array_equal(one.read_frames(steps), other.read_frames(steps))
    )


@pytest.mark.parametrize("order", ["sorted", "any"])
def test_what_is_read_from_afar_is_what_is_read_here(
    droid: Path, far: Callable[..., RldsSource], tmp_path: Path, order: str
) -> None:
    folder = droid if order == "sorted" else in_any_order(droid, tmp_path / "any", seed=0)
    here, there = RldsSource(DataConfig(path=str(folder))), far(folder)
    assert list(there.infos()) == list(here.infos())
    assert not there.infos().problems
    for number in range(6):
        for camera in RldsFields().cameras:
            for _ in range(2):  # fetched, and kept
                assert same(there.read(number, camera), here.read(number, camera), [11, 0, 3])


def test_an_index_reads_a_part_of_the_records_and_is_made_once(
    long: Path, far: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    folder = in_any_order(long, tmp_path / "any", seed=1)
    source, told = far(folder), list[tuple[int, int]]()
    assert list(source.infos(lambda *counts: told.append(counts))) == list(
        RldsSource(DataConfig(path=str(folder))).infos()
    )
    assert told[-1] == (4, 4)
    assert gcs.bytes_read("-of-00001") < next(folder.glob("*.tfrecord-*")).stat().st_size / 2
    gcs.forget()
    far(folder).infos()
    assert not gcs.reads("-of-00001")


READ_ALL = """
import sys
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.files import open_download_cache
from vjepa2_ac.data.sources.rlds import RldsSource

config = DataConfig(path=sys.argv[1], disk_cache={"dir": sys.argv[2], "limit_gb": float(sys.argv[3])})
for episode in map(int, sys.argv[4]):
    for camera in config.known_cameras:
        RldsSource(config).read(episode, camera).read_frames([0])
"""


def entry_sizes(cache: Path) -> list[int]:
    return [file.stat().st_size for file in (cache / "fetched").rglob("*") if file.is_file()]


def test_the_disk_cache_stays_within_its_limit_with_several_processes(
    long: Path, far: Callable[..., RldsSource], popen: Popen, tmp_path: Path
) -> None:
    unlimited = far(long)
    for episode in range(4):
        for camera in RldsFields().cameras:
            unlimited.read(episode, camera).read_frames([0])
    sizes, processes = entry_sizes(tmp_path / "cache"), 3
    limit = sum(sizes) // 2
    assert max(sizes) < limit / 4
    orders = ["0123", "2031", "1320"]
    readers = [
        popen([sys.executable, "-c", READ_ALL, URL, str(tmp_path / "limited"), str(limit / 1e9), order])
        for order in orders[:processes]
    ]
    assert [reader.wait(timeout=120) for reader in readers] == [0] * processes
    assert 0.5 * limit < sum(entry_sizes(tmp_path / "limited")) <= limit + processes * max(sizes)


@pytest.mark.parametrize("failure", [503, 429, "reset", "cut", "short"])
def test_a_network_that_fails_now_and_then_changes_nothing(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs, failure: int | str
) -> None:
    here = RldsSource(DataConfig(path=str(droid)))

    def failing(action: Callable[[], Any]) -> Any:
        gcs.fail_next(failure, times=2, match=SHARD)
        result = action()
        assert gcs.faults_left == 0, "both were met"
        return result

    assert failing(lambda: list(far(droid).infos())) == list(here.infos())
    source = far(droid, limit_gb=0.0)
    for _ in range(2):  # frames of the whole camera; then, their places known, each by itself
        episode = failing(lambda: source.read(2))
        assert failing(lambda episode=episode: same(episode, here.read(2), [0, 5]))


def test_a_later_clip_costs_its_frames_where_nothing_is_cached(
    far: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    folder = write_synthetic_droid(tmp_path / "large", episodes=1, steps=40, size=(720, 1280), shards=1)
    source = far(folder, limit_gb=0.0)
    source.read(0).read_frames([0])
    gcs.forget()
    source.read(0).read_frames(range(0, 40, 5))
    share = gcs.bytes_read("-of-00001") / next(folder.glob("*.tfrecord-*")).stat().st_size
    assert share < 1.5 * 8 / (3 * 40)
