"""The run folder: checks before it is created, one run per folder, and a lock for the training process."""

import errno
import fcntl
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from accidents import Faults, KilledError
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, config_as_yaml, parse_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import RunState, newest_checkpoint
from vjepa2_ac.runs.folder import (
    RunLock,
    check_run_folder,
    list_remote_locations,
    open_run_folder,
    read_or_create_run_id,
    read_run_config,
)
from vjepa2_ac.runs.open_run import open_run
from vjepa2_ac.training import loop
from vjepa2_ac.training.loop import train

HOLD_LOCK = """
import sys
from pathlib import Path
from vjepa2_ac.runs.folder import RunLock
lock = RunLock(Path(sys.argv[1]))
lock.take()
print("held", flush=True)
sys.stdin.read()
"""


def test_run_starts_after_a_start_was_killed_at_any_file(make_config, tmp_path, monkeypatch) -> None:
    faults = Faults(monkeypatch)
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
    for killed_at in range(1, 100):
        config = make_config(run_dir=str(tmp_path / str(killed_at) / "run"))
        faults.set(killed_at, KilledError())
        try:
            with RunLock(Path(config.run_dir)) as lock:
                lock.take()
                open_run_folder(config, "name")
        except KilledError:
            check_run_folder(config)
        else:
            break
    assert killed_at > 9, "a start creates folders, and writes, flushes and renames two files"
    faults.set()
    check_run_folder(config)


def test_folder_with_other_files_raises_even_with_a_lock(make_config, tmp_path) -> None:
    config = make_config()
    with RunLock(Path(config.run_dir)) as lock:
        lock.take()
    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"other files and without config\.yaml"):
        check_run_folder(config)


def test_invalid_small_files_of_a_run_raise_input_errors(tmp_path: Path, make_config) -> None:
    (tmp_path / "config.yaml").write_text(config_as_yaml(make_config(data__path="nowhere")))
    for text in ("[" * 20_000, '[3, {"folder": 4}, {}]'):
        (tmp_path / "environment.json").write_text(text)
        assert read_run_config(tmp_path).data.path == "nowhere"
    for text in ("../../x", "a b", "x" * 10_000, "\x1b[2J"):
        (tmp_path / "run_id").write_text(text)
        with pytest.raises(InputError, match="run_id"):
            read_or_create_run_id(tmp_path)


# Lock


def test_folder_in_use_raises_until_its_process_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD_LOCK, str(tmp_path / "run")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with RunLock(tmp_path / "run") as lock, pytest.raises(InputError, match="in use by another process"):
            lock.take()
        process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=120) == -signal.SIGKILL
    with RunLock(tmp_path / "run") as lock:
        lock.take()
        lock.take()
        with RunLock(tmp_path / "run") as other, pytest.raises(InputError, match="in use by"):
            other.take()


def test_file_system_without_locks_causes_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(file: object, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK), file, operation)

    monkeypatch.setattr(fcntl, "flock", refuse)
    with caplog.at_level(logging.WARNING), RunLock(tmp_path) as lock:
        lock.take()
    assert "no file locks" in caplog.text


def test_run_folder_is_locked_while_training_and_released_afterwards(make_config, reporter) -> None:
    refused_steps = []

    def train_in_the_same_folder(step: int, metrics: object) -> None:
        del metrics
        with pytest.raises(InputError, match=rf"by process {os.getpid()} on .+, since 20"):
            train(make_config(training__steps=2), other_reporter)
        refused_steps.append(step)

    other_reporter, reporter.on_step = type(reporter)(), train_in_the_same_folder
    train(make_config(training__steps=2), reporter)
    assert refused_steps == [1, 2]
    assert other_reporter.notes == [], "refused before anything was loaded"
    train(make_config(training__steps=2), other_reporter)


def test_start_raises_if_another_start_has_trained_meanwhile(make_config, reporter, monkeypatch) -> None:
    config, restore = make_config(), loop.restore

    def restore_after_another_start(*arguments):
        run = restore(*arguments)
        monkeypatch.setattr(loop, "restore", restore)
        train(config, type(reporter)())
        return run

    monkeypatch.setattr(loop, "restore", restore_after_another_start)
    with pytest.raises(InputError, match="step 6 from another start; this start is at step 0"):
        train(config, reporter)
    assert newest_checkpoint(Path(config.run_dir) / "checkpoints").name == "step-00000006"


# Relative paths


@pytest.fixture
def home(tmp_path: Path, data_folder: Path, base_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a folder with a data set and a base model, and a second folder; the working directory is the first."""
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(data_folder, home / "data")
    shutil.copytree(base_folder, home / "base")
    monkeypatch.chdir(home)
    return home


@pytest.fixture
def relative_config(make_config, home: Path):  # type: ignore[no-untyped-def]
    values = config_as_dict(make_config(training__steps=2, data__test_share=0.3))
    values["data"]["path"], values["model"]["base"] = "data", "base"
    return parse_config({**values, "run_dir": "run"}, where=str(home))


def test_only_missing_paths_are_resolved_from_the_folder_of_the_start(relative_config, home, monkeypatch) -> None:
    (home / "caches").mkdir()
    (home / "ranges.json").write_text("{}")
    other_folder = home.parent / "elsewhere"
    (other_folder / "data").mkdir()
    values = config_as_dict(relative_config)
    values["data"] |= {"cache_dir": "caches", "disk_cache": {"dir": "none"}}
    values["data"]["idle"] |= {"rule": "published", "ranges": "ranges.json"}
    (home / "run").mkdir()
    (home / "run/environment.json").write_text(json.dumps([{"folder": str(home)}]))
    monkeypatch.chdir(other_folder)

    def read_data_config(**changes: object):  # type: ignore[no-untyped-def]
        data = {key: value for key, value in values["data"].items() if key != "fields" or "source" not in changes}
        changed = parse_config({**values, "data": {**data, **changes}}, where="")
        (home / "run/config.yaml").write_text(config_as_yaml(changed))
        return read_run_config(home / "run").data

    resolved = read_data_config()
    assert (resolved.path, resolved.cache_dir, resolved.disk_cache.dir) == ("data", str(home / "caches"), "none")
    assert resolved.idle.ranges == str(home / "ranges.json")
    assert read_data_config(source="latents").idle.ranges == "ranges.json", (
        "with cached latents the path is only a part of the cache's key"
    )
    for path in ("gs://bucket/set", "/nowhere/set"):
        assert read_data_config(path=path).path == path


# URLs in the config of an untrusted run are printed before they are used

ELSEWHERE = {
    "run_dir": "r",
    "data": {"path": "gs://bucket/set", "idle": {"rule": "published", "ranges": "https://example.org/ranges.json"}},
    "model": {"base": "b.pt"},
    "checkpoint": {"remote": "s3://bucket/run"},
    "tracking": {"wandb": "online"},
}
LINES = [
    "data.path: gs://bucket/set",
    "data.idle.ranges: https://example.org/ranges.json",
    "checkpoint.remote: s3://bucket/run",
    "tracking.wandb: online",
]


def test_remote_locations_of_a_config_are_listed_with_their_keys() -> None:
    assert list_remote_locations(parse_config(ELSEWHERE, where="")) == LINES
    values = {"run_dir": "r", "data": {"path": "d", "exclude": ["gs://is-but-a-name"]}, "model": {"base": "b.pt"}}
    assert list_remote_locations(parse_config(values, where="")) == []


def test_remote_locations_of_a_run_are_printed_before_they_are_used(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("b.pt").touch()
    run = tmp_path / "[b]run"  # must not be interpreted as markup
    run.mkdir()
    (run / "config.yaml").write_text(config_as_yaml(parse_config(ELSEWHERE, where="")))
    printed: list[str] = []

    def stop(*_: Any, **__: Any) -> None:
        printed.append(capsys.readouterr().out)
        raise InputError(where="here", found="the end")

    monkeypatch.setattr("vjepa2_ac.training.loop.train", stop)
    assert main(["train", str(run), "--resume"]) == 2
    for line in LINES:
        assert f"The config of {run} contains a URL: {line}" in " ".join(printed[0].split())


OLDER = {
    "check_crc": "once",
    "connections": 16,
    "prefetch": 2,
    "short_episodes": "skip",
}  # keys of configs from before the key `data.splits`
OPEN_REMOTE = "vjepa2_ac.runs.open_run.open_remote"


def test_new_run_folder_is_created_and_locked_only_when_the_run_begins(make_config, reporter) -> None:
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
def test_folder_is_locked_before_remote_access_and_not_by_a_check(
    make_config, reporter, monkeypatch, tmp_path: Path, check_only: bool
) -> None:
    config = make_config(checkpoint__remote=str(tmp_path / "remote"))
    folder, targets = Path(config.run_dir), []
    with open_run(make_config(), reporter) as opened:
        opened.begin(opened.config, RunState(step=0))

    def remote(config: Config, *_: object, **options: object) -> Config:
        with RunLock(folder) as lock:
            if check_only:
                assert options["lock"] is None
                lock.take()
            else:
                with pytest.raises(InputError, match="in use by"):
                    lock.take()
        targets.append(options["into"])
        return config

    monkeypatch.setattr(OPEN_REMOTE, remote)
    with open_run(config, reporter, check_only=check_only):
        (target,) = targets
        assert (target is not None) == check_only
        assert target is None or folder not in target.parents
    assert target is None or not target.parent.exists()


def test_next_start_uses_the_calibrated_stride(make_config, reporter) -> None:
    config = make_config(data__stride="auto")
    with open_run(config, reporter) as opened:
        assert opened.config.data.stride == "auto"
        opened.begin(config.with_stride(3), RunState(step=0))
    with open_run(config, reporter) as opened:
        assert opened.config.data.stride == 3


def test_older_run_keeps_its_drawn_splits_unless_the_config_sets_them(make_config, reporter) -> None:
    data = {"path": make_config().data.path, "frames": 4, "stride": 2}
    config = make_config(replay={"data": data})
    with open_run(config, reporter) as opened:
        opened.begin(opened.config, RunState(step=0))
    with open_run(config, reporter) as opened:
        assert [data.splits for data in opened.config.data_sets] == ["dataset", "dataset"]
    file = Path(config.run_dir) / "config.yaml"
    values = yaml.safe_load(file.read_text())
    values["data"] = {key: value for key, value in values["data"].items() if key != "splits"} | OLDER
    values["replay"]["data"] = config.replay.data.model_dump(mode="json", exclude={"splits"}) | OLDER
    file.write_text(yaml.safe_dump(values))
    assert read_run_config(file.parent).data.splits == "hash"
    with open_run(config, reporter) as opened:
        assert [data.splits for data in opened.config.data_sets] == ["hash", "hash"]
    other = make_config(replay={"data": data}, data__splits="dataset")
    with pytest.raises(InputError, match=r"differs in data\.splits"), open_run(other, reporter):
        pass
