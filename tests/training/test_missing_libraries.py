"""A missing library or compiler is reported in one line, with a fix, before anything is opened, fetched or computed."""

import re
import sys

import pytest

from vjepa2_ac.errors import InputError, UserError, pip_install
from vjepa2_ac.model import compilation
from vjepa2_ac.training.loop import train


@pytest.mark.parametrize(
    ("library", "key", "value", "extra"),
    [
        ("bitsandbytes", "training__optimizer", "adamw_8bit", "8bit"),
        ("wandb", "tracking__wandb", "offline", "wandb"),
        ("trackio", "tracking__trackio", True, "trackio"),
    ],
)
def test_missing_libraries_are_reported_before_mirror_or_data_are_opened(
    make_config, reporter, monkeypatch, library: str, key: str, value: object, extra: str
) -> None:
    for name in (library, f"{library}.optim"):
        monkeypatch.setitem(sys.modules, name, None)
    config = make_config(data__path="nowhere", checkpoint__remote="nothing://reads/this", **{key: value})
    with pytest.raises(UserError, match=rf"{library}.* is not installed.*{re.escape(pip_install(extra))}"):
        train(config, reporter)


def test_missing_compiler_raises_before_the_model_is_loaded(make_config, reporter, monkeypatch) -> None:
    monkeypatch.setattr(compilation, "describe_missing_compiler", lambda kind: f"no compiler for {kind}")
    with pytest.raises(InputError, match=r"training.compile.*no compiler for cpu.*training.compile=off"):
        train(make_config(training__compile="blocks", data__path="nowhere"), reporter)
