"""The monitor's threshold has the requested false alarm rate, and a corrupted image raises an alarm."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from decisions import QUICK, STATE, image
from tiny_models import tiny_model
from vjepa2_ac.api import load_run, open_dataset
from vjepa2_ac.cli import main
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.policies.monitor import (
    MONITOR,
    Monitor,
    calibrate_monitor,
    compute_conformal_threshold,
    compute_surprise,
    measure_episodes,
)
from vjepa2_ac.serving.session import Session
from vjepa2_ac.serving.wire import pack, unpack

STRIDE = 2


@pytest.fixture(scope="module")
def dataset(data_folder: Path) -> Dataset:
    return open_dataset(data_folder, frames=4, stride=STRIDE, workers=0, validation_share=0.4, test_share=0.3)


def test_each_frame_is_predicted_from_the_previous_frame(whole_run: Path, dataset: Dataset) -> None:
    model = load_run(whole_run, device="cpu").world_model
    (measured,) = measure_episodes(model, dataset, [2])
    episode = dataset.source.read(2)
    assert measured.steps.tolist() == list(range(STRIDE, len(episode.states), STRIDE))
    assert measured.errors.shape == (len(measured.steps), model.num_tokens)
    usual = measured.errors.mean(axis=0)
    scores = measured.compute_scores(usual)
    np.testing.assert_allclose(scores, np.maximum(measured.errors - usual, 0).mean(axis=1), rtol=1e-6)
    monitor = calibrate_monitor(model, dataset, 0.3)
    for threshold, expected in ((scores.max(), None), (scores.max() - 1e-9, int(scores.argmax()))):
        assert measured.find_first_alarm(replace(monitor, expected=tuple(usual), threshold=threshold)) == expected


def test_threshold_uses_held_out_episodes_only(whole_run: Path, dataset: Dataset) -> None:
    model = load_run(whole_run, device="cpu").world_model
    monitor = calibrate_monitor(model, dataset, 0.3)
    held_out = np.flatnonzero(dataset.split_mask("validation") | dataset.split_mask("test"))
    measured = list(measure_episodes(model, dataset, held_out.tolist()))
    np.testing.assert_allclose(monitor.expected, np.concatenate([episode.errors for episode in measured]).mean(axis=0))
    usual = np.concatenate([episode.errors for episode in measured[1:]]).mean(axis=0)
    assert monitor.scores[0] == pytest.approx(measured[0].compute_scores(usual).max())
    assert monitor.threshold in monitor.scores


def test_monitor_command_detects_a_corrupted_image(
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
    check = [*words, "--data", str(tmp_path / "today.yaml"), "--threshold", str(run), "--out", str(tmp_path / "out")]
    assert main([*check, "--episode", "bad", "--episode", "good"]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "first alarm" in printed
    assert main([*check, "--episode", "none"]) == 2
    assert main([*words[:-1], "0.01"]) == 2
    assert "held-out episodes" in capsys.readouterr().err


# ---- surprise and threshold ----


def write_monitor(folder: Path, threshold: float) -> str:
    fingerprints = tiny_model().fingerprints()
    usual = (0.0,) * tiny_model().num_tokens
    monitor = Monitor(
        "vjepa2-ac monitor 1", threshold, 0.1, 8, (threshold,), usual, fingerprints.encoder, fingerprints.predictor
    )
    (folder / MONITOR).write_text(json.dumps(asdict(monitor)))
    return str(folder / MONITOR)


def run_controller(monitor: str | None, frames: int = 4, **changes: object) -> list:
    controller = Controller(tiny_model(), QUICK.model_copy(update={"monitor": monitor, "horizon": 3, **changes}))
    controller.reset(image(100))
    decisions = []
    for seed in range(frames):
        controller.act(image(seed), STATE)
        decisions.append(controller.decision)
    return decisions


@settings(max_examples=30)
@given(st.integers(19, 200), st.sampled_from([0.05, 0.1, 0.3]), st.integers(0, 1000))
def test_false_alarm_rate_is_at_most_the_requested_rate(count: int, share: float, seed: int) -> None:
    drawn = torch.rand(count, generator=torch.Generator().manual_seed(seed))
    threshold = compute_conformal_threshold(drawn, share)
    above = int((drawn > threshold).sum())
    assert above / (count + 1) <= share < (above + 2) / (count + 1)  # exactly k of n + 1 equally likely ranks


@pytest.mark.parametrize(("count", "share"), [(18, 0.05), (5, 0.1), (3, 0.0)])
def test_too_few_episodes_for_a_threshold_raise(count: int, share: float) -> None:
    with pytest.raises(InputError, match=f"{count} held-out episodes"):
        compute_conformal_threshold(torch.rand(count), share)


def test_surprise_is_the_mean_excess_over_the_usual_error() -> None:
    errors, usual = torch.zeros(2, 4), torch.tensor([1.0, 0.0, 0.0, 0.0])
    errors[0, 0] = 1.0  # equal to the usual error of the patch
    errors[1, 0], errors[1, 3] = 3.0, 2.0  # excess 2 in both patches
    assert compute_surprise(errors, usual).tolist() == [0.0, 1.0]


def test_nan_surprise_is_an_alarm(tmp_path: Path) -> None:
    monitor = Monitor.read(write_monitor(tmp_path, 9.0), tiny_model().fingerprints(), tokens=9, where="test")
    latents = torch.zeros(9, 5)
    assert not monitor.compare(latents, latents).is_alarm
    assert monitor.compare(latents, torch.full_like(latents, float("nan"))).is_alarm


def test_monitor_compares_the_last_prediction_with_the_current_frame(tmp_path: Path) -> None:
    first, second, *_ = run_controller(write_monitor(tmp_path, 1e6))
    assert first.surprise is None
    predicted, _ = first.cost.rollout(first.plan.actions[None, :1])
    expected = (predicted[0, 0] - second.cost.current[0]).abs().mean(dim=-1)
    np.testing.assert_allclose(second.surprise.errors, expected, rtol=1e-5)
    assert not second.surprise.is_alarm
    assert run_controller(write_monitor(tmp_path, 1e-6))[1].surprise.is_alarm
    assert all(decision.surprise is None for decision in run_controller(None))


def test_monitor_of_another_model_or_without_a_threshold_raises(tmp_path: Path) -> None:
    path = write_monitor(tmp_path, 1.0)
    content = json.loads(Path(path).read_text())
    Path(path).write_text(json.dumps(content | {"predictor": "0" * 64}))
    with pytest.raises(InputError, match="another model"):
        run_controller(path)
    Path(path).write_text(json.dumps(content | {"threshold": None}))
    with pytest.raises(InputError, match="threshold"):
        run_controller(path)


def test_server_reports_an_alarm_in_its_reply_and_counts_it(tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"monitor": write_monitor(tmp_path, 1e-6)})
    session = Session(Controller(tiny_model(), config))
    replies = []
    for seed in range(2):
        request = {"observation/image": image(seed), "observation/state": STATE, "goal/image": image(100)}
        replies.append(unpack(session.reply_to(pack(request))))
    assert "surprise" not in replies[0]
    assert replies[1]["surprise"]["is_alarm"]
    assert any("differs from the predicted frame" in note for note in replies[1]["notes"])
    assert session.counts.alarms == 1
    assert session.counts.surprise == replies[1]["surprise"]["score"]
