"""Simulated outcomes of other actions: they start at the recorded state, and are shown next to predicted frames."""

import json
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from decoders import whole_decoder  # noqa: F401 - a fixture
from paths import ROOT
from projections import hand_pixel, pixel_of
from run_fixtures import MakeConfig
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.decoding.imagine import AS_RECORDED, RolloutComparison
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.imagined import ImagineOptions, imagine_clip
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.planning.counterfactual import make_named_actions
from vjepa2_ac.simulation.counterfactual import RECORDED_CAMERAS, Resimulation, resimulate, simulated_outcome
from vjepa2_ac.simulation.domains import DomainRanges
from vjepa2_ac.simulation.record import SIMULATION_FILE, RecordingSpec, record_dataset

STEPS, START, STRIDE = 13, 4, 4
FILMED = 3
SPECS = {
    "A": RecordingSpec("A", STEPS, seed=2),
    "push": RecordingSpec("A", STEPS, seed=2, task="push"),
    "three cameras": RecordingSpec("B", 5, seed=2, cameras=3),
    "random pick": RecordingSpec("random", STEPS, seed=2, task="pick"),
    "moving objects, push": RecordingSpec(DomainRanges(moving=3), STEPS, seed=2, task="push"),
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory):
    """Return a function that records a data set of two episodes, once."""
    root = tmp_path_factory.mktemp("sim")
    return cache(lambda name: record_dataset(root / name.replace(" ", "-"), SPECS[name], episodes=2))


def episode_of(folder: Path, index: int = 0) -> Episode:
    return RldsSource(DataConfig(path=str(folder))).read(index)


@pytest.fixture(params=["A", "moving objects, push"])
def start(request: pytest.FixtureRequest, recorded) -> Resimulation:
    folder = recorded(request.param)
    return resimulate(folder, episode_of(folder), START)


@pytest.mark.parametrize(
    ("name", "index"),  # of a task, episode 0 follows a script and 1 is play
    [("A", 0), ("push", 0), ("three cameras", 1), ("random pick", 1), ("moving objects, push", 1)],
)
def test_resimulation_equals_recorded_states_and_images(name: str, index: int, recorded) -> None:
    cameras = RECORDED_CAMERAS if SPECS[name].cameras == 3 else ["exterior_1_left"]
    for camera in cameras:
        source = RldsSource(DataConfig(path=str(recorded(name)), camera=tuple(cameras)))
        episode = source.read(index, camera)
        for step in (0, len(episode.states) - 1):
            outcome = resimulate(recorded(name), episode, step, camera).simulate(np.zeros((0, 7)), STRIDE)
            np.testing.assert_allclose(outcome.states[0], episode.states[step], atol=1e-6, rtol=0)
            np.testing.assert_array_equal(outcome.frames[0], episode.read_frames([step])[0])


def test_named_actions_move_the_hand_in_their_direction(start: Resimulation) -> None:
    names = ("none", "up", "down", "left", "right")
    none, up, down, left, right = (start.simulate(make_named_actions(name, 2), STRIDE) for name in names)
    assert down.states[-1, 2] < none.states[-1, 2] - 0.001  # in `push` it is at the table already
    assert up.states[-1, 2] - none.states[-1, 2] > 0.08
    assert left.states[-1, 1] - right.states[-1, 1] > 0.15
    assert np.abs(left.states[-1, [0, 2]] - right.states[-1, [0, 2]]).max() < 0.01
    arm = start.arm
    pixels = {
        name: hand_pixel(arm, simulated_outcome.states[-1])
        for name, simulated_outcome in (("none", none), ("up", up), ("left", left))
    }
    assert pixels["up"][1] < pixels["none"][1] - 8
    across = pixel_of(arm, none.states[-1, :3] + [0, 0.05, 0])[0] - pixel_of(arm, none.states[-1, :3])[0]
    assert (pixels["left"][0] - hand_pixel(arm, right.states[-1])[0]) * np.sign(across) > 15
    for name, outcome in (("up", up), ("left", left)):  # what moved there is the hand
        x, y = pixels[name].astype(int)
        assert outcome.silhouettes[-1][y, x]
        changed = np.abs(outcome.frames[-1].astype(int) - none.frames[-1])
        assert changed[y - 2 : y + 3, x - 2 : x + 3].mean() > changed.mean() + 10


def test_resimulation_starts_at_recorded_state_and_outcomes_are_independent(start: Resimulation) -> None:
    first = start.simulate(make_named_actions("forward", 1), STRIDE)
    start.simulate(make_named_actions("down", 2), STRIDE)
    repeated = start.simulate(make_named_actions("forward", 1), STRIDE)
    assert first.frames.shape == (2, 180, 320, 3)
    np.testing.assert_array_equal(first.frames, repeated.frames)
    np.testing.assert_array_equal(first.states, repeated.states)


def test_resimulating_other_data_raises(recorded, droid: Path) -> None:
    recorded_episode = episode_of(recorded("A"))
    for episode, step, camera, message in (
        (episode_of(droid), 0, "exterior_1_left", "an unknown episode"),
        (recorded_episode, STEPS, "exterior_1_left", "Expected 0 to 12"),
        (recorded_episode, 0, "front", "one of exterior_1_left"),
    ):
        with pytest.raises(InputError, match=message):
            resimulate(recorded("A"), episode, step, camera)


def test_docs_example_runs(recorded, capsys: pytest.CaptureFixture[str]) -> None:
    examples = re.findall(r"```py\n(.*?)```", (ROOT / "docs/planning_reference.md").read_text(), flags=re.DOTALL)
    (example,) = (text for text in examples if "resimulate" in text)
    exec(example.replace("data/sim", str(recorded("A"))), {})  # noqa: S102 - our own page
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["none", "up", "left", "close"]


def test_resimulating_a_changed_recording_raises(recorded, tmp_path: Path) -> None:
    episode = episode_of(recorded("A"))
    moved = replace(episode, states=episode.states + 1e-3)
    with pytest.raises(InputError, match=r"control step 4: .*the resimulated state differs by up to 0\.001"):
        resimulate(recorded("A"), moved, START)
    values = json.loads((recorded("A") / SIMULATION_FILE).read_text())
    values["domain"]["lag_s"] = 0.2
    (tmp_path / SIMULATION_FILE).write_text(json.dumps(values))
    with pytest.raises(InputError, match=r"the resimulated state differs.*simulation\.json names"):
        resimulate(tmp_path, episode, START)


@pytest.fixture
def compare_rollouts(base_folder: Path, whole_decoder: Path, make_config: MakeConfig, tmp_path: Path):  # noqa: F811
    def film(data: Path, *actions: str) -> RolloutComparison:
        config = make_config(data__path=str(data), data__validation_share=0.0, data__test_share=0.5)
        evaluation = EvaluationOptions(data=config, out=tmp_path)
        options = ImagineOptions(str(whole_decoder), actions=actions, steps=FILMED, evaluation=evaluation)
        return imagine_clip(str(base_folder), options, simulate=simulated_outcome)

    return film


def test_imagine_shows_simulated_truth_for_simulated_data(simulated: Path, compare_rollouts) -> None:
    comparison = compare_rollouts(simulated, "true", "none", "up")
    truths = {rollout.name: rollout.truth for rollout in comparison.rollouts}
    np.testing.assert_array_equal(truths[AS_RECORDED], comparison.truth)
    for truth in truths.values():
        assert truth.shape == (FILMED, 32, 32, 3)
    still = np.abs(truths["none"].astype(int) - comparison.first).mean()
    moved = np.abs(truths["up"].astype(int) - comparison.first).mean()
    assert moved > 1.5 * still
    assert all("compared with" in note for note in comparison.notes)  # the decoder is of other data
    assert {rollout.name for rollout in comparison.rollouts if rollout.outlines is not None} == {"none", "up"}


def test_failed_resimulation_gives_a_note(simulated: Path, compare_rollouts, tmp_path: Path) -> None:
    data = shutil.copytree(simulated, tmp_path / "data")
    (data / SIMULATION_FILE).write_text("{}")
    comparison = compare_rollouts(data, "up")
    assert comparison.notes[-1].startswith("The true outcome of other actions was not simulated: ")
    assert [rollout.truth for rollout in comparison.rollouts] == [None]
