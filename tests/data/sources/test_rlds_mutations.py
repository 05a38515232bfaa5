"""Randomly damaged RLDS files: read correctly or named; no garbage, no crash, no hang."""

import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest

from accidents import mutated
from synthetic import write_synthetic_droid
from tfrecords import index_records, read_record
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.data.sources.tfrecord import write_record
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


def outcome(source: RldsSource, file: str, true: Contents | None = None) -> str:
    """Return what came of a damaged file; the content that is not named is the true one, if that is given."""
    try:
        found, problems = contents(source), source.infos().problems
    except InputError as error:
        return "named" if file in str(error) or "shards are missing" in str(error) else f"nameless: {error}"
    errors = [str(one[0]) for one in found.values() if len(one) == 1]
    assert all(file in text for text in [*errors, *(f"{problem.where} {problem.needed}" for problem in problems)])
    for name, one in found.items() if true else ():
        assert len(one) == 1 or equal(one, true[name]), f"silent garbage in {name}"
    return "named" if errors or problems else "other"


@pytest.mark.parametrize("way", ["a shard", "the description", "a record under a right CRC", "behind a URL"])
def test_damage_is_named_or_other_values_under_a_right_crc_but_never_a_crash(
    small: Path, true: Contents, tmp_path: Path, way: str
) -> None:
    """Where a CRC is checked, what is not named is true. Ranges behind a URL have none: all parts fit together."""
    generator, outcomes, memory = np.random.default_rng(2), Counter[str](), fsspec.filesystem("memory")
    folder = shutil.copytree(small, tmp_path / "copy")
    files = sorted(folder.glob("dataset_info.json" if way == "the description" else "*.tfrecord-*"))
    for turn in range(MUTATIONS):
        file = files[turn % len(files)]
        whole = file.read_bytes()
        if way == "a record under a right CRC":
            first, *others = (read_record(span) for span in index_records(file))
            with file.open("wb") as stream:
                for record in (mutated(first, generator), *others):
                    write_record(stream, record)
        else:
            file.write_bytes(mutated(whole, generator))
        place = f"memory:/{folder}" if way == "behind a URL" else folder
        for one in folder.iterdir() if way == "behind a URL" else ():
            memory.pipe_file(f"{place}/{one.name}", one.read_bytes())
        is_checked = way in {"a shard", "the description"}
        outcomes[outcome(opened(place), file.stem, true if is_checked else None)] += 1
        file.write_bytes(whole)
    assert outcomes["named"] > MUTATIONS / 4, outcomes
    assert outcomes.keys() <= {"named", "other"}


def opened(folder: str | Path) -> RldsSource:
    """Open a data set that changes within the same moment: nothing may be kept of how it was."""
    return RldsSource(DataConfig(path=str(folder), disk_cache={"dir": str(Path(__file__) / "no folder")}))
