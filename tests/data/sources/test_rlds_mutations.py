"""Randomly damaged RLDS files: read correctly or named; no garbage, no crash, no hang."""

import os
from collections import Counter
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest

from synthetic import write_synthetic_droid
from tfrecords import index_records, read_record
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.rlds.source import RldsSource
from vjepa2_ac.data.sources.rlds.tfrecord import write_record
from vjepa2_ac.errors import InputError

MUTATIONS = int(os.environ.get("VJEPA2_AC_MUTATIONS", "50"))  # of each kind; more in a longer run

Contents = dict[str, tuple[Any, ...]]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_droid(tmp_path_factory.mktemp("set") / "1.0.0", steps=[2, 3, 2], size=(16, 32), shards=2)


@pytest.fixture(scope="module")
def true(small: Path) -> Contents:
    source = RldsSource(DataConfig(path=str(small)))
    found = contents(source)
    assert len(found) == 3
    return found


def contents(source: RldsSource) -> Contents:
    """Return all that a source says of every episode; of one that cannot be read, the error."""
    found: Contents = {}
    for number, info in enumerate(source.infos()):
        try:
            episode = source.read(number)
            frames = episode.read_frames(range(info.num_steps))
            velocities = np.zeros(0) if episode.joint_velocities is None else episode.joint_velocities
            found[info.id] = (info, episode.states, velocities, frames, dict(episode.metadata))
        except InputError as error:
            found[info.id] = (error,)
    return found


def equal(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in zip(one, other, strict=True))


def mutated(data: bytes, generator: np.random.Generator) -> bytes:
    """Return bytes with one change of a random kind, at a random place."""
    place, length = int(generator.integers(len(data))), int(generator.integers(1, 64))
    other = int(generator.integers(len(data)))
    noise = generator.bytes(length)
    return [
        data[:place] + bytes([data[place] ^ 1 << int(generator.integers(8))]) + data[place + 1 :],
        data[:place] + noise + data[place + length :],
        data[:place] + bytes(length) + data[place + length :],
        data[:place],
        data[:place] + noise + data[place:],
        data[:place] + data[place + length :],
        data[:place] + data[other : other + length] + data[place + length :],
        data + noise,
        data[place:] + data[:place],
    ][int(generator.integers(9))]


def outcome(source: RldsSource, true: Contents, file: str) -> str:
    """Return what came of a damaged file, having seen that it is one of what is allowed."""
    refused = ""
    try:
        found, problems = contents(source), source.infos().problems
    except InputError as error:
        refused = str(error)
    if refused:
        assert file in refused or "shards are missing" in refused
        return "refused"
    named = [one for one in found.values() if len(one) == 1]
    for one in named:
        assert file in str(one[0])
    for name, one in found.items():
        assert len(one) == 1 or equal(one, true[name]), f"silent garbage in {name}"
    assert all(file in f"{problem.where} {problem.needed}" for problem in problems)
    if named or problems:
        return "named"
    assert found.keys() == true.keys()
    return "without effect"


@pytest.mark.parametrize("check_crc", ["once", "always"])
def test_a_damaged_shard_gives_right_data_or_is_named(
    small: Path, true: Contents, tmp_path: Path, check_crc: str
) -> None:
    generator = np.random.default_rng(["once", "always"].index(check_crc))
    folder, outcomes = copy_of(small, tmp_path), Counter[str]()
    shards = sorted(folder.glob("*.tfrecord-*"))
    for number in range(2 * MUTATIONS if check_crc == "once" else MUTATIONS):
        shard = shards[number % 2]
        whole = (small / shard.name).read_bytes()
        shard.write_bytes(mutated(whole, generator))
        outcomes[outcome(opened(folder, check_crc=check_crc), true, shard.name)] += 1
        shard.write_bytes(whole)
    assert outcomes["named"] > MUTATIONS / 2, outcomes


def test_a_damaged_description_gives_right_data_or_is_named(small: Path, true: Contents, tmp_path: Path) -> None:
    generator = np.random.default_rng(2)
    folder, outcomes = copy_of(small, tmp_path), Counter[str]()
    info = folder / "dataset_info.json"
    whole = info.read_bytes()
    for _ in range(MUTATIONS):
        info.write_bytes(mutated(whole, generator))
        outcomes[outcome(opened(folder), true, "dataset_info")] += 1
    assert outcomes["refused"] > MUTATIONS / 4, outcomes


def test_damage_under_a_right_crc_is_named_or_other_values_but_never_a_crash(small: Path, tmp_path: Path) -> None:
    """Somebody wrote nonsense and its checksum: nothing can tell other numbers from right ones."""
    generator = np.random.default_rng(3)
    folder, outcomes = copy_of(small, tmp_path), Counter[str]()
    shard = min(folder.glob("*.tfrecord-*"))
    first, *others = (read_record(span) for span in index_records(shard))
    for _ in range(MUTATIONS):
        with shard.open("wb") as file:
            for record in (mutated(first, generator), *others):
                write_record(file, record)
        found = contents(opened(folder))
        outcomes["named" if len(found) < 3 or any(len(one) == 1 for one in found.values()) else "other"] += 1
    assert outcomes["named"] > MUTATIONS / 4, outcomes


def test_damage_behind_a_url_is_named_or_other_values_but_never_a_crash(small: Path, tmp_path: Path) -> None:
    """Ranges have no CRC; what is checked is that all parts fit together."""
    generator = np.random.default_rng(4)
    memory, outcomes = fsspec.filesystem("memory"), Counter[str]()
    url = f"memory:/{tmp_path}"
    for file in small.iterdir():
        memory.pipe_file(f"{url}/{file.name}", file.read_bytes())
    shards = sorted(small.glob("*.tfrecord-*"))
    for number in range(MUTATIONS):
        shard = shards[number % 2]
        memory.pipe_file(f"{url}/{shard.name}", mutated(shard.read_bytes(), generator))
        outcomes[come_of(opened(url), shard.name)] += 1
        memory.pipe_file(f"{url}/{shard.name}", shard.read_bytes())
    assert outcomes.keys() <= {"named", "other"}
    assert outcomes["named"] > MUTATIONS / 4, outcomes


def come_of(source: RldsSource, file: str) -> str:
    try:
        found = contents(source)
    except InputError as error:
        return "named" if file in str(error) else f"nameless: {error}"
    return "other" if len(found) == 3 and not any(len(one) == 1 for one in found.values()) else "named"


def opened(folder: str | Path, **knobs: Any) -> RldsSource:
    """Open a data set that changes within the same moment: nothing may be kept of how it was."""
    return RldsSource(DataConfig(path=str(folder), disk_cache={"dir": str(Path(__file__) / "no folder")}, **knobs))


def copy_of(folder: Path, scratch: Path) -> Path:
    copy = scratch / "copy"
    copy.mkdir()
    for file in folder.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy
