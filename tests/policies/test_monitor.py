"""Held-out episodes give the threshold; an episode in which the picture breaks is noticed where it does."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.api import load_run, open_dataset
from vjepa2_ac.cli import main
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.policies.monitor import MONITOR, calibrate_monitor, watch_episodes

STRIDE = 2


@pytest.fixture(scope="module")
def dataset(data_folder: Path) -> Dataset:
    return open_dataset(data_folder, frames=4, stride=STRIDE, workers=0, validation_share=0.4, test_share=0.3)


def test_every_frame_is_predicted_from_the_one_before_it(whole_run: Path, dataset: Dataset) -> None:
    model = load_run(whole_run, device="cpu").world_model
    (found,) = watch_episodes(model, dataset, [2])
    episode = dataset.source.read(2)
    assert found.steps.tolist() == list(range(STRIDE, len(episode.states), STRIDE))
    assert found.errors.shape == (len(found.steps), model.num_tokens)
    usual = found.errors.mean(axis=0)
    scores = found.scores(usual)
    np.testing.assert_allclose(scores, np.maximum(found.errors - usual, 0).mean(axis=1), rtol=1e-6)
    by = calibrate_monitor(model, dataset, 0.3)
    for threshold, expected in ((scores.max(), None), (scores.max() - 1e-9, int(scores.argmax()))):
        assert found.first_alarm(replace(by, expected=tuple(usual), threshold=threshold)) == expected


def test_the_threshold_is_of_the_held_out_episodes_alone(whole_run: Path, dataset: Dataset) -> None:
    model = load_run(whole_run, device="cpu").world_model
    monitor = calibrate_monitor(model, dataset, 0.3)
    held_out = np.flatnonzero(dataset.members("validation") | dataset.members("test"))
    watched = list(watch_episodes(model, dataset, held_out.tolist()))
    np.testing.assert_allclose(monitor.expected, np.concatenate([one.errors for one in watched]).mean(axis=0))
    others = np.concatenate([one.errors for one in watched[1:]]).mean(axis=0)
    assert monitor.scores[0] == pytest.approx(watched[0].scores(others).max())
    assert monitor.threshold in monitor.scores


def test_the_command_notices_a_broken_picture_and_shows_where(
    whole_run: Path, dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode, data = dataset.source.read(1), tmp_path / "npz"
    data.mkdir()
    frames = episode.read_frames(range(len(episode.states)))
    np.savez(data / "good.npz", states=episode.states, frames=frames, fps_hz=15.0)
    noise = np.random.default_rng(0).integers(0, 256, frames[13:].shape, dtype=np.uint8)
    np.savez(data / "bad.npz", states=episode.states, frames=np.concatenate([frames[:13], noise]), fps_hz=15.0)
    (tmp_path / "today.yaml").write_text(
        f"run_dir: none\ndata: {{source: npz, path: {data}, frames: 4, stride: {STRIDE}, workers: 0}}\n"
        "model: {base: builtin:sim-tiny}\n"
    )
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    words = ["monitor", str(run), "--false-alarms", "0.4"]
    assert main([*words, "planning.views=2"]) == 2
    assert "planning.views: 2" in capsys.readouterr().err
    assert main(words) == 0
    assert json.loads((run / MONITOR).read_text())["false_alarms"] == 0.4
    watch = [*words, "--data", str(tmp_path / "today.yaml"), "--threshold", str(run), "--out", str(tmp_path / "out")]
    assert main([*watch, "--episode", "bad", "--episode", "good"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "first alarm" in said
    assert (tmp_path / "out/monitor.png").exists()
    assert main([*watch, "--episode", "none"]) == 2
    assert main([*words[:-1], "0.01"]) == 2
    assert "held-out episodes" in capsys.readouterr().err
