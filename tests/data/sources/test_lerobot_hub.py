"""Remote LeRobot data sets: at `hf://datasets/owner/name`, and in a bucket."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs import Gcs
from hub import Hub, serve_hub
from lerobot_sets import CAMERAS, STATE, Recorded, numbers_of, recorded, write_v21, write_v30
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.lerobot import LeRobotSource
from vjepa2_ac.errors import UnreachableError

LENGTHS = (12, 13, 14, 15, 16)


@pytest.fixture(scope="module")
def episodes() -> list[Recorded]:
    return [recorded(number, steps) for number, steps in enumerate(LENGTHS)]


@pytest.fixture(scope="module")
def folder(episodes: list[Recorded], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hub")
    write_v30(folder / "v30", episodes, episodes_per_video=1)
    write_v21(folder / "v21", episodes)
    write_v30(folder / "closed", episodes[:1])
    return folder


@pytest.fixture
def hub(folder: Path) -> Iterator[Hub]:
    names = {f"lab/{path.name}": path for path in folder.iterdir()}
    with serve_hub(names, gated={"lab/closed": "hf_right"}) as served:
        yield served


def source_of(name: str, cache: Path, **changes: Any) -> LeRobotSource:
    path = name if "://" in name else f"hf://datasets/lab/{name}"
    content = {"source": "lerobot", "path": path, "disk_cache": {"dir": str(cache)}} | changes
    return LeRobotSource(DataConfig.model_validate_json(json.dumps(content)))


@pytest.mark.parametrize("version", ["v30", "v21"])
def test_hub_data_set_equals_the_written_data_set(
    version: str, hub: Hub, episodes: list[Recorded], tmp_path: Path
) -> None:
    assert hub.url
    source = source_of(version, tmp_path)
    infos = source.infos()
    assert [info.num_steps for info in infos] == list(LENGTHS)
    assert not infos.problems
    for number in (3, 0, 4):
        episode = source.read(number, camera=CAMERAS[1])
        expected_states = np.concatenate([episodes[number].columns[name] for name in STATE], axis=1)
        np.testing.assert_array_equal(episode.states, expected_states.astype(np.float64))
        frames = episode.read_frames([7, 2, 11])
        assert [numbers_of(frame) for frame in frames] == [(number, step, 1) for step in (7, 2, 11)]


@pytest.mark.parametrize("version", ["v30", "v21"])
def test_bucket_data_set_equals_local_data_set(version: str, folder: Path, gcs: Gcs, tmp_path: Path) -> None:
    remote = source_of(gcs.upload(folder / version, f"robots/{version}"), tmp_path)
    local = LeRobotSource(DataConfig(source="lerobot", path=str(folder / version)))
    assert [info.id for info in remote.infos()] == [info.id for info in local.infos()]
    assert {request.object.split("/")[2] for request in gcs.reads()} == {"meta"}
    for number in (1, 4):
        np.testing.assert_array_equal(remote.read(number).states, local.read(number).states)
        frames = [source.read(number).read_frames([3, 9]) for source in (remote, local)]
        np.testing.assert_array_equal(*frames)
    gcs.fail_next(503, match="/download/.*mp4")
    gcs.fail_next("short", match="/download/.*mp4")
    remote.read(0).read_frames([2])
    assert gcs.faults_left == 0


def test_outcome_is_read_from_tables_or_rows(hub: Hub, tmp_path: Path) -> None:
    assert hub.url
    outcomes = [number % 3 != 2 for number in range(5)]
    assert [info.success for info in source_of("v30", tmp_path).infos()] == outcomes
    assert [info.success for info in source_of("v21", tmp_path).infos()] == [None] * 5
    assert [info.success for info in source_of("v21", tmp_path, outcome="success").infos()] == outcomes


def test_gated_data_set_raises_with_login_command(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hub.url
    for token in (None, "hf_wrong"):
        if token is not None:
            monkeypatch.setenv("HF_TOKEN", token)
        with pytest.raises(UnreachableError, match=r"hf://datasets/lab/closed.*hf auth login.*HF_TOKEN"):
            source_of("closed", tmp_path).infos()
    monkeypatch.setenv("HF_TOKEN", "hf_right")
    assert len(source_of("closed", tmp_path).infos()) == 1
