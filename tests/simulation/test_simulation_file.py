"""A recorded data set says how it was simulated; what it says gives its episodes again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, CameraPlace, DomainRanges

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.simulation.motion import MotionRecipe
from vjepa2_ac.simulation.record import (
    SIMULATION_FILE,
    RecordedSimulation,
    RecordingSpec,
    episode_folder,
    read_simulation,
    record_dataset,
    record_episode,
)

SPECS = [
    RecordingSpec("A", 5, seed=3),
    RecordingSpec("random", 5, seed=4, cameras=3),
    RecordingSpec(replace(DOMAIN_B, lag_s=0.1 + 0.2, camera=CameraPlace(1 / 3, 20.0, 1.2)), 5, task="push"),
    RecordingSpec("B", 5, task="place"),
    RecordingSpec(DomainRanges(lag_s=(0.05, 0.06)), 5, recipe=MotionRecipe(drift_m=(0.0, 0.01, 0.0))),
]


def written(folder: Path, spec: RecordingSpec, **changes: Any) -> Path:
    (folder / SIMULATION_FILE).write_text(json.dumps(RecordedSimulation.of(spec, 2).as_dict() | changes))
    return folder


@pytest.mark.parametrize("spec", SPECS, ids=["A", "random", "task", "place", "recipe"])
def test_the_spec_that_is_read_is_the_one_that_was_recorded(tmp_path: Path, spec: RecordingSpec) -> None:
    read = read_simulation(written(tmp_path, spec))
    assert read == RecordedSimulation.of(spec, 2)
    assert (read.worlds, read.episodes) == (spec.worlds, 2)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_dataset(tmp_path_factory.mktemp("sim") / "data", RecordingSpec("random", 2, 1), episodes=3, shards=2)


def test_the_file_gives_the_recorded_episodes_again(recorded: Path) -> None:
    source, simulation = RldsSource(DataConfig(path=str(recorded))), read_simulation(recorded)
    numbers = [simulation.number_of(info.id) for info in source.infos()]
    assert sorted(numbers) == [0, 1, 2]
    again = record_episode(numbers[1], simulation)
    assert f"{again.recording_folderpath}--{again.file_path}" == source.infos()[1].id


def test_a_folder_without_the_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"simulation\.json: no such file: .*needed: .*simulate record.*Record it again"
    ):
        read_simulation(tmp_path)


def test_episodes_of_others_are_refused(tmp_path: Path) -> None:
    simulation = read_simulation(written(tmp_path, RecordingSpec("A", 5)))
    ours = record_name(RecordingSpec("A", 5), 1)
    assert simulation.number_of(ours) == 1
    others = [record_name(RecordingSpec("A", 5), 2), record_name(RecordingSpec("A", 5, seed=1), 1)]
    others += [record_name(RecordingSpec("B", 5), 1), "/nfs/AUTOLab/success/2023-07-07/Fri_Jul__7_09:42:23_2023/x.h5"]
    for other in others:
        with pytest.raises(InputError, match="not the episode"):
            simulation.number_of(other)


def record_name(spec: RecordingSpec, index: int) -> str:
    return f"{episode_folder(index, spec.seed, str(spec.domain))}/trajectory.h5"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps: .*greater than or equal to 2"),
        ({"ranges": {}}, "not one of the keys domain and ranges"),
        ({"domain": None}, "not one of the keys domain and ranges"),
        ({"task": "stack"}, "task: "),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_simulation(written(tmp_path, RecordingSpec(DOMAIN_A, 5), **changes))
