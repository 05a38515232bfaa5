"""RLDS on Google Cloud Storage: read like local RLDS, with few bytes, over networks that fail."""

import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs import Gcs
from synthetic import write_synthetic_droid
from tfrecords import decode_example, index_records, read_record
from vjepa2_ac.config import DataConfig, RldsFields
from vjepa2_ac.data.sources.rlds.source import RldsSource
from vjepa2_ac.data.sources.rlds.tfrecord import encode_example, write_record
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError, UnreachableError

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


def in_any_order(folder: Path, target: Path, seed: int) -> Path:
    """Write a data set again with the features of every record in a drawn order, as TFDS leaves it to a hash."""
    target.mkdir()
    generator = np.random.default_rng(seed)
    for file in folder.iterdir():
        if ".tfrecord-" not in file.name:
            (target / file.name).write_bytes(file.read_bytes())
            continue
        with (target / file.name).open("wb") as stream:
            for span in index_records(file):
                features = decode_example(read_record(span))
                entries = [encode_example({name: features[name]}) for name in generator.permutation(list(features))]
                write_record(stream, joined(entries))
    return target


def joined(examples: list[bytes]) -> bytes:
    """Return one Example with the only feature of each, in this order."""

    def body(data: bytes) -> bytes:
        place = 1
        while data[place] >= 0x80:
            place += 1
        return data[place + 1 :]

    length, content, size = b"", b"".join(body(example) for example in examples), 0
    size = len(content)
    while size >= 0x80:
        length, size = length + bytes([size & 0x7F | 0x80]), size >> 7
    return b"\x0a" + length + bytes([size]) + content


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
@pytest.mark.parametrize("check_crc", ["once", "always"])
def test_what_is_read_from_afar_is_what_is_read_here(
    droid: Path, far: Callable[..., RldsSource], tmp_path: Path, order: str, check_crc: str
) -> None:
    folder = droid if order == "sorted" else in_any_order(droid, tmp_path / "any", seed=0)
    here, there = RldsSource(DataConfig(path=str(folder))), far(folder, check_crc=check_crc)
    assert list(there.infos()) == list(here.infos())
    assert not there.infos().problems
    for number in range(6):
        for camera in RldsFields().cameras:
            for _ in range(2):  # fetched, and kept
                assert same(there.read(number, camera), here.read(number, camera), [11, 0, 3])


def test_an_index_takes_one_small_read_for_each_episode_whose_names_come_first(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    source = far(droid)
    told: list[tuple[int, int]] = []
    assert len(source.infos(lambda done, total: told.append((done, total)))) == 6
    assert told == [(3, 6), (6, 6)]
    reads = gcs.reads("-of-00002")
    starts = {span.offset for shard in droid.glob("*.tfrecord-*") for span in index_records(shard)}
    of_index = [read for read in reads if read.sent == 1024]
    assert len(of_index) == 6
    assert {read.start for read in of_index} == starts
    gcs.forget()
    assert len(far(droid).infos()) == 6
    assert not gcs.reads("-of-00002")  # kept


def test_an_index_in_any_order_needs_few_reads(
    long: Path, far: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    folder = in_any_order(long, tmp_path / "any", seed=1)
    source = far(folder)
    here = RldsSource(DataConfig(path=str(folder)))
    assert list(source.infos()) == list(here.infos())
    record = index_records(next(folder.glob("*.tfrecord-*")))[0]
    assert gcs.bytes_read("-of-00001") < 4 * record.length / 2
    assert len(gcs.reads("-of-00001")) < 4 * 8 + 10


def test_shards_are_indexed_at_the_same_time(far: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path) -> None:
    folder = write_synthetic_droid(tmp_path / "set", episodes=24, steps=2, size=(16, 32), shards=24)
    source = far(folder)
    gcs.hold(12, match=r"/download/.*tfrecord")
    source.infos()
    assert gcs.most_in_flight >= 12  # of 24


def test_the_first_clip_of_an_episode_fetches_one_camera_and_later_ones_nothing(
    long: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    source = far(long)
    record = source.infos().locators["length"][1]
    gcs.forget()
    source.read(1).read_frames([0, 4, 8, 12])
    [*_, pictures] = sorted(read.sent for read in gcs.reads())
    assert 0.3 < pictures / record < 0.4
    assert gcs.bytes_read() - pictures <= 4 * (1 << 16)  # before, between and behind three cameras
    gcs.forget()
    for start in (0, 20, 60):
        source.read(1).read_frames(range(start, start + 16, 4))
    assert not gcs.requests
    source.read(1, "wrist_left").read_frames([0])
    assert 0.3 < gcs.bytes_read() / record < 0.4


def test_without_room_a_later_clip_fetches_its_frames_alone(
    long: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    source = far(long, limit_gb=0.0)
    record = source.infos().locators["length"][1]
    source.read(1).read_frames([0])
    gcs.forget()
    frames = source.read(1).read_frames(range(5, 75, 20))
    assert np.array_equal(frames, RldsSource(DataConfig(path=str(long))).read(1).read_frames(range(5, 75, 20)))
    assert 0 < gcs.bytes_read() / record < 0.1


def test_only_the_images_of_needed_steps_are_kept(
    long: Path, far: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    source = far(long)
    source.read(1, needed=[(10, 30)]).read_frames([12])
    kept = size_of(tmp_path / "cache" / "fetched")
    gcs.forget()
    source.read(1, needed=[(10, 30)]).read_frames([10, 29])
    assert not gcs.requests
    outside = source.read(1, needed=[(10, 30)]).read_frames([9, 30])
    assert np.array_equal(outside, RldsSource(DataConfig(path=str(long))).read(1).read_frames([9, 30]))
    assert len(gcs.reads()) in {1, 2}
    source.read(2).read_frames([12])
    assert kept < 0.5 * (size_of(tmp_path / "cache" / "fetched") - kept)


def size_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def test_neighbouring_frames_are_fetched_by_one_read(long: Path, far: Callable[..., RldsSource], gcs: Gcs) -> None:
    source = far(long, limit_gb=0.0)
    source.read(1).read_frames([0])
    episode = source.read(1)
    gcs.forget()
    episode.read_frames([20, 21, 22, 23])
    assert len(gcs.reads()) == 1


def test_a_damaged_entry_of_the_cache_is_fetched_again(
    long: Path, far: Callable[..., RldsSource], gcs: Gcs, tmp_path: Path
) -> None:
    source, here = far(long), RldsSource(DataConfig(path=str(long)))
    assert same(source.read(0), here.read(0), [3, 70])
    generator = np.random.default_rng(0)
    for file in (tmp_path / "cache").rglob("*"):
        if file.is_file() and file.suffix != ".index":
            data = bytearray(file.read_bytes())
            data[generator.integers(len(data))] ^= 4
            file.write_bytes(data)
    gcs.forget()
    assert same(source.read(0), here.read(0), [3, 70])
    assert gcs.requests
    gcs.forget()
    assert same(source.read(0), here.read(0), [3, 70])
    assert not gcs.requests


@pytest.mark.parametrize("failure", [503, 429, "reset", "cut", "short"])
def test_a_network_that_fails_now_and_then_changes_nothing(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs, failure: int | str
) -> None:
    source, here = far(droid), RldsSource(DataConfig(path=str(droid)))
    gcs.fail_next(failure, times=2, match=SHARD)
    assert list(source.infos()) == list(here.infos())
    gcs.fail_next(failure, times=2, match=SHARD)
    episode = source.read(2)
    gcs.fail_next(failure, times=2, match=SHARD)
    assert same(episode, here.read(2), [0, 5])
    assert gcs.faults_left == 0


def test_a_network_that_stays_away_is_named_and_breaks_no_episode(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    source = far(droid)
    gcs.fail_next(503, times=1000, match=SHARD)
    with pytest.raises(UnreachableError, match=r"gs://robots/droid/1\.0\.0/r2d2_faceblur-train\.tfrecord-"):
        source.infos()
    gcs.forget()
    source.infos()
    gcs.fail_next(503, times=1000, match=SHARD)
    with pytest.raises(UnreachableError, match="tfrecord-00000-of-00002"):
        source.read(0)
    gcs.forget()
    episode = source.read(0)
    gcs.fail_next(503, times=1000, match=SHARD)
    with pytest.raises(UnreachableError, match="tfrecord-00000-of-00002"):
        episode.read_frames([0])


def test_a_bucket_or_a_permission_that_is_missing_is_named(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    with pytest.raises(InputError, match="gs://nobody/droid does not exist"):
        RldsSource(DataConfig(path="gs://nobody/droid")).infos()
    source = far(droid)
    with pytest.raises(InputError, match=r"gs://robots/droid.*did you mean gs://robots/droid/1\.0\.0\?"):
        RldsSource(DataConfig(path="gs://robots/droid")).infos()
    gcs.fail_next(403, times=1000)
    with pytest.raises(UnreachableError, match=r"gs://robots/droid/1\.0\.0.*permission"):
        source.infos()


def test_a_shard_that_is_cut_costs_the_records_behind_the_cut(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    far(droid)
    shard = sorted(droid.glob("*.tfrecord-*"))[1]
    spans = index_records(shard)
    damaged = bytearray(shard.read_bytes()[: spans[2].offset + 500])
    damaged[spans[1].offset + 2] ^= 1  # in the length of the second
    for data, rows in ((damaged[: spans[2].offset + 500], 4), (shard.read_bytes()[: spans[2].offset + 500], 5)):
        gcs.put(f"robots/droid/1.0.0/{shard.name}", bytes(data))
        table = far(droid).infos()
        assert (len(table), len(table.problems)) == (rows, 6 - rows)
        assert all(shard.name in problem.where for problem in table.problems)


def test_what_no_length_tells_is_found_when_the_episode_is_read(
    spoiled: Callable[..., Path], far: Callable[..., RldsSource]
) -> None:
    def spoil(features: dict[str, tuple[Any, Any]]) -> None:
        features["steps/observation/cartesian_position"][1][8] = 900.0
        features["steps/observation/wrist_image_left"][1].pop()
        features["steps/observation/exterior_image_2_left"][1][4] = b"no picture"

    folder = spoiled(spoil)
    source = far(folder)
    table = source.infos()
    assert len(table) == 6
    assert source.read(1).info == table[1]
    with pytest.raises(InputError, match=r"record 0 .*step 1: .*within 5 m"):
        source.read(0)
    odd = far(folder, fields=RldsFields(state=("steps/action",)))
    with pytest.raises(InputError, match=r"wrist_image_left: 11 images.*12 steps"):
        odd.read(0, "wrist_left").read_frames([0])
    for _ in range(2):  # also where its neighbours are kept
        assert len(odd.read(0, "exterior_2_left").read_frames([3, 5])) == 2
        with pytest.raises(InputError, match=r"exterior_image_2_left: step 4: .*not a JPEG"):
            odd.read(0, "exterior_2_left").read_frames([3, 4])


def test_whole_records_are_fetched_and_checked_where_that_is_asked_for(
    droid: Path, far: Callable[..., RldsSource], gcs: Gcs
) -> None:
    source = far(droid, check_crc="always")
    shard = sorted(droid.glob("*.tfrecord-*"))[0]
    span = index_records(shard)[0]
    gcs.forget()
    source.infos()
    gcs.forget()
    source.read(0).read_frames([1])
    assert gcs.bytes_read() == span.length + 4
    damaged = bytearray(shard.read_bytes())
    damaged[span.end - 100] ^= 1
    gcs.put(f"robots/droid/1.0.0/{shard.name}", bytes(damaged))
    with pytest.raises(InputError, match="record 0 at byte 0: the CRC of the data does not match"):
        source.read(0)


def test_many_threads_and_another_process_read_the_same(long: Path, far: Callable[..., RldsSource], gcs: Gcs) -> None:
    source, here = far(long), RldsSource(DataConfig(path=str(long)))
    source.infos()
    gate = threading.Barrier(8)

    def read(number: int) -> bool:
        gate.wait()
        return same(source.read(number % 4), here.read(number % 4), [number, 60 + number])

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(read, range(8)))
    gcs.forget()
    assert same(pickle.loads(pickle.dumps(source)).read(3), here.read(3), [7, 67])  # noqa: S301 - our own bytes
    assert not gcs.requests
