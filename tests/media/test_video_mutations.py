"""Damaged recordings: the result is an episode or an error that names the file."""

import collections
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from recordings import write_raw_droid
from synthetic import draw_frame, synthetic_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.droid_raw.source import RawDroidSource
from vjepa2_ac.data.sources.npz import NpzSource
from vjepa2_ac.errors import InputError

STEPS = 6
STATES = synthetic_states(STEPS)
FRAMES = np.stack([draw_frame(state, size=(36, 64)) for state in STATES])
MUTATIONS = int(os.environ.get("VJEPA2_AC_MUTATIONS", "50"))  # of each kind of file; more in a longer run
FOLDER = "LAB/success/2023-07-07/one"
FILES = ("trajectory.h5", "metadata_one.json", "recordings/MP4/1.mp4")


def mutated(data: bytes, generator: np.random.Generator) -> bytes:
    """Return bytes after one accident: a flipped bit, a foreign, lost, repeated or blank stretch, an early end."""
    start = int(generator.integers(len(data)))
    end = min(len(data), start + int(2 ** generator.uniform(0, 12)))
    accident = generator.choice(["flip", "foreign", "lost", "twice", "blank", "cut"])
    middle = {
        "flip": bytes([data[start] ^ 1 << int(generator.integers(8))]) + data[start + 1 : end],
        "foreign": generator.bytes(end - start),
        "lost": b"",
        "twice": data[start:end] * 2,
        "blank": bytes([int(generator.choice([0, 255]))]) * (end - start),
        "cut": b"",
    }[str(accident)]
    return data[:start] + middle + (b"" if accident == "cut" else data[end:])


def outcome(source: RawDroidSource | NpzSource, file: str) -> str:
    """Read everything there is; return what came of it, having checked that an error names the file."""
    try:
        for index, info in enumerate(source.infos()):
            episode = source.read(index)
            assert episode.states.shape == (info.num_steps, 7)
            assert np.isfinite(episode.states).all()
            frames = episode.read_frames(range(info.num_steps))
            assert frames.dtype == np.uint8
            assert frames.shape[0] == info.num_steps
            if info.num_steps == STEPS and np.array_equal(frames, FRAMES) and np.array_equal(episode.states, STATES):
                return "unharmed"
    except InputError as error:
        return "named" if Path(file).name in str(error) else f"nameless: {error}"
    return "other"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / FOLDER
    return write_raw_droid(folder, STATES, pictures={"1": FRAMES}, extrinsics={"1": STATES[:, :6]}, gop=3)


@pytest.mark.parametrize("file", FILES)
def test_a_damaged_recording_is_read_or_named(recording: Path, tmp_path: Path, file: str) -> None:
    folder = shutil.copytree(recording, tmp_path / FOLDER)
    whole, generator = (recording / file).read_bytes(), np.random.default_rng(len(file))
    config = DataConfig(source="droid_raw", path=str(folder), disk_cache={"dir": str(tmp_path / "cache")})
    outcomes: collections.Counter[str] = collections.Counter()
    for _ in range(MUTATIONS):
        (folder / file).write_bytes(mutated(whole, generator))
        outcomes[outcome(RawDroidSource(config), file)] += 1
    assert set(outcomes) <= {"named", "unharmed", "other"}
    assert outcomes["named"] > MUTATIONS / 10, outcomes


@pytest.mark.parametrize("compressed", [False, True])
def test_a_damaged_archive_is_read_or_named(tmp_path: Path, compressed: bool) -> None:
    path, generator = tmp_path / "data/one.npz", np.random.default_rng(compressed)
    path.parent.mkdir()
    save = np.savez_compressed if compressed else np.savez
    save(path, states=STATES, frames=FRAMES, fps_hz=15.0, language="pick it up", extrinsics=STATES[0, :6])
    whole = path.read_bytes()
    config = DataConfig(source="npz", path=str(path.parent), disk_cache={"dir": str(tmp_path / "cache")})
    outcomes: collections.Counter[str] = collections.Counter()
    for _ in range(MUTATIONS):
        path.write_bytes(mutated(whole, generator))
        outcomes[outcome(NpzSource(config), "one.npz")] += 1
    assert set(outcomes) <= {"named", "unharmed", "other"}
    assert outcomes["named"] > MUTATIONS / 10, outcomes
