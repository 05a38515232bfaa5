"""Damaged files of every format: the damage raises an error, or has no effect."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accidents import mutated
from lerobot_sets import recorded, write_v21, write_v30
from recordings import write_raw_droid
from synthetic import draw_frame, synthetic_states, write_synthetic_droid
from tfrecords import index_records, read_record
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.data.sources.tfrecord import write_record
from vjepa2_ac.errors import InputError

MUTATIONS = int(os.environ.get("VJEPA2_AC_MUTATIONS", "40"))  # for each kind of file
STATES = synthetic_states(6)
FRAMES = np.stack([draw_frame(state, size=(36, 64)) for state in STATES])


def write(data_format: str, root: Path) -> DataConfig:
    """Write a data set and return its config."""
    if data_format.startswith("v"):
        episodes = [recorded(number, steps) for number, steps in enumerate((7, 9, 8))]
        (write_v30 if data_format == "v30" else write_v21)(root, episodes)
    elif data_format == "droid":
        write_synthetic_droid(root, steps=[2, 3, 2], size=(16, 32), shards=2)
    elif data_format == "raw":
        folder = root / "LAB/success/2023-07-07/one"
        write_raw_droid(
            folder, STATES, frames_by_serial={"1": FRAMES}, extrinsics={"1": STATES[:, :6]}, gop=3, b_frames=1
        )
    else:
        root.mkdir()
        save = np.savez if data_format == "npz" else np.savez_compressed
        save(
            root / "one.npz", states=STATES, frames=FRAMES, fps_hz=15.0, language="pick it up", extrinsics=STATES[0, :6]
        )
    source = {"v": "lerobot", "r": "droid_raw", "n": "npz", "d": "rlds"}[data_format[0]]
    cache = str(root / "dataset_info.json/none" if data_format == "droid" else root.parent / "cache")  # RLDS: no cache
    config = {"source": source, "path": str(root), "disk_cache": {"dir": cache}}
    return DataConfig.model_validate_json(json.dumps(config))


def read_all(config: DataConfig) -> dict[str, Any]:
    """Return (numbers, frames) or the error of each episode; fail on errors other than InputError."""
    source = open_source(config)
    try:
        infos = source.infos()
    except InputError as error:
        return {"the set": str(error)}
    contents: dict[str, Any] = {problem.name: f"{problem.where}: {problem.found}" for problem in infos.problems}
    for number, info in enumerate(infos):
        try:
            episode = source.read(number)
            assert episode.states.shape == (info.num_steps, 7)
            assert np.isfinite(episode.states).all()
            frames = episode.read_frames([0, info.num_steps // 2, info.num_steps - 1])
            assert frames.dtype == np.uint8
            velocities = None if episode.joint_velocities is None else episode.joint_velocities.tobytes()
            numbers = info.success, episode.states.tobytes(), velocities, episode.control_rate_hz
            contents[info.id] = numbers, frames.tobytes()
        except InputError as error:
            contents[info.id] = str(error)
    return contents


@pytest.mark.parametrize(
    ("data_format", "pattern", "num_equal"),
    [
        ("v30", "data/**/*.parquet", 2),
        ("v30", "meta/episodes/**/*.parquet", 2),
        ("v30", "videos/observation.images.exterior_1_left/**/*.mp4", 1),  # H.264 has no checksums
        ("v21", "data/**/*.parquet", 2),
        ("v21", "meta/*.json*", 2),
        ("raw", "**/trajectory.h5", 0),
        ("raw", "**/metadata_*.json", 0),
        ("raw", "**/1.mp4", 0),
        ("droid", "*.tfrecord-*", 2),
        ("droid", "dataset_info.json", 2),
        ("npz", "one.npz", 1),
        ("npz compressed", "one.npz", 1),
    ],
)
def test_random_damage_is_detected_or_harmless(data_format: str, pattern: str, num_equal: int, tmp_path: Path) -> None:
    root = tmp_path / "set"
    config, generator = write(data_format, root), np.random.default_rng(0)
    before, files, num_errors = read_all(config), sorted(root.glob(pattern)), 0
    assert not any(isinstance(content, str) for content in before.values())
    for number in range(MUTATIONS):
        path = files[int(generator.integers(len(files)))]
        data = path.read_bytes()
        path.write_bytes(mutated(data, generator))
        after = read_all(config)
        case = f"mutation {number}: {path.name}"
        num_extra = len(after) - len(before)  # bytes after the last record of an RLDS file are an additional problem
        assert "the set" in after or 0 <= num_extra <= (data_format == "droid"), (
            f"{case}: an episode was lost, or counted twice"
        )
        for name, content in after.items():
            if isinstance(content, str):
                assert str(root) in content or "data.lerobot" in content, f"{case}: {content}"
                num_errors += 1
            else:
                assert content[:num_equal] == before[name][:num_equal], f"{case}: {name} has changed"
        path.write_bytes(data)
    assert num_errors > MUTATIONS / 20


def test_damaged_record_with_valid_crc_never_crashes(tmp_path: Path) -> None:
    config, generator = write("droid", tmp_path / "set"), np.random.default_rng(2)
    file = sorted((tmp_path / "set").glob("*.tfrecord-*"))[0]
    first, *other_records = (read_record(span) for span in index_records(file))
    num_errors = 0
    for _ in range(MUTATIONS):
        with file.open("wb") as stream:
            for record in (mutated(first, generator), *other_records):
                write_record(stream, record)
        num_errors += any(isinstance(content, str) for content in read_all(config).values())
    assert num_errors > MUTATIONS / 4
