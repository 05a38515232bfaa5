"""The surprise of a frame, and the threshold with the promised rate of false alarms."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from decisions import QUICK, STATE, image
from tiny_models import tiny_model
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.policies.monitor import MONITOR, Monitor, conformal_threshold, surprise_of
from vjepa2_ac.serving.session import Session
from vjepa2_ac.serving.wire import pack, unpack


def written(folder: Path, threshold: float) -> str:
    known = tiny_model().fingerprints()
    usual = (0.0,) * tiny_model().num_tokens
    monitor = Monitor("vjepa2-ac monitor 1", threshold, 0.1, 8, (threshold,), usual, known.encoder, known.predictor)
    (folder / MONITOR).write_text(json.dumps(asdict(monitor)))
    return str(folder / MONITOR)


def acting(monitor: str | None, frames: int = 4, **changes: object) -> list:
    run = Controller(tiny_model(), QUICK.model_copy(update={"monitor": monitor, "horizon": 3, **changes}))
    run.reset(image(100))
    found = []
    for seed in range(frames):
        run.act(image(seed), STATE)
        found.append(run.decision)
    return found


@settings(max_examples=30)
@given(st.integers(19, 200), st.sampled_from([0.05, 0.1, 0.3]), st.integers(0, 1000))
def test_a_further_episode_is_above_the_threshold_as_often_as_promised(count: int, share: float, seed: int) -> None:
    drawn = torch.rand(count, generator=torch.Generator().manual_seed(seed))
    threshold = conformal_threshold(drawn, share)
    above = int((drawn > threshold).sum())
    assert above / (count + 1) <= share < (above + 2) / (count + 1)  # exactly k of n + 1 equally likely places


@pytest.mark.parametrize(("count", "share"), [(18, 0.05), (5, 0.1), (3, 0.0)])
def test_too_few_episodes_for_a_promise_are_refused(count: int, share: float) -> None:
    with pytest.raises(InputError, match=f"{count} held-out episodes"):
        conformal_threshold(torch.rand(count), share)


def test_the_score_is_what_patches_are_farther_off_than_usual() -> None:
    errors, usual = torch.zeros(2, 4), torch.tensor([1.0, 0.0, 0.0, 0.0])
    errors[0, 0], errors[1, 0], errors[1, 3] = 1.0, 3.0, 2.0  # in a patch that is often far off, and in a calm one
    assert surprise_of(errors, usual).tolist() == [0.0, 1.0]


def test_what_is_not_a_number_is_an_alarm(tmp_path: Path) -> None:
    monitor = Monitor.read(written(tmp_path, 9.0), tiny_model().fingerprints(), tokens=9, where="test")
    still = torch.zeros(9, 5)
    assert not monitor.compare(still, still).is_alarm
    assert monitor.compare(still, torch.full_like(still, float("nan"))).is_alarm


def test_what_the_last_decision_predicted_is_compared_with_what_is_seen(tmp_path: Path) -> None:
    first, second, *_ = acting(written(tmp_path, 1e6))
    assert first.surprise is None
    predicted, _ = first.cost.imagine(first.plan.actions[None, :1])
    expected = (predicted[0, 0] - second.cost.now[0]).abs().mean(dim=-1)
    np.testing.assert_allclose(second.surprise.errors, expected, rtol=1e-5)
    assert not second.surprise.is_alarm
    assert acting(written(tmp_path, 1e-6))[1].surprise.is_alarm
    assert all(one.surprise is None for one in acting(None))


def test_settings_and_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, 1.0)
    known = json.loads(Path(path).read_text())
    Path(path).write_text(json.dumps(known | {"predictor": "0" * 64}))
    with pytest.raises(InputError, match="another model"):
        acting(path)
    Path(path).write_text(json.dumps(known | {"threshold": None}))
    with pytest.raises(InputError, match="threshold"):
        acting(path)


def test_a_server_tells_an_alarm_in_its_answer_and_counts_it(tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"monitor": written(tmp_path, 1e-6)})
    session = Session(Controller(tiny_model(), config))
    answers = []
    for seed in range(2):
        asked = {"observation/image": image(seed), "observation/state": STATE, "goal/image": image(100)}
        answers.append(unpack(session.answer(pack(asked))))
    assert "surprise" not in answers[0]
    assert answers[1]["surprise"]["is_alarm"]
    assert any("departs" in note for note in answers[1]["notes"])
    assert session.counts.alarms == 1
    assert session.counts.surprise == answers[1]["surprise"]["score"]
