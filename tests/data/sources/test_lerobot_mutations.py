"""Damaged LeRobot data sets: the damage is named, or has no effect."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lerobot_sets import recorded, write_v21, write_v30
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.lerobot.source import LeRobotSource
from vjepa2_ac.errors import InputError

LENGTHS = (7, 9, 8)
STEPS = (1, 4, 6)
MUTATIONS = 30  # of each kind of file; 5 kinds


@dataclass(frozen=True)
class Seen:
    """What a data set gave: its episodes, what was said of the others, or of all."""

    episodes: dict[str, tuple[object, ...]]
    frames: dict[str, bytes]
    errors: tuple[str, ...]

    @property
    def counted(self) -> int:
        return len(self.episodes.keys() | self.frames.keys()) + len(self.errors)


def seen(root: Path, cache: Path) -> Seen:
    """Read everything that a data set has; only InputError may be raised."""
    config = {"source": "lerobot", "path": str(root), "disk_cache": {"dir": str(cache)}}
    source = LeRobotSource(DataConfig.model_validate_json(json.dumps(config)))
    episodes: dict[str, tuple[object, ...]] = {}
    frames: dict[str, bytes] = {}
    try:
        infos = source.infos()
    except InputError as error:
        return Seen({}, {}, (str(error),) * len(LENGTHS))
    errors = [f"{problem.where}: {problem.found}" for problem in infos.problems]
    for number, info in enumerate(infos):
        try:
            episode = source.read(number)
        except InputError as error:
            errors.append(str(error))
            continue
        velocities = None if episode.joint_velocities is None else episode.joint_velocities.tobytes()
        content = (info.num_steps, info.success, episode.states.tobytes(), velocities, episode.control_rate_hz)
        try:
            frames[info.id] = episode.read_frames(STEPS).tobytes()
        except InputError as error:
            errors.append(str(error))
            continue
        episodes[info.id] = content
    return Seen(episodes, frames, tuple(errors))


def mutated(data: bytes, generator: np.random.Generator) -> bytes:
    """Return a file's content with a bit flipped, bytes overwritten, cut out or put in, or without its end."""
    at = int(generator.integers(len(data)))
    length = int(generator.integers(1, 9))
    other = generator.bytes(length)
    kind = generator.choice(["bit", "bit", "overwrite", "zero", "cut", "insert", "truncate"])
    if kind == "bit":
        return data[:at] + bytes([data[at] ^ 1 << int(generator.integers(8))]) + data[at + 1 :]
    if kind == "truncate":
        return data[:at]
    end = at if kind == "insert" else at + length
    new = {"overwrite": other, "zero": bytes(length), "cut": b"", "insert": other}[kind]
    return data[:at] + new[: len(data) - at if kind in {"overwrite", "zero"} else None] + data[end:]


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    episodes = [recorded(number, steps) for number, steps in enumerate(LENGTHS)]
    folder = tmp_path_factory.mktemp("sets")
    return {"v30": write_v30(folder / "v30", episodes), "v21": write_v21(folder / "v21", episodes)}


def check_mutations(
    root: Path, pattern: str, count: int, seed: int, folder: Path, check: Callable[[Seen, Seen, str], None]
) -> None:
    """Change files one at a time; every one is whole again afterwards."""
    root = Path(shutil.copytree(root, folder / "set"))
    before = seen(root, folder / "cache")
    assert not before.errors
    generator = np.random.default_rng(seed)
    files = sorted(root.glob(pattern))
    for number in range(count):
        path = files[int(generator.integers(len(files)))]
        data = path.read_bytes()
        path.write_bytes(mutated(data, generator))
        after = seen(root, folder / "cache")
        case = f"mutation {number} of seed {seed}: {path.relative_to(root)}"
        assert after.counted == len(LENGTHS), f"{case}: an episode was lost, or counted twice"
        for name, content in after.episodes.items():
            assert content == before.episodes[name], f"{case}: {name} is another"
        for error in after.errors:
            assert str(root) in error or "data.lerobot" in error, f"{case}: {error}"
        check(before, after, case)
        path.write_bytes(data)


def frames_are_equal(before: Seen, after: Seen, case: str) -> None:
    assert all(frames == before.frames[name] for name, frames in after.frames.items()), case


def nothing_more(*_: object) -> None:
    """H.264 has no checksums: most damage is an error of the decoder, some makes another frame."""


@pytest.mark.parametrize(
    ("version", "pattern", "check"),
    [
        ("v30", "data/**/*.parquet", frames_are_equal),
        ("v30", "meta/episodes/**/*.parquet", frames_are_equal),
        ("v21", "data/**/*.parquet", frames_are_equal),
        ("v21", "meta/*.json*", frames_are_equal),
        ("v30", "videos/observation.images.exterior_1_left/**/*.mp4", nothing_more),
    ],
)
def test_damage_is_named_or_does_not_matter(
    version: str,
    pattern: str,
    check: Callable[[Seen, Seen, str], None],
    sets: dict[str, Path],
    tmp_path: Path,
) -> None:
    check_mutations(sets[version], pattern, MUTATIONS, seed=0, folder=tmp_path, check=check)
