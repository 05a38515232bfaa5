"""A run with compiled blocks has the same checkpoints as others, and is refused where it is impossible."""

from pathlib import Path

import pytest
import torch

from same_run import trained_weights
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network import blocks, compilation
from vjepa2_ac.training.loop import train


def test_a_run_that_switches_compilation_on_and_off_is_the_run_that_never_did(
    make_config, reporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(blocks, "compiled", lambda function, **_: asked.append(function.__name__) or function)
    monkeypatch.setattr(compilation, "missing_for_compilation", lambda _: None)
    constant = {"training__schedule": "warmup_stable_decay"}
    train(make_config(run_dir=str(tmp_path / "plain"), **constant), reporter)
    assert not asked
    for steps, compile_ in [(2, "off"), (4, "blocks"), (6, "off")]:
        asked.clear()
        switched = {"run_dir": str(tmp_path / "switched"), "training__compile": compile_, "training__steps": steps}
        train(make_config(**switched, **constant), reporter, allow_config_change=True)
        assert bool(asked) == (compile_ == "blocks")
    expected, found = trained_weights(tmp_path / "plain"), trained_weights(tmp_path / "switched")
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_a_run_that_nothing_can_compile_is_refused_before_anything_is_loaded(
    make_config, reporter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "missing_for_compilation", lambda kind: f"no compiler for {kind}")
    with pytest.raises(InputError, match=r"training.compile.*no compiler for cpu.*training.compile=off"):
        train(make_config(training__compile="blocks", data__path="nowhere"), reporter)
