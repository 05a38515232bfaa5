"""RLDS on Google Cloud Storage equals local RLDS, fetches few bytes, and survives network failures."""

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
def long_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of 80 steps in one shard, with the proportions of DROID: nearly all bytes are images."""
    return write_synthetic_droid(
        tmp_path_factory.mktemp("long") / "1.0.0", episodes=4, steps=80, size=(96, 160), shards=1
    )


@pytest.fixture
def open_remote(gcs: Gcs, tmp_path: Path) -> Callable[..., RldsSource]:
    """Return a function that uploads a folder once, and opens it behind a URL with a separate disk cache."""
    uploaded: set[Path] = set()

    def open_uploaded(folder: Path, **values: Any) -> RldsSource:
        if folder not in uploaded:
            gcs.upload(folder, URL.removeprefix("gs://"))
            uploaded.add(folder)
        disk_cache = {"dir": str(tmp_path / "cache"), "limit_gb": values.pop("limit_gb", 1.0)}
        return RldsSource(DataConfig(path=URL, disk_cache=disk_cache, **values))

    return open_uploaded


def are_equal(first: Episode, second: Episode, steps: list[int]) -> bool:
    assert first.joint_velocities is not None
    assert second.joint_velocities is not None
    return (
        first.info == second.info
        and first.metadata == second.metadata
        and np.array_equal(first.states, second.states)
        and np.array_equal(first.joint_velocities, second.joint_velocities)
        and np.array_equal(first.read_frames(steps), second.read_frames(steps))
    )


@pytest.mark.parametrize("order", ["sorted", "any"])
def test_remote_reads_equal_local_reads(
    droid: Path, open_remote: Callable[..., RldsSource], tmp_path: Path, order: str
) -> None:
    folder = droid if order == "sorted" else in_any_order(droid, tmp_path / "any", seed=0)
    local, remote = RldsSource(DataConfig(path=str(folder))), open_remote(folder)
    assert list(remote.infos()) == list(local.infos())
    assert not remote.infos().problems
    for number in range(6):
        for camera in RldsFields().cameras:
            for _ in range(2):  # first fetched, then read from the cache
                assert are_equal(remote.read(number, camera), local.read(number, camera), [11, 0, 3])


def test_remote_indexing_reads_record_parts_once(
    long_episodes: Path, open_remote: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    folder = in_any_order(long_episodes, tmp_path / "any", seed=1)
    source, progress_calls = open_remote(folder), list[tuple[int, int]]()
    assert list(source.infos(lambda *counts: progress_calls.append(counts))) == list(
        RldsSource(DataConfig(path=str(folder))).infos()
    )
    assert progress_calls[-1] == (4, 4)
    assert gcs.bytes_read("-of-00001") < next(folder.glob("*.tfrecord-*")).stat().st_size / 2
    gcs.forget()
    open_remote(folder).infos()
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


def test_disk_cache_stays_within_its_limit_with_several_processes(
    long_episodes: Path, open_remote: Callable[..., RldsSource], popen: Popen, tmp_path: Path
) -> None:
    unlimited = open_remote(long_episodes)
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
def test_intermittent_network_errors_do_not_change_results(
    droid: Path, open_remote: Callable[..., RldsSource], gcs: Gcs, failure: int | str
) -> None:
    local = RldsSource(DataConfig(path=str(droid)))

    def failing(action: Callable[[], Any]) -> Any:
        gcs.fail_next(failure, times=2, match=SHARD)
        result = action()
        assert gcs.faults_left == 0, "both failures occurred"
        return result

    assert failing(lambda: list(open_remote(droid).infos())) == list(local.infos())
    source = open_remote(droid, limit_gb=0.0)
    for _ in range(2):  # first all images of the camera; then, with known positions, single images
        episode = failing(lambda: source.read(2))
        assert failing(lambda episode=episode: are_equal(episode, local.read(2), [0, 5]))


def test_later_clip_without_cache_fetches_only_its_frames(
    open_remote: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    folder = write_synthetic_droid(tmp_path / "large", episodes=1, steps=40, size=(720, 1280), shards=1)
    source = open_remote(folder, limit_gb=0.0)
    source.read(0).read_frames([0])
    gcs.forget()
    source.read(0).read_frames(range(0, 40, 5))
    fraction = gcs.bytes_read("-of-00001") / next(folder.glob("*.tfrecord-*")).stat().st_size
    assert fraction < 1.5 * 8 / (3 * 40)
