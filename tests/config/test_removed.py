"""Configs with keys of version 0.1: those of runs load, and a config of a user gets one plain error."""

import logging

import pytest

from vjepa2_ac.config.loading import all_keys, config_as_dict, parse_config
from vjepa2_ac.config.removed import REMOVED, RemovedKey
from vjepa2_ac.errors import InputError

VALUES = {"run_dir": "run", "data": {"source": "npz", "path": "data"}, "model": {"base": "builtin:sim-tiny"}}


@pytest.fixture(autouse=True)
def removed_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(REMOVED, "training.momentum", RemovedKey("0.9", (0.9,)))
    monkeypatch.setitem(REMOVED, "data.blur", RemovedKey("off", ({"radius": 0},)))


def test_removed_key_in_a_config_of_a_user_is_one_error_that_names_the_value_of_today() -> None:
    with pytest.raises(InputError, match=r"training.momentum: removed in 0.2; it is always 0.9 now. Delete the key"):
        parse_config({**VALUES, "training": {"momentum": 0.9}}, where="mine.yaml")


@pytest.mark.parametrize("value", [0.9, 0.5])
def test_config_of_an_older_run_loads_and_a_value_that_changed_is_a_warning(
    value: float, caplog: pytest.LogCaptureFixture
) -> None:
    older = {**VALUES, "training": {"momentum": value}}
    with caplog.at_level(logging.WARNING):
        config = parse_config(older, where="run/config.yaml", here=False)
    assert config == parse_config(VALUES, where="today")
    assert [record.getMessage() for record in caplog.records] == [
        "run/config.yaml: training.momentum was 0.5; this version always uses 0.9"
    ] * (value != 0.9)


def test_removed_section_of_data_is_dropped_from_replay_too() -> None:
    replay = {"data": {"source": "npz", "path": "other", "blur": {"radius": 0}}}
    older = {**VALUES, "data": {"source": "npz", "path": "data", "blur": {"radius": 0}}, "replay": replay}
    values = config_as_dict(parse_config(older, where="run/config.yaml", here=False))
    assert "blur" not in values["data"]
    assert "blur" not in values["replay"]["data"]


def test_no_removed_key_is_a_key_of_today() -> None:
    assert not set(REMOVED) & set(all_keys())
