"""Image strips at validation: predictions of base model and run; the run itself is unchanged."""

from pathlib import Path

import numpy as np
import pytest

from random_decoder import write_decoder
from run_fixtures import set_up
from same_run import assert_same_run
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.decoding import imagine
from vjepa2_ac.decoding.decoder import load_decoder
from vjepa2_ac.decoding.imagine import AS_RECORDED
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import read_image
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.validation import validate


@pytest.fixture
def decoder(tmp_path: Path, make_config) -> str:
    model = load_base(make_config().model, seed=0)
    assert isinstance(model, WorldModel)
    return str(write_decoder(tmp_path / "decoder", model))


def names(run: Path) -> list[str]:
    return sorted(path.name for path in (run / "imagined").iterdir())


STRIPS = ["step-00000000.png", "step-00000003.png", "step-00000006.png"]


@pytest.mark.usefixtures("drawn")
def test_run_with_image_strips_equals_a_run_without_bit_for_bit(
    make_config, reporter, whole_run, decoder, monkeypatch
) -> None:
    sent = []
    monkeypatch.setattr(MetricsLog, "log_image", lambda _, *args: sent.append(args))
    run = train(make_config(validation__decoder=decoder), reporter)
    assert_same_run(whole_run, run)
    assert names(run) == STRIPS
    assert [(kind, name, step) for kind, name, step, _ in sent] == [("validation", "imagined", n) for n in (0, 3, 6)]
    assert np.array_equal(read_image(run / "imagined" / STRIPS[1]), sent[1][3])
    assert not np.array_equal(sent[0][3][60:], sent[2][3][60:]), "training must change the predicted frames"


def test_strip_shows_the_clip_with_the_most_motion(make_config, reporter, decoder) -> None:
    run = set_up(make_config(validation__decoder=decoder), reporter)
    validate(run, reporter)
    assert run.image_strip is not None
    strip = run.image_strip.rollout(run.world_model, run.accelerator.device, "run")
    windows = validation_windows(run.dataset, "validation", clips=4)
    distances = {}
    for episode, start in windows:
        states = run.dataset.source.read(episode, None).states[start : start + run.dataset.config.clip_steps : 2, :3]
        distances[run.dataset.table.identity(episode), start] = np.linalg.norm(np.diff(states, axis=0), axis=1).sum()
    assert (strip.episode_id, strip.start) == max(distances, key=lambda name: distances[name])
    assert [(rollout.model, rollout.name, len(rollout.frames)) for rollout in strip.rollouts] == [
        ("base", AS_RECORDED, 3), ("current model", AS_RECORDED, 3),
    ]  # fmt: skip
    assert np.array_equal(strip.rollouts[0].frames, strip.rollouts[1].frames), (
        "a new adapter must not change predictions"
    )
    assert strip.truth is not None
    assert strip.truth.shape == (3, 32, 32, 3)


@pytest.mark.parametrize("failing", ["frames_for_display", "write_atomically"])
def test_failing_strip_causes_a_warning_and_the_run_continues(
    make_config, reporter, decoder, monkeypatch, caplog, failing: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(imagine, failing, fail)
    run_folder = train(make_config(validation__decoder=decoder, training__steps=3), reporter)
    assert list((run_folder / "checkpoints").iterdir())
    assert "could not be drawn ([Errno 28] No space left" in caplog.text


def test_unusable_validation_decoder_raises_before_expensive_work(
    make_config, reporter, decoder, tmp_path, monkeypatch
) -> None:
    other = write_decoder(tmp_path / "other", load_base(make_config().model, seed=0), encoder="other")
    monkeypatch.setattr("vjepa2_ac.training.setup.use_latent_cache", lambda *_, **__: pytest.fail("encodes"))
    for check_only in (False, True):
        with pytest.raises(InputError, match=r"validation\.decoder: .*other: the decoder does not fit the encoder"):
            train(make_config(validation__decoder=str(other)), reporter, check_only=check_only)
    monkeypatch.setattr("vjepa2_ac.training.setup.open_dataset", lambda *_, **__: pytest.fail("opens the data"))
    with pytest.raises(InputError, match=r"validation\.decoder: nowhere: no decoder\.json"):
        train(make_config(validation__decoder="nowhere"), reporter)
    assert load_decoder(decoder).where == "--decoder"
    assert not (tmp_path / "run").exists()
