"""What really happens stands beside what was imagined, where the data were simulated."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from decoders import whole_decoder  # noqa: F401 - a fixture
from run_fixtures import MakeConfig

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.decoding.imagine import AS_RECORDED
from vjepa2_ac.evaluation.imagined import Film, ImagineOptions, imagine_clip
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.simulation.imagined_truth import with_what_happens
from vjepa2_ac.simulation.recording.simulation_file import SIMULATION_FILE

STEPS = 3


@pytest.fixture
def film_of(base_folder: Path, whole_decoder: Path, make_config: MakeConfig, tmp_path: Path):  # noqa: F811
    def film(data: Path, *actions: str) -> Film:
        config = make_config(data__path=str(data), data__validation_share=0.0, data__test_share=0.5)
        evaluation = EvaluationOptions(data=config, out=tmp_path)
        asked = ImagineOptions(str(whole_decoder), actions=actions, steps=STEPS, evaluation=evaluation)
        return imagine_clip(str(base_folder), asked)

    return film


def test_of_simulated_data_the_truth_of_every_sequence_is_shown(simulated: Path, film_of) -> None:
    film = film_of(simulated, "true", "none", "up")
    found = with_what_happens(film).imagination
    truths = {one.name: one.truth for one in found.rollouts}
    np.testing.assert_array_equal(truths[AS_RECORDED], found.truth)
    for truth in truths.values():
        assert truth.shape == (STEPS, 32, 32, 3)
    still = np.abs(truths["none"].astype(int) - found.first).mean()
    moved = np.abs(truths["up"].astype(int) - found.first).mean()
    assert moved > 1.5 * still
    assert all("does not know this scene" in note for note in found.notes)  # the decoder is of other data
    for one, before in zip(found.rollouts, film.imagination.rollouts, strict=True):
        np.testing.assert_array_equal(one.frames, before.frames)


def test_if_it_cannot_be_simulated_again_a_note_says_why(simulated: Path, film_of, tmp_path: Path) -> None:
    data = shutil.copytree(simulated, tmp_path / "data")
    film = film_of(data, "up")
    (data / SIMULATION_FILE).write_text("{}")
    found = with_what_happens(film).imagination
    assert found.notes[-1].startswith("What really happens under other actions is not known: ")
    assert [one.truth for one in found.rollouts] == [None]
