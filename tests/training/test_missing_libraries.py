"""A missing library is reported in one line, with a fix, before anything is opened, fetched or computed."""

import re
import sys

import pytest

from vjepa2_ac.cli import main
from vjepa2_ac.errors import UserError, pip_install
from vjepa2_ac.training.loop import train


@pytest.mark.parametrize(
    ("library", "knob", "value", "extra"),
    [
        ("bitsandbytes", "training__optimizer", "adamw_8bit", "8bit"),
        ("wandb", "tracking__wandb", "offline", "wandb"),
        ("trackio", "tracking__trackio", True, "trackio"),
    ],
)
def test_missing_libraries_are_reported_before_mirror_or_data_are_opened(
    make_config, reporter, monkeypatch, library: str, knob: str, value: object, extra: str
) -> None:
    for name in (library, f"{library}.optim"):
        monkeypatch.setitem(sys.modules, name, None)
    config = make_config(data__path="nowhere", checkpoint__remote="nothing://reads/this", **{knob: value})
    with pytest.raises(UserError, match=rf"{library}.* is not installed.*{re.escape(pip_install(extra))}"):
        train(config, reporter)


def needing(library: str):
    def handler(_options: object) -> int:
        __import__(library)
        return 0

    return handler


@pytest.mark.parametrize(("library", "extra"), [("simplejpeg", ""), ("msgpack", "serve"), ("h5py", "raw")])
def test_a_library_that_no_command_asks_for_is_named_in_one_line_with_its_extra(
    library: str, extra: str, monkeypatch, capsys, tmp_path
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.setattr("vjepa2_ac.cli.data._check", needing(library))
    assert main(["data", "check", str(tmp_path / "config.yaml")]) == 2
    assert capsys.readouterr().err == f"error: {library}: it is not installed. Run {pip_install(extra)}\n"


def test_a_part_of_this_program_that_is_gone_is_no_users_error(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("vjepa2_ac.cli.data._check", needing("vjepa2_ac.not_there"))
    with pytest.raises(ModuleNotFoundError):
        main(["data", "check", str(tmp_path / "config.yaml")])
