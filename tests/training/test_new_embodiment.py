"""A robot whose states or actions differ from the base model's: from recordings to a trained model."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from run_fixtures import KilledError, dying_reporter
from same_run import assert_same_run
from vector_sets import write_vectors
from vjepa2_ac.config import Config
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.export import export_run
from vjepa2_ac.model.world_model import get_model_widths
from vjepa2_ac.reports.metrics_json import metrics_as_dict
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.training.loop import train

MakeConfig = Callable[..., Config]
HEADS = ["action_encoder", "state_encoder"]
PROBES = ProbeOptions(ranking_clips=2, samples=4, landscape_clips=1, nodes=3, examples=1)
QUICK = EvaluationOptions(split="validation", clips=4, probes=PROBES)
ROBOTS = {"14/14": Widths(14, 14), "8/7": Widths(8, 7), "7/8": Widths(7, 8)}


@pytest.fixture
def make_robot(make_config: MakeConfig, tmp_path: Path) -> MakeConfig:
    """Return the config of a tiny run on a robot with some widths; the check of the base model is on."""

    def make(widths: Widths = ROBOTS["14/14"], **changes: object) -> Config:
        folder = tmp_path / f"set {widths.state} {widths.action}"
        if not folder.exists():
            write_vectors(folder, width=widths.state, action_width=widths.action)
        recorded = {"data__actions": "recorded", "data__join_actions": "sum"} if len(set(widths)) > 1 else {}
        values: dict[str, Any] = {
            "data__source": "npz", "data__path": str(folder), "data__states": "vector",
            "adapter__modules_to_save": HEADS, "training__allow_weak_base": False, **recorded,
        }  # fmt: skip
        return make_config(**(values | changes))

    return make


@pytest.mark.parametrize(("widths", "kind"), [(Widths(8, 7), "lora"), (Widths(14, 14), "none")], ids=str)
def test_new_robot_from_recordings_to_a_trained_model(
    make_robot: MakeConfig, reporter: Any, tmp_path: Path, widths: Widths, kind: str
) -> None:
    config = make_robot(widths, adapter__kind=kind, training__steps=2, validation__every=2)
    folder = train(config, reporter)
    fresh = [note for note in reporter.notes if "newly initialised" in note]
    assert len(fresh) == sum(width != 7 for width in widths)
    if widths.state != 7:
        assert f"New state encoder for {widths.state} numbers, newly initialised; the base model's has 7." in fresh
    assert any("skipped: the check that the base model is better than persistence" in note for note in reporter.notes)
    assert get_model_widths(load_subject(folder).world_model.sizes) == widths

    evaluation = evaluate_subject(str(folder), QUICK)
    assert list(evaluation.models) == ["adapter" if kind == "lora" else "model"]
    metrics = metrics_as_dict(evaluation)
    assert any("The base model is not compared" in note for note in metrics["notes"])
    assert metrics["base"] is None

    with pytest.raises(InputError, match=f"states of {widths.state} and actions of {widths.action} numbers"):
        export_run(folder, tmp_path / "official.pt", "official")


def test_resume_with_new_heads_is_bit_exact(make_robot: MakeConfig, reporter: Any, tmp_path: Path) -> None:
    full_options, stopped_options = (
        {"run_dir": str(tmp_path / name), "training__steps": 4} for name in ("whole", "stopped")
    )
    train(make_robot(**full_options), type(reporter)())

    with pytest.raises(KilledError):
        train(make_robot(**stopped_options), dying_reporter(type(reporter)(), 3))
    train(make_robot(**stopped_options), reporter)
    assert any(note.startswith("Resuming from") for note in reporter.notes)
    assert_same_run(tmp_path / "whole", tmp_path / "stopped")


def test_untrained_new_head_raises_before_the_model_is_loaded(
    make_robot: MakeConfig, reporter: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vjepa2_ac.training import setup

    monkeypatch.setattr(setup, "load_base", lambda *_, **__: pytest.fail("loaded"))
    with pytest.raises(InputError, match=r"Set adapter\.modules_to_save=\[action_encoder, state_encoder\]"):
        train(make_robot(adapter__modules_to_save=[]), reporter)
    with pytest.raises(InputError, match=r"data\.stride: auto, for states of 14"):
        train(make_robot(data__stride="auto"), reporter)


def test_vectors_of_width_7_keep_the_heads_and_the_base_model_check(
    make_robot: MakeConfig, reporter: Any, tmp_path: Path
) -> None:
    widths = Widths(7, 7)
    with pytest.raises(InputError, match="allow_weak_base"):
        train(make_robot(widths, adapter__modules_to_save=[]), reporter)
    assert [note for note in reporter.notes if "encoder of the base model is kept" in note]
    folder = train(make_robot(widths, training__allow_weak_base=True, training__steps=1), reporter)
    evaluation = evaluate_subject(str(folder), replace(QUICK, checkpoint="newest"))
    assert list(evaluation.models) == ["base", "adapter"]
    assert export_run(folder, tmp_path / "official.pt", "official").path.is_file()
