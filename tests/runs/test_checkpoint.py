"""Checkpoints: atomic writes, damaged checkpoints, selection, and untrusted files."""

import errno
import json
import logging
import os
import re
import resource
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from accidents import Faults, without_permission
from run_fixtures import set_up
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.runs.checkpoint import (
    DataState,
    RunState,
    checkpoint_name,
    find_damage,
    newest_checkpoint,
    read_state,
    read_torch,
    select_checkpoint,
    selection_reason,
    write_checkpoint,
    write_manifest,
    write_torch,
)
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.resume import save_checkpoint


def write_weights(folder: Path) -> None:
    (folder / "adapter").mkdir()
    (folder / "adapter" / "weights.bin").write_bytes(b"weights" * 1000)
    (folder / "optimizer.pt").write_bytes(b"moments" * 1000)


def write(folder: Path, step: int, keep: int = 5) -> Path:
    return write_checkpoint(folder, RunState(step), write_weights, keep=keep)


@pytest.mark.parametrize("name", ["adapter/weights.bin", "optimizer.pt", "state.json", "manifest.json"])
@pytest.mark.parametrize("fault", ["truncate", "flip", "remove"])
def test_damaged_checkpoint_is_skipped_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, fault: str
) -> None:
    older, newer = write(tmp_path, 10), write(tmp_path, 20)
    damaged_file = newer / name
    content = bytearray(damaged_file.read_bytes())
    if fault == "truncate":
        damaged_file.write_bytes(content[: len(content) // 2])
    elif fault == "flip":
        content[len(content) // 2] ^= 0x10
        damaged_file.write_bytes(content)
    else:
        damaged_file.unlink()
    with caplog.at_level(logging.WARNING):
        assert newest_checkpoint(tmp_path) == older
    assert str(newer) in caplog.text


@pytest.mark.parametrize("step", [30, 40])
def test_incomplete_checkpoint_of_a_killed_writer_is_ignored_and_removed(tmp_path: Path, step: int) -> None:
    incomplete = tmp_path / f".writing-{checkpoint_name(30)}"
    incomplete.mkdir()
    write_weights(incomplete)
    assert newest_checkpoint(tmp_path) is None
    path = write(tmp_path, step)
    assert list(tmp_path.iterdir()) == [path]


def test_all_checkpoints_damaged_raises_and_keeps_them(tmp_path: Path) -> None:
    for step in (10, 20):
        (write(tmp_path, step) / "optimizer.pt").write_bytes(b"")
    with pytest.raises(InputError, match="all checkpoints are damaged \\(2 checkpoints"):
        newest_checkpoint(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("name", ["adapter/weights.bin", "state.json", "manifest.json", "adapter", "."])
def test_a_checkpoint_without_permission_is_neither_skipped_nor_removed(tmp_path: Path, name: str) -> None:
    write(tmp_path, 10)
    newest = write(tmp_path, 20)
    refused = r"Permission denied \(.*mode 0000, owner uid \d+; this process runs as uid \d+\)\. .* chmod; or run"
    with without_permission(newest / name):
        for action in (newest_checkpoint, lambda folder: write(folder, 15), lambda folder: write(folder, 20)):
            with pytest.raises(RefusedError, match=refused) as caught:
                action(tmp_path)
            assert caught.value.where.startswith(str(newest))
    assert find_damage(newest) is None
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("code", [errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.ELOOP, errno.ENOTCONN])
def test_disk_error_is_not_reported_as_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    write(tmp_path, 10)
    newest = write(tmp_path, 20)
    opened = Path.open

    def fail(path: Path, *arguments: Any, **options: Any) -> Any:
        if path.name == "weights.bin" and newest in path.parents:
            raise OSError(code, os.strerror(code), str(path))
        return opened(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", fail)
    for action in (newest_checkpoint, lambda folder: write(folder, 15)):
        with pytest.raises(UnreachableError, match=r"step-00000020/adapter/weights\.bin: cannot be read: "):
            action(tmp_path)
    monkeypatch.undo()
    assert newest_checkpoint(tmp_path) == newest


def test_complete_checkpoint_of_another_process_is_never_replaced(tmp_path: Path) -> None:
    other = write(tmp_path, 20)
    for step in (20, 10):
        with pytest.raises(InputError, match=r"step-00000020: a complete checkpoint of another process"):
            write(tmp_path, step)
    assert list(tmp_path.iterdir()) == [other]


@pytest.mark.parametrize("name", ["optimizer.pt", "manifest.json"])
def test_pipe_in_a_checkpoint_is_damage_and_does_not_block(tmp_path: Path, name: str) -> None:
    checkpoint = write(tmp_path, 10)
    (checkpoint / name).unlink()
    os.mkfifo(checkpoint / name)
    assert find_damage(checkpoint) == f"{name} is damaged (a pipe or a device)"
    with pytest.raises(InputError, match="a pipe or a device"):
        read_torch(checkpoint / name)


def test_a_new_checkpoint_replaces_the_damaged_ones_after_it(tmp_path: Path) -> None:
    older = write(tmp_path, 10, keep=1)
    for step in (20, 30, 40):
        (write(tmp_path, step, keep=9) / "optimizer.pt").write_bytes(b"")
    path = write(tmp_path, 20, keep=2)
    assert sorted(tmp_path.iterdir()) == [older, path]
    assert newest_checkpoint(tmp_path) == path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_best_checkpoint_is_kept_until_a_better_one_is_saved(tmp_path: Path) -> None:
    for step, error in [(10, 0.9), (20, 0.7), (30, 0.8), (40, float("nan")), (50, 0.7)]:
        before = newest_checkpoint(tmp_path)
        state = replace(read_state(before), step=step) if before else RunState(step)
        write_checkpoint(tmp_path, state.with_validation(error), write_weights, keep=2)
    assert names(tmp_path) == [checkpoint_name(20), checkpoint_name(40), checkpoint_name(50)]
    state = read_state(newest_checkpoint(tmp_path))
    assert (state.best_step, state.best_error) == (20, 0.7)
    write_checkpoint(tmp_path, replace(state, step=60).with_validation(0.6), write_weights, keep=2)
    assert names(tmp_path) == [checkpoint_name(50), checkpoint_name(60)]


def test_best_checkpoint_that_was_deleted_is_forgotten(tmp_path: Path) -> None:
    best = write_checkpoint(tmp_path, RunState(10).with_validation(0.5), write_weights, keep=2)
    newest = write_checkpoint(tmp_path, RunState(20, best_step=10, best_error=0.5), write_weights, keep=2)
    assert read_state(newest) == RunState(20, best_step=10, best_error=0.5)
    shutil.rmtree(best)
    assert read_state(newest) == RunState(20)


def manifest_of(files: dict[str, str]) -> str:
    return json.dumps({"files": files})


def test_manifest_without_state_or_with_outside_paths_is_damage(tmp_path: Path, caplog) -> None:
    older, newer = write(tmp_path / "run", 10), write(tmp_path / "run", 20)
    files = json.loads((newer / "manifest.json").read_text())["files"]
    (tmp_path / "elsewhere").write_bytes((newer / "state.json").read_bytes())
    outside_paths = {"../../elsewhere": files["state.json"]}
    for text, words in [
        (manifest_of({}), "does not name state.json"),
        (manifest_of({name: digest for name, digest in files.items() if name != "state.json"}), "does not name"),
        (manifest_of({**files, **outside_paths}), "the path '../../elsewhere', which is outside"),
        (manifest_of({**files, str(tmp_path / "elsewhere"): files["state.json"]}), "which is outside"),
        *((text, "manifest.json is damaged") for text in ("", "[]", "{}", '{"files": 3}')),
    ]:
        (newer / "manifest.json").write_text(text)
        caplog.clear()
        assert newest_checkpoint(tmp_path / "run") == older
        assert str(newer) in caplog.text, text
        assert words in caplog.text, text


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_failed_write_keeps_older_checkpoints_and_leaves_no_partial_one(tmp_path, monkeypatch, code) -> None:
    faults, error = Faults(monkeypatch), OSError(code, os.strerror(code))
    write(tmp_path / "count", 10)
    faults.set()
    write(tmp_path / "count", 20)
    operations = faults.num_operations
    assert operations > 10, "the write creates folders and files, flushes them, and renames the folder"
    for number in range(1, operations + 1):
        folder = tmp_path / str(number)
        faults.set()
        older = write(folder, 10)
        faults.set(number, error)
        with pytest.raises(InputError, match=rf"{checkpoint_name(20)}: .*cannot be written \({os.strerror(code)}\)"):
            write(folder, 20)
        assert find_damage(older) is None
        assert all(find_damage(path) is None for path in folder.iterdir()), "every checkpoint is complete"
        if newest_checkpoint(folder) == older:  # otherwise the rename succeeded, and the flush of the folder failed
            write(folder, 20)
        assert newest_checkpoint(folder) == folder / checkpoint_name(20), "a later write must succeed"


def test_checkpoint_is_synced_before_an_older_one_is_removed(tmp_path, monkeypatch) -> None:
    write(tmp_path, 10, keep=1)
    events: list[str] = []

    def record_calls(event: str, original):
        def operation(*arguments, **options):
            path = Path(f"/proc/self/fd/{arguments[0]}").readlink() if event == "flush" else Path(arguments[0])
            events.append(f"{event} {path.relative_to(tmp_path)}")
            return original(*arguments, **options)

        return operation

    monkeypatch.setattr(os, "fsync", record_calls("flush", os.fsync))
    monkeypatch.setattr(os, "rename", record_calls("rename", os.rename))
    monkeypatch.setattr(shutil, "rmtree", record_calls("remove", shutil.rmtree))
    stored = write(tmp_path, 20, keep=1)
    temporary = f".writing-{checkpoint_name(20)}"
    renamed = events.index(f"rename {temporary}")
    parts = [stored, *stored.rglob("*")]
    assert {f"flush {temporary}/{part.relative_to(stored)}".removesuffix("/.") for part in parts} < set(
        events[:renamed]
    )
    assert events[renamed + 1 :] == ["flush .", f"remove {checkpoint_name(10)}"]


@contextmanager
def files_end_at(size: int) -> Iterator[None]:
    """Limit the size of files within the context, which simulates a full disk for Python, torch and safetensors."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk_in_any_file_raises_and_changes_nothing(make_config, reporter) -> None:
    config = make_config(training__steps=1, checkpoint__keep_best="off")
    folder = train(config, reporter)
    run = set_up(config, reporter)
    older = newest_checkpoint(folder / "checkpoints")
    sizes = sorted(path.stat().st_size for path in older.rglob("*") if path.is_file())
    run.state = replace(run.state, step=2)
    for size in {0, *(size - 1 for size in sizes), sizes[-1] // 2, *range(0, sizes[-1], 9973)}:
        with files_end_at(size), pytest.raises(InputError, match=r"step-00000002: .*cannot be written"):
            save_checkpoint(run, folder)
        assert [path.name for path in (folder / "checkpoints").iterdir()] == [older.name]
    assert find_damage(older) is None
    with files_end_at(sizes[-1] + 4096):
        save_checkpoint(run, folder)


@pytest.mark.parametrize(
    "changes",
    [{}, {"adapter__modules_to_save": ["action_encoder"]}, {"adapter__kind": "none"}],
    ids=["lora", "heads", "none"],
)
def test_checkpoint_contains_trained_weights_and_not_the_frozen_base(make_config, reporter, changes) -> None:
    config = make_config(training__steps=1, **changes)
    checkpoint = newest_checkpoint(train(config, reporter) / "checkpoints")
    model = set_up(config, reporter).world_model
    trained = sum(value.numel() for value in model.parameters() if value.requires_grad)
    state = torch.load(checkpoint / "optimizer.pt", weights_only=True)["state"].values()
    assert sum(moments[name].numel() for moments in state for name in ("exp_avg", "exp_avg_sq")) == 2 * trained
    stored = {path.name: load_file(path) for path in checkpoint.rglob("*.safetensors")}
    if config.adapter.kind == "none":
        assert {name: value.keys() for name, value in stored.items()} == {
            "predictor.safetensors": model.predictor.state_dict().keys()
        }
        return
    for weights in stored.values():
        assert sum(value.numel() for value in weights.values()) == trained
        assert all(re.search(r"\.lora_[AB]|\.action_encoder\.", name) for name in weights)
    other_bytes = sum(
        path.stat().st_size for path in checkpoint.rglob("*") if path.name not in {*stored, "optimizer.pt"}
    )
    assert other_bytes < 20_000, "all other files are small text files"


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self._mark = mark

    def __reduce__(self) -> tuple:
        return (Path.touch, (self._mark,))


def test_optimizer_file_with_code_raises_and_is_not_executed(make_config, reporter, tmp_path) -> None:
    config = make_config(training__steps=1)
    checkpoint = newest_checkpoint(train(config, reporter) / "checkpoints")
    torch.save({"state": Bomb(tmp_path / "mark")}, checkpoint / "optimizer.pt")
    write_manifest(checkpoint)  # an attacker who can write the file can also write the manifest
    with pytest.raises(InputError, match=r"optimizer\.pt: objects other than tensors and plain values.*execute code"):
        train(make_config(training__steps=2), reporter, allow_config_change=True)
    assert not (tmp_path / "mark").exists()
    torch.load(checkpoint / "optimizer.pt", weights_only=False)
    assert (tmp_path / "mark").exists(), "without weights_only the file executes code"


# Untrusted files: an invalid file raises an error with its name


def test_run_state_round_trip_keeps_every_field(tmp_path: Path) -> None:
    state = RunState(
        10, run_id="a", clips_done=40, clips_per_step=4, clips_per_process=2, num_processes=2,
        data=(DataState("f", 3, {"e": "why"}),), best_step=10, best_error=0.5,
        validation_settings={"data.frames": "16"},
        loss_scale={"scale": 65536.0, "growth_interval": 2000, "_growth_tracker": 0, "growth_factor": float("inf")},
    )  # fmt: skip
    loaded = read_state(write_checkpoint(tmp_path, state, lambda _: None, keep=1))
    assert loaded == state
    assert type((loaded.loss_scale or {})["growth_interval"]) is int


def test_compressed_or_legacy_optimizer_file_raises(tmp_path: Path) -> None:
    """Loading a small file in these formats may need unlimited memory."""
    with (tmp_path / "optimizer.pt").open("wb") as file:
        write_torch({"a": torch.zeros(1000)}, file)
    assert read_torch(tmp_path / "optimizer.pt")["a"].shape == (1000,)
    with (
        zipfile.ZipFile(tmp_path / "optimizer.pt") as old,
        zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    torch.save({"a": torch.zeros(10)}, tmp_path / "legacy.pt", _use_new_zipfile_serialization=False)
    for name in ("bomb.pt", "legacy.pt"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read"):
            read_torch(tmp_path / name)


# Selection


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a run whose best checkpoint is step 20, and whose newest is step 30."""
    for step, best in [(10, 10), (20, 20), (30, 20)]:
        state = RunState(step, best_step=best, best_error=0.5)
        write_checkpoint(tmp_path / "checkpoints", state, write_weights, keep=9)
    return tmp_path


@pytest.mark.parametrize(
    ("selection", "description"),
    [
        ("newest", "step-00000030 (the newest)"),
        ("selected", "step-00000020 (the best by error)"),
        ("best", "step-00000020 (the best by error)"),
        ("10", "step-00000010 (as requested)"),
    ],
)
def test_checkpoints_are_selected_by_newest_best_and_step(run: Path, selection: str, description: str) -> None:
    checkpoint = select_checkpoint(run, selection)
    assert str(checkpoint) == description
    assert checkpoint.path == run / "checkpoints" / description.split(maxsplit=1)[0]


@pytest.mark.parametrize(
    ("old_reason", "reason"),
    [
        ("step-00000010 (as asked for)", "as requested"),
        ("step-00000030 (the newest: none was selected)", "the newest, none was selected by validation"),
        ("step-00000020 (the best by error)", "the best by error"),
        ("", ""),
    ],
)
def test_reason_in_an_older_file_equals_the_current_reason(old_reason: str, reason: str) -> None:
    assert selection_reason(old_reason) == reason


@pytest.mark.parametrize(("selection", "problem"), [("15", "no checkpoint of step 15"), ("bset", "--checkpoint bset")])
def test_missing_checkpoint_raises_with_the_existing_steps(run: Path, selection: str, problem: str) -> None:
    with pytest.raises(
        InputError, match=rf"{problem}.*\. Expected selected, newest, best or one of the steps 10, 20, 30"
    ):
        select_checkpoint(run, selection)


def test_damaged_requested_checkpoint_raises(run: Path) -> None:
    (run / "checkpoints/step-00000020/optimizer.pt").write_bytes(b"torn")
    for selection in ("best", "20"):
        with pytest.raises(InputError, match=r"step-00000020 is damaged: .*one of the steps 10, 30"):
            select_checkpoint(run, selection)


def test_selection_without_validations_or_checkpoints(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"without a complete checkpoint.*--resume"):
        select_checkpoint(tmp_path)
    write(tmp_path / "checkpoints", 10)
    assert str(select_checkpoint(tmp_path)) == "step-00000010 (the newest, none was selected by validation)"
    with pytest.raises(InputError, match=r"no best checkpoint.*one of the steps 10"):
        select_checkpoint(tmp_path, "best")


@pytest.mark.parametrize(
    "changes",
    [{"step": "10"}, {"step": -1}, {"clips_done": None}, {"processes": 0}, {"data": [{"broken": {"a": 3}}]},
     {"best_error": "low"}, {"loss_scale": [1]}, {"run_id": 3}, {"unheard_of": 3}],
    ids=str,
)  # fmt: skip
def test_state_with_wrong_types_raises(tmp_path: Path, changes: dict[str, object]) -> None:
    checkpoint = write(tmp_path, 10)
    (checkpoint / "state.json").write_text(json.dumps({"step": 10, "clips_done": 40} | changes))
    write_manifest(checkpoint)  # an attacker who can write the file can also write the manifest
    with pytest.raises(InputError, match=f"state.json: .*{next(iter(changes))}.*older one"):
        read_state(newest_checkpoint(tmp_path))
