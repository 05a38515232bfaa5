"""Recordings read back as DROID, are consistent with the kinematics, and are reproducible."""

from pathlib import Path

import numpy as np
import pytest

from synthetic import measured_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset, record_episode

EPISODES, STEPS = 3, 5


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sim") / "B"
    return record_dataset(folder, RecordingSpec("B", STEPS, seed=3), episodes=EPISODES, shards=2)


def test_the_loader_reads_what_was_recorded(recorded: Path) -> None:
    source = RldsSource(DataConfig(path=str(recorded)))
    infos = source.infos()
    assert [info.num_steps for info in infos] == [STEPS] * EPISODES
    assert len({info.id for info in infos}) == EPISODES
    expected = {}
    for index in range(EPISODES):
        episode = record_episode(index, RecordingSpec(DOMAIN_B, STEPS, 3))
        expected[f"{episode.recording_folderpath}--{episode.file_path}"] = episode
    for index, info in enumerate(infos):
        made, read = expected[info.id], source.read(index)
        np.testing.assert_allclose(read.states, measured_states(made), atol=1e-6)
        assert info.success is ("/success/" in made.file_path)


def test_the_images_show_the_measured_state(recorded: Path) -> None:
    source = RldsSource(DataConfig(path=str(recorded)))
    episode = source.read(0)
    arm = SimulatedArm(DOMAIN_B)
    for step in (0, STEPS - 1):
        arm.set_state(np.asarray(episode.states[step], dtype=np.float64))
        difference = np.abs(episode.read_frames([step])[0].astype(int) - arm.image())
        assert difference.mean() < 4.0  # JPEG, and the arm's spare degree of freedom


def test_the_same_seed_gives_the_same_bytes_in_any_number_of_processes(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("random", "socket"):  # as a user may call a script
        Path(f"{name}.py").write_text("open('RAN', 'w')")
    reported = []
    spec, how = RecordingSpec("B", STEPS, seed=3), {"episodes": EPISODES, "shards": 2, "workers": 2}
    again = record_dataset(tmp_path / "again", spec, **how, progress=lambda *state: reported.append(state))
    assert reported == [(done, EPISODES) for done in range(1, EPISODES + 1)]
    for file in sorted(recorded.iterdir()):
        assert file.read_bytes() == (again / file.name).read_bytes()
    assert not Path("RAN").exists()


def test_one_camera_is_shared_by_all_three_and_three_differ() -> None:
    shared = record_episode(0, RecordingSpec(DOMAIN_A, 2, 0))
    own = record_episode(0, RecordingSpec(DOMAIN_A, 2, 0, cameras=3))
    assert len({tuple(images) for images in shared.images.values()}) == 1
    assert len({tuple(images) for images in own.images.values()}) == 3
    assert own.images["exterior_image_1_left"] == shared.images["exterior_image_1_left"]


def test_impossible_numbers_and_unknown_domains_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    for spec, episodes, wrong in (
        (RecordingSpec("A"), 0, "at least 1 episode"),
        (RecordingSpec("A", seed=-1), 1, "seed -1"),
        (RecordingSpec("Z"), 1, "one of A, B, or random"),
    ):
        with pytest.raises(InputError, match=wrong):
            record_dataset(tmp_path / "x", spec, episodes=episodes)
    assert not (tmp_path / "x").exists()
