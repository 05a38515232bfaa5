"""An automatic stride is chosen once, by the base model, and stored with the run."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import INDEXING
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.training.loop import train

Make = Callable[..., Config]


@pytest.fixture(autouse=True)
def candidates(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    strides = [2, 3]
    monkeypatch.setattr("vjepa2_ac.inspection.variants.candidate_strides", lambda _: strides)
    return strides


def test_auto_stride_is_chosen_once_and_stored(
    make_config: Make, reporter: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config(data__stride="auto", training__steps=2)
    folder = train(config, reporter)
    chosen = json.loads((folder / "calibration.json").read_text())["stride"]
    assert chosen in {2, 3}
    assert read_run_config(folder).data.stride == chosen
    assert any("Best stride" in note for note in reporter.notes)

    monkeypatch.setattr("vjepa2_ac.inspection.variants.calibrate_model", lambda *_: pytest.fail("chosen again"))
    second_reporter = type(reporter)()
    train(config, second_reporter)  # the same config, still with auto
    assert not [note for note in second_reporter.notes if "Best stride" in note]


def test_auto_stride_is_chosen_among_strides_that_fit_the_clips(
    make_config: Make, reporter: Any, candidates: list[int]
) -> None:
    # An episode of 24 steps contains a clip of 12 frames at stride 2 only, but a calibration clip (8 frames) also at 3.
    config = make_config(data__stride="auto", data__frames=12, training__steps=1)
    assert read_run_config(train(config, reporter)).data.stride == 2
    assert "  stride 3: not possible: no clip of 12 frames fits" in reporter.notes
    candidates.remove(2)
    with pytest.raises(InputError, match="shorter than a clip"):
        train(make_config(data__stride="auto", data__frames=12, run_dir="unused"), reporter)


def test_auto_stride_with_a_random_base_raises_before_indexing(make_config: Make, reporter: Any) -> None:
    config = make_config(data__stride="auto", model__base="random", model__sizes={}, adapter__kind="none")
    with pytest.raises(InputError, match=r"auto, with model\.base random.*Set data\.stride to a number"):
        train(config, reporter)
    assert INDEXING not in reporter.tasks
