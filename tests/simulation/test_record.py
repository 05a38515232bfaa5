"""Recordings are read as DROID data, agree with the kinematics, move the block, and can be simulated again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from synthetic import measured_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, CameraPlacement, DomainRanges
from vjepa2_ac.simulation.motion import MotionRecipe
from vjepa2_ac.simulation.policies import play
from vjepa2_ac.simulation.record import (
    SIMULATION_FILE,
    RecordedSimulation,
    RecordingSpec,
    default_steps,
    episode_folder,
    read_simulation,
    record_dataset,
    record_episode,
)
from vjepa2_ac.simulation.tasks import arm_for

EPISODES, STEPS = 3, 5


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sim") / "B"
    return record_dataset(folder, RecordingSpec("B", STEPS, seed=3), episodes=EPISODES, shards=2)


def test_recorded_data_set_is_read_by_the_loader(recorded: Path) -> None:
    source = RldsSource(DataConfig(path=str(recorded)))
    infos = source.infos()
    assert [info.num_steps for info in infos] == [STEPS] * EPISODES
    assert len({info.id for info in infos}) == EPISODES
    expected = {}
    for index in range(EPISODES):
        episode = record_episode(index, RecordingSpec(DOMAIN_B, STEPS, 3))
        expected[f"{episode.recording_folderpath}--{episode.file_path}"] = episode
    for index, info in enumerate(infos):
        drawn, read = expected[info.id], source.read(index)
        np.testing.assert_allclose(read.states, measured_states(drawn), atol=1e-6)
        assert info.success is ("/success/" in drawn.file_path)


def test_same_seed_gives_same_bytes_with_any_number_of_workers(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("random", "socket"):  # as a user may call a script
        Path(f"{name}.py").write_text("open('RAN', 'w')")
    reported = []
    spec, options = RecordingSpec("B", STEPS, seed=3), {"episodes": EPISODES, "shards": 2, "workers": 2}
    repeated = record_dataset(tmp_path / "again", spec, **options, progress=lambda *state: reported.append(state))
    assert reported == [(done, EPISODES) for done in range(1, EPISODES + 1)]
    for file in sorted(recorded.iterdir()):
        assert file.read_bytes() == (repeated / file.name).read_bytes()
    assert not Path("RAN").exists()


def test_single_camera_image_is_repeated_and_three_cameras_differ() -> None:
    shared = record_episode(0, RecordingSpec(DOMAIN_A, 2, 0))
    three_cameras = record_episode(0, RecordingSpec(DOMAIN_A, 2, 0, cameras=3))
    assert len({tuple(images) for images in shared.images.values()}) == 1
    assert len({tuple(images) for images in three_cameras.images.values()}) == 3
    assert three_cameras.images["exterior_image_1_left"] == shared.images["exterior_image_1_left"]


def test_invalid_recording_options_raise_and_write_nothing(tmp_path: Path) -> None:
    for spec, episodes, wrong in (
        (RecordingSpec("A"), 0, "at least 1 episode"),
        (RecordingSpec("A", seed=-1), 1, "seed -1"),
        (RecordingSpec("Z"), 1, "one of A, B, or random"),
    ):
        with pytest.raises(InputError, match=wrong):
            record_dataset(tmp_path / "x", spec, episodes=episodes)
    assert not (tmp_path / "x").exists()


# With a block


def blocks_of(task: str, seed: int, *, script: bool, steps: int = 41) -> np.ndarray:
    positions, rng = [], np.random.default_rng(seed)
    play(arm_for(task, DOMAIN_A), task, steps, rng, script=script, on_step=lambda arm: positions.append(arm.block))
    return np.array(positions)


def test_scripted_episodes_and_random_play_move_the_block() -> None:
    pushed = blocks_of("push", 1, script=True)
    assert len(pushed) == 41
    assert np.linalg.norm(pushed[-1, :2] - pushed[0, :2]) > 0.08
    assert blocks_of("pick", 1, script=True)[-1, 2] > 0.10
    placed = blocks_of("place", 1, script=True, steps=default_steps("place"))
    assert placed[:, 2].max() > 0.08
    assert placed[-1, 2] < 0.035
    assert np.linalg.norm(placed[-1, :2] - placed[0, :2]) > 0.06
    played = [blocks_of("push", seed, script=False, steps=25) for seed in range(3)]
    distances = [np.linalg.norm(blocks[-1, :2] - blocks[0, :2]) for blocks in played]
    assert max(distances) > 0.05


def test_measured_states_follow_commands_repeated_for_a_model_step() -> None:
    motion = play(arm_for("push", DOMAIN_A), "push", 9, np.random.default_rng(0), script=False)
    for first in (0, 4):
        np.testing.assert_array_equal(motion.commanded_joints[first : first + 4], motion.commanded_joints[[first] * 4])
    assert (motion.commanded_joints[4] != motion.commanded_joints[3]).any()
    remaining = [np.abs(motion.commanded_joints[0] - motion.joints[step]).max() for step in range(4)]
    assert remaining[0] > remaining[1] > remaining[2] > remaining[3]


# The file that says how a data set was simulated

SPECS = [
    RecordingSpec("A", 5, seed=3),
    RecordingSpec("random", 5, seed=4, cameras=3),
    RecordingSpec(replace(DOMAIN_B, lag_s=0.1 + 0.2, camera=CameraPlacement(1 / 3, 20.0, 1.2)), 5, task="push"),
    RecordingSpec("B", 5, task="place"),
    RecordingSpec(DomainRanges(lag_s=(0.05, 0.06)), 5, recipe=MotionRecipe(drift_m=(0.0, 0.01, 0.0))),
]


def write_description(folder: Path, spec: RecordingSpec, **changes: Any) -> Path:
    (folder / SIMULATION_FILE).write_text(json.dumps(RecordedSimulation.of(spec, 2).as_dict() | changes))
    return folder


@pytest.mark.parametrize("spec", SPECS, ids=["A", "random", "task", "place", "recipe"])
def test_read_spec_equals_recorded_spec(tmp_path: Path, spec: RecordingSpec) -> None:
    read = read_simulation(write_description(tmp_path, spec))
    assert read == RecordedSimulation.of(spec, 2)
    assert (read.worlds, read.episodes) == (spec.worlds, 2)


def test_folder_without_simulation_file_raises(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"simulation\.json: no such file; .*Expected .*simulate record.*Record the data set again"
    ):
        read_simulation(tmp_path)


def test_episode_of_another_recording_raises(tmp_path: Path) -> None:
    simulation = read_simulation(write_description(tmp_path, RecordingSpec("A", 5)))
    name = record_name(RecordingSpec("A", 5), 1)
    assert simulation.number_of(name) == 1
    other_names = [record_name(RecordingSpec("A", 5), 2), record_name(RecordingSpec("A", 5, seed=1), 1)]
    other_names += [
        record_name(RecordingSpec("B", 5), 1),
        "/nfs/AUTOLab/success/2023-07-07/Fri_Jul__7_09:42:23_2023/x.h5",
    ]
    for other in other_names:
        with pytest.raises(InputError, match="an unknown episode"):
            simulation.number_of(other)


def record_name(spec: RecordingSpec, index: int) -> str:
    return f"{episode_folder(index, spec.seed, str(spec.domain))}/trajectory.h5"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps: .*greater than or equal to 2"),
        ({"ranges": {}}, "both or neither of the keys domain and ranges"),
        ({"domain": None}, "both or neither of the keys domain and ranges"),
        ({"task": "stack"}, "task: "),
    ],
)
def test_damaged_simulation_file_raises(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_simulation(write_description(tmp_path, RecordingSpec(DOMAIN_A, 5), **changes))
