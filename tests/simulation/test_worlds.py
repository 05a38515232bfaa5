"""Worlds that others made: they are driven and recorded as they say, whatever they do wrong is one sentence."""

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

import fake_world
from paths import ROOT
from vjepa2_ac.cli import main
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.npz import NpzSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.model_setup import load_to_plan
from vjepa2_ac.simulation.benchmark import BenchmarkOptions
from vjepa2_ac.simulation.policies import ZeroActions
from vjepa2_ac.simulation.rollout import Image, Observation, Trial, run_trials
from vjepa2_ac.simulation.worlds import OtherWorld, find_trials, record_world, run_world_benchmark
from vjepa2_ac.storage.places import CLOSED_LOOP_FILE

SMALL = ["planning.samples=6", "planning.iterations=2", "planning.planner.options.elites=3"]


def command(how: str = "") -> str:
    return shlex.join([sys.executable, fake_world.__file__, how])


def test_a_model_and_those_without_one_act_on_the_problems_that_the_expert_solves(
    model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["simulate", model, "--world", command("sometimes hard"), "--episodes", "3", "--films", "1", "--all"]
    assert main([*given, "--sub-goals", "every-step", "--out", str(tmp_path), *SMALL]) == 0
    shown = capsys.readouterr().out
    assert "Come in fake 1.0: 3 problems of seed 0, 3 steps of 0.40 s" in shown
    found = json.loads((tmp_path / CLOSED_LOOP_FILE).read_text())
    assert (found["about"]["seeds"], found["about"]["left_out"]) == ([0, 2, 3], [1])
    assert list(found["policies"]) == ["tiny", "zero action", "random", "expert"]
    assert found["policies"]["expert"]["success"]["value"] == 1.0
    still = np.array(found["policies"]["zero action"]["by_episode"]["distance_cm"])
    assert (still == still[:, :1]).all()
    moved = np.array(found["policies"]["tiny"]["by_episode"]["distance_cm"])
    np.testing.assert_array_equal(moved[:, 0], still[:, 0])
    assert (np.abs(np.diff(moved, axis=1)) > 0.01).any()
    assert {path.name for path in tmp_path.iterdir()} == {CLOSED_LOOP_FILE, "closed_loop.mp4"}


def test_a_policy_that_knows_the_goal_reaches_it_in_any_world() -> None:
    class Homing(ZeroActions):
        def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
            self.place = fake_world.place_of(trial.seed)

        def _way(self, observation: Observation) -> np.ndarray:
            return np.append(self.place - observation.state[:3], np.zeros(4))

    with OtherWorld(command()) as world:
        trials, shown = find_trials(world, BenchmarkOptions(episodes=4, seed=5), 4)
        again, shown_again = find_trials(world, BenchmarkOptions(episodes=4, seed=5), 4)
        result = run_trials(world, Homing(), trials)
    assert result.success_rate.value == 1.0
    np.testing.assert_array_equal(shown.distance_cm, shown_again.distance_cm)
    assert [trial.seed for trial in trials.trials] == [trial.seed for trial in again.trials] == [5, 6, 7, 8]


def test_a_recording_is_a_data_set_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    with OtherWorld(command()) as world:
        assert record_world(world, tmp_path, range(2)) == (2, 2)
        first = {file.name: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
        assert record_world(world, tmp_path, range(4)) == (3, 3), "play solves nothing"
    assert {file.name: file.stat().st_mtime_ns for file in tmp_path.iterdir() if file.name in first} == first
    source = NpzSource(DataConfig.model_validate({"source": "npz", "path": str(tmp_path)}))
    episodes = [source.read(number) for number in range(4)]
    assert [episode.info.success for episode in episodes] == [True, True, False, True]
    assert {(episode.control_rate_hz, episode.metadata["language"]) for episode in episodes} == {(10.0, "come here")}
    for number, episode in enumerate(episodes):
        targets = np.load(tmp_path / f"Come_{number:06d}.npz")["actions"]
        assert len(targets) == len(episode.states) < fake_world.ABOUT["steps"] + 1
        assert (np.ptp(targets[:, :3], axis=0) > 0).any() == bool(number % 3), "one of three is the expert's alone"
        image = episode.read_frames([0])[0]
        assert image.shape == (24, 32, 3)
        assert image[..., 0].any()


@pytest.mark.parametrize(
    ("world", "said"),
    [
        ("nowhere/python world.py", "cannot be started: .*nowhere/python"),
        (f"{sys.executable} 'world.py", "cannot be started: No closing quotation"),
        (command("no such task"), "ended with status 1\nthere is no task of this name"),
        (command("chatty"), "wrote 'Welcome to my world!'. needed: a JSON object"),
        (command("no rate"), "rate_hz: "),
        (command("dies"), "ended with status 1\n(.*\n)*RuntimeError: the cube fell off the table"),
        (command("refuses"), "the arm is asleep"),
        (command("six numbers"), "state: 6 numbers in the shape \\(6,\\). needed: 7: x"),
        (command("no expert"), "fake 1.0 Come has no expert"),
        (command("hard"), "the expert solves 0 of 4 problems in 3 model steps. needed: half of them"),
    ],
)
def test_what_a_world_does_wrong_is_said(model: str, world: str, said: str) -> None:
    subject = load_to_plan(model, overrides=SMALL)
    with pytest.raises(InputError, match=said), OtherWorld(world) as opened:
        run_world_benchmark(subject, opened, BenchmarkOptions(episodes=2, films=0))


def test_options_of_our_arm_mean_nothing_in_a_world(model: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", model, "--world", command(), "--task", "reach"]) == 2
    assert "--task: simulate" in capsys.readouterr().err
    assert main(["simulate", model, "--world", command(), "--domain", "B"]) == 2
    assert "--domain: simulate" in capsys.readouterr().err
    assert main(["simulate", model, "--world-timeout", "5"]) == 2
    assert "--world-timeout: no --world" in capsys.readouterr().err
    assert main(["simulate", "record", "folder", "--world", command(), "--cameras", "3"]) == 2
    assert "a world has one camera" in capsys.readouterr().err


WORLDS = ("robosuite", "libero", "metaworld")


@pytest.mark.parametrize("name", WORLDS)
def test_pins_are_the_same_wherever_they_stand_and_programs_are_alone(name: str) -> None:
    places = {"Makefile": rf"WORLD_{name} := (.+)", "docs/worlds.md": rf"`{name}.py` \| `pip install ([^`]+)`"}
    places[f"examples/worlds/{name}.py"] = r"bin/pip install (.+)"
    pins = {place: re.findall(pattern, (ROOT / place).read_text()) for place, pattern in places.items()}
    assert len({tuple(found) for found in pins.values()}) == 1, pins
    text = (ROOT / f"examples/worlds/{name}.py").read_text()
    assert not re.search(r"^\s*(from|import) vjepa2_ac", text, flags=re.MULTILINE)


@pytest.mark.parametrize("name", WORLDS)
def test_a_real_world_is_driven_by_its_expert(name: str, tmp_path: Path) -> None:
    python = ROOT / "worlds" / name / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no environment of {name} (docs/worlds.md): make worlds/{name}")
    task = {"robosuite": ["Lift"], "libero": ["libero_object", "--near"], "metaworld": ["reach-v3"]}[name]
    words = shlex.join([str(python), str(ROOT / "examples" / "worlds" / f"{name}.py"), *task])
    with OtherWorld(words) as world:
        elsewhere, far = world.reset(seed=3, options={"stride": 4})
    with OtherWorld(words) as world:
        for _ in range(2):
            first, info = world.reset(seed=3, options={"stride": 4})
            np.testing.assert_array_equal(first.image, elsewhere.image)
            np.testing.assert_array_equal(first.state, elsewhere.state)
            assert info == far
        assert first.image.shape == (256, 256, 3)
        assert first.image.std() > 10
        assert record_world(world, tmp_path, range(1)) == (1, 1)
        for stride, up_m, least, most in ((4, 0.0, -0.02, 0.02), (15, 0.05, 0.03, 0.07)):
            before, _ = world.reset(seed=0, options={"stride": stride})
            after, *_ = world.step(up_m * np.eye(7)[2])
            assert least < after.state[2] - before.state[2] < most, "targets are metres in the base frame"
