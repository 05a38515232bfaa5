"""Opening a run: everything is checked before a folder is made, and the folder is held before anything goes into it."""

import os
from pathlib import Path

import pytest

from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs import open_run as opening
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.runs.folder import with_stride
from vjepa2_ac.runs.lock import RunLock
from vjepa2_ac.runs.mirror.background_sync import NoMirror
from vjepa2_ac.runs.open_run import open_run


def test_a_new_folder_is_made_and_locked_when_the_run_begins_and_not_before(make_config, reporter) -> None:
    config = make_config()
    folder = Path(config.run_dir)
    with open_run(config, reporter) as opened:
        assert not folder.exists()
        opened.begin(config, RunState(step=0, run_id="mine"))
        assert (folder / "config.yaml").read_text() == config_as_yaml(config)
        with pytest.raises(InputError, match=f"by process {os.getpid()}"):
            RunLock(folder).take()
        assert isinstance(opened.mirror("mine"), NoMirror)
    with RunLock(folder) as lock:
        lock.take()


def test_a_folder_that_is_there_is_locked_before_the_remote_is_asked(make_config, reporter, monkeypatch) -> None:
    config = make_config()
    with open_run(config, reporter) as opened:
        opened.begin(config, RunState(step=0))
    seen = []

    def remote(*_: object, **__: object) -> None:
        with pytest.raises(InputError, match="trained right now"):
            RunLock(Path(config.run_dir)).take()
        seen.append("locked")

    monkeypatch.setattr(opening, "open_remote", remote)
    with open_run(config, reporter):
        assert seen == ["locked"]


def test_a_check_locks_nothing_and_fetches_elsewhere(make_config, reporter, monkeypatch) -> None:
    config = make_config()
    with open_run(config, reporter) as opened:
        opened.begin(config, RunState(step=0))
    asked: dict[str, object] = {}
    monkeypatch.setattr(opening, "open_remote", lambda *_, **options: asked.update(options))
    with open_run(config, reporter, check_only=True):
        asked["claim"]()
        assert Path(config.run_dir) not in Path(asked["into"]).parents
        with RunLock(Path(config.run_dir)) as lock:
            lock.take()
    assert not Path(asked["into"]).parent.exists()


def test_the_stride_that_a_run_has_chosen_is_the_one_of_its_next_start(make_config, reporter) -> None:
    config = make_config(data__stride="auto")
    with open_run(config, reporter) as opened:
        assert opened.config.data.stride == "auto"
        opened.begin(with_stride(config, 3), RunState(step=0))
    with open_run(config, reporter) as opened:
        assert opened.config.data.stride == 3


def test_a_process_that_writes_nothing_needs_no_folder(make_config, reporter, tmp_path: Path) -> None:
    (tmp_path / "run").write_text("of another machine")
    with open_run(make_config(), reporter, writes=False, allow_config_change=True) as opened:
        opened.begin(opened.config, RunState(step=0))
        assert opened.changes(opened.config) == []
    assert (tmp_path / "run").read_text() == "of another machine"
