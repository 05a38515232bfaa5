"""Run files of unknown origin: invalid ones are refused by name."""

import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.runs.folder import run_id, start_folders
from vjepa2_ac.runs.lock import RunLock
from vjepa2_ac.runs.manifest import verify_manifest, write_manifest
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.torch_file import read_torch, write_torch
from vjepa2_ac.training.optim import load_moments
from vjepa2_ac.training.resume import restore_loss_scale

STATE = {"step": 10, "clips_done": 40}
DEEP = "[" * 20_000 + "]" * 20_000


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "checkpoints", RunState(10, clips_done=40), lambda _: None, keep=3)


def test_every_field_of_a_state_comes_back(tmp_path: Path) -> None:
    state = RunState(
        10,
        run_id="a",
        clips_done=40,
        clips_per_step=4,
        clips_asked=2,
        processes=2,
        broken={"e": "why"},
        windows=0,
        best_step=10,
        best_error=0.5,
        measured_on={"data.frames": "16"},
        loss_scale={"scale": 65536.0, "growth_interval": 2000, "_growth_tracker": 0, "growth_factor": float("inf")},
    )
    found = read_state(write_checkpoint(tmp_path, state, lambda _: None, keep=1))
    assert found == state
    assert type((found.loss_scale or {})["growth_interval"]) is int


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"step": "10"}, "step: Input should be a valid integer (found '10')"),
        ({"step": -1}, "step: "),
        ({"step": True}, "step: "),
        ({"step": 2**70}, "step: Input should be"),
        ({"clips_done": None}, "clips_done: "),
        ({"clips_per_step": 0}, "clips_per_step: "),
        ({"processes": 0}, "processes: "),
        ({"broken": []}, "broken: "),
        ({"broken": {"a": 3}}, "broken.a: "),
        ({"best_step": 1.5}, "best_step: "),
        ({"best_error": "low"}, "best_error: "),
        ({"best_error": float("nan")}, "best_error: Input should be a finite number"),
        ({"measured_on": {"a": 1}}, "measured_on.a: "),
        ({"loss_scale": [1]}, "loss_scale: "),
        ({"run_id": 3}, "run_id: "),
        ({"unheard_of": 3}, "unheard_of: unknown"),
    ],
)
def test_a_state_of_other_types_is_refused_by_name(checkpoint: Path, changes: dict[str, Any], complaint: str) -> None:
    (checkpoint / "state.json").write_text(json.dumps(STATE | changes))
    with pytest.raises(InputError) as caught:
        read_state(checkpoint)
    assert complaint in str(caught.value)
    assert "state.json" in caught.value.where
    assert "older one" in caught.value.fix


@pytest.mark.parametrize("text", ["[]", "3", DEEP, "{", '{"step": 1, "step": 2}', "\x00"])
def test_a_state_that_is_none_is_refused(checkpoint: Path, text: str) -> None:
    (checkpoint / "state.json").write_text(text)
    with pytest.raises(InputError, match=r"state\.json"):
        read_state(checkpoint)


@pytest.mark.parametrize("text", [DEEP, '{"files": [1]}', '{"files": {"a": 1}}', '{"files": {"./state.json": "x"}}'])
def test_a_manifest_that_is_none_damages_its_checkpoint_only(checkpoint: Path, text: str) -> None:
    (checkpoint / "manifest.json").write_text(text)
    assert "no readable manifest.json" in str(verify_manifest(checkpoint, needed={"state.json"}))


def test_a_manifest_that_is_a_pipe_is_not_waited_for(checkpoint: Path) -> None:
    (checkpoint / "manifest.json").unlink()
    os.mkfifo(checkpoint / "manifest.json")
    assert "a pipe" in str(verify_manifest(checkpoint, needed={"state.json"}))


def test_small_files_of_a_run_that_are_none_are_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "environment.json").write_text(DEEP)
    assert start_folders(tmp_path) == []
    (tmp_path / "environment.json").write_text('[3, {"folder": 4}, {"folder": "/here"}]')
    assert start_folders(tmp_path) == [Path("/here")]
    for text in ("../../x", "a b", "x" * 10_000, "\x1b[2J"):
        (tmp_path / "run_id").write_text(text)
        with pytest.raises(InputError, match="run_id"):
            run_id(tmp_path)
    (tmp_path / "metrics.jsonl").write_text(
        f'{DEEP}\n{{"step": true, "kind": "train"}}\n{{"step": 3}}\n{{"step": 4, "kind": "train", "loss": NaN}}\n{{"st'
    )
    assert [row["step"] for row in read_metrics_log(tmp_path / "metrics.jsonl")] == [4]


def test_whoever_signed_a_lock_may_have_signed_anything(tmp_path: Path) -> None:
    with RunLock(tmp_path) as lock, RunLock(tmp_path) as other:
        lock.take()
        (tmp_path / ".lock").write_text(DEEP)
        with pytest.raises(InputError, match="by another process"):
            other.take()


def write(path: Path, value: object) -> Path:
    with path.open("wb") as file:
        write_torch(value, file)
    return path


def test_moments_that_are_compressed_or_of_an_older_form_are_not_read(tmp_path: Path) -> None:
    path = write(tmp_path / "optimizer.pt", {"a": torch.zeros(1000)})
    assert read_torch(path)["a"].shape == (1000,)
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(InputError, match=r"bomb\.pt: cannot be read \(its parts are compressed"):
        read_torch(tmp_path / "bomb.pt")
    torch.save({"a": torch.zeros(10)}, tmp_path / "legacy.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(InputError, match=r"legacy\.pt: cannot be read"):
        read_torch(tmp_path / "legacy.pt")
    (tmp_path / "pickle.pt").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(InputError, match=r"pickle\.pt: cannot be read"):
        read_torch(tmp_path / "pickle.pt")


def optimizer() -> torch.optim.AdamW:
    weight = torch.nn.Parameter(torch.zeros(3, 2))
    made = torch.optim.AdamW([weight])
    weight.grad = torch.ones(3, 2)
    made.step()
    return made


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"state": [1]}, "not the state of an optimizer"),
        ({"state": None}, "not the state of an optimizer"),
        ({"state": {0: 3}}, "not the state of an optimizer"),
        ({"param_groups": 3}, "not the state of an optimizer"),
        ({"state": {0: {"momentum": 3}}}, "of another training.optimizer"),
        ({"state": {"0": {"exp_avg": torch.zeros(3, 2)}}}, "of a parameter '0', of 1"),
        ({"state": {7: {"exp_avg": torch.zeros(3, 2)}}}, "of a parameter 7, of 1"),
        ({"state": {0: {"exp_avg": torch.zeros(2, 3)}}}, r"of shape torch.Size\(\[2, 3\]\) for a parameter of shape"),
        ({"state": {0: {"exp_avg": 3.0}}}, "of shape None"),
        ({"param_groups": []}, "different number of parameter groups"),
    ],
)
def test_moments_that_are_not_of_this_optimizer_are_refused(changes: dict[str, Any], complaint: str) -> None:
    made = optimizer()
    load_moments(made, optimizer().state_dict())
    with pytest.raises(ValueError, match=complaint):
        load_moments(made, optimizer().state_dict() | changes)


def test_a_loss_scale_of_other_names_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scaler = torch.amp.GradScaler("cpu")
    monkeypatch.setattr(scaler, "is_enabled", lambda: True)
    restore_loss_scale(scaler, RunState(1, loss_scale=scaler.state_dict()))
    with pytest.raises(InputError, match="loss_scale"):
        restore_loss_scale(scaler, RunState(1, loss_scale={"scale": 1.0}))


def test_a_whole_checkpoint_with_a_hostile_state_is_still_refused(checkpoint: Path) -> None:
    (checkpoint / "state.json").write_text('{"step": 10, "clips_done": "x"}')
    (checkpoint / "manifest.json").unlink()
    write_manifest(checkpoint)  # whoever can write the file can write the manifest
    assert newest_checkpoint(checkpoint.parent) == checkpoint
    with pytest.raises(InputError, match="clips_done: "):
        read_state(checkpoint)
