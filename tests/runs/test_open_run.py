"""Opening a run: everything is checked before a folder is made, and the folder is held before anything goes into it."""

import os
from pathlib import Path

import pytest
import yaml

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.runs.folder import RunLock, read_run_config
from vjepa2_ac.runs.open_run import open_run

OLDER = {
    "check_crc": "once",
    "connections": 16,
    "prefetch": 2,
    "short_episodes": "skip",
}  # as before `splits`
OPEN_REMOTE = "vjepa2_ac.runs.open_run.open_remote"


def test_a_new_folder_is_made_and_locked_when_the_run_begins_and_not_before(make_config, reporter) -> None:
    config = make_config()
    folder = Path(config.run_dir)
    with open_run(config, reporter) as opened:
        assert not folder.exists()
        opened.begin(config, RunState(step=0, run_id="mine"))
        assert (folder / "config.yaml").read_text() == config_as_yaml(config)
        with pytest.raises(InputError, match=f"by process {os.getpid()}"):
            RunLock(folder).take()
        assert opened.mirror("mine") is None
    with RunLock(folder) as lock:
        lock.take()


@pytest.mark.parametrize("check_only", [False, True])
def test_a_folder_is_locked_before_the_remote_is_asked_and_a_check_locks_nothing(
    make_config, reporter, monkeypatch, tmp_path: Path, check_only: bool
) -> None:
    config = make_config(checkpoint__remote=str(tmp_path / "remote"))
    folder, asked = Path(config.run_dir), []
    with open_run(make_config(), reporter) as opened:
        opened.begin(opened.config, RunState(step=0))

    def remote(config: Config, *_: object, **options: object) -> Config:
        with RunLock(folder) as lock:
            if check_only:
                assert options["lock"] is None
                lock.take()
            else:
                with pytest.raises(InputError, match="trained right now"):
                    lock.take()
        asked.append(options["into"])
        return config

    monkeypatch.setattr(OPEN_REMOTE, remote)
    with open_run(config, reporter, check_only=check_only):
        (into,) = asked
        assert (into is not None) == check_only
        assert into is None or folder not in into.parents
    assert into is None or not into.parent.exists()


def test_the_stride_that_a_run_has_chosen_is_the_one_of_its_next_start(make_config, reporter) -> None:
    config = make_config(data__stride="auto")
    with open_run(config, reporter) as opened:
        assert opened.config.data.stride == "auto"
        opened.begin(config.with_stride(3), RunState(step=0))
    with open_run(config, reporter) as opened:
        assert opened.config.data.stride == 3


def test_an_older_run_keeps_its_drawn_splits_unless_the_config_says_otherwise(make_config, reporter) -> None:
    with open_run(make_config(), reporter) as opened:
        opened.begin(opened.config, RunState(step=0))
    with open_run(make_config(), reporter) as opened:
        assert opened.config.data.splits == "dataset"
    file = Path(make_config().run_dir) / "config.yaml"
    values = yaml.safe_load(file.read_text())
    del values["data"]["splits"]
    values["data"] |= OLDER
    file.write_text(yaml.safe_dump(values))
    assert read_run_config(file.parent).data.splits == "hash"
    with open_run(make_config(), reporter) as opened:
        assert opened.config.data.splits == "hash"
    with (
        pytest.raises(InputError, match=r"differs in data\.splits"),
        open_run(make_config(data__splits="dataset"), reporter),
    ):
        pass


def test_a_replayed_set_of_an_older_run_keeps_its_drawn_splits(make_config, reporter) -> None:
    data = {"path": make_config().data.path, "frames": 4, "stride": 2}
    config = make_config(replay={"data": data})
    with open_run(config, reporter) as opened:
        opened.begin(opened.config, RunState(step=0))
    file = Path(config.run_dir) / "config.yaml"
    values = yaml.safe_load(file.read_text())
    values["replay"]["data"] = config.replay.data.model_dump(mode="json", exclude={"splits"}) | OLDER
    file.write_text(yaml.safe_dump(values))
    with open_run(config, reporter) as opened:
        assert [one.splits for one in opened.config.data_sets] == ["dataset", "hash"]
