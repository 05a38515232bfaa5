"""A run with compiled blocks has the same checkpoints as others, and is refused where it is impossible."""

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.model import compilation
from vjepa2_ac.training.loop import train


def test_a_run_that_nothing_can_compile_is_refused_before_anything_is_loaded(
    make_config, reporter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "missing_for_compilation", lambda kind: f"no compiler for {kind}")
    with pytest.raises(InputError, match=r"training.compile.*no compiler for cpu.*training.compile=off"):
        train(make_config(training__compile="blocks", data__path="nowhere"), reporter)
