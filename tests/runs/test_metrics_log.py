"""The metrics log: rows are appended, survive a kill, and are not written twice."""

import errno
import os
import time
from pathlib import Path

import pytest

from same_run import assert_same_run
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs import metrics_log
from vjepa2_ac.runs.metrics_log import MetricsLog, read_metrics_log
from vjepa2_ac.training import outputs
from vjepa2_ac.training.loop import train


def steps(folder: Path) -> list[int]:
    return [row["step"] for row in read_metrics_log(folder / "metrics.jsonl")]


def test_rows_of_repeated_steps_are_removed_on_resume(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, first_step=0) as log:
        for step in range(6):
            log.write("train", step, {"loss": 0.5})
    with MetricsLog(tmp_path, first_step=3) as log:
        log.write("train", 4, {"loss": 0.4})
    assert steps(tmp_path) == [0, 1, 2, 3, 4]


def test_incomplete_and_invalid_rows_are_removed(tmp_path: Path) -> None:
    rows = [b'{"kind": "train", "step": 1}', b"\x00\xff\xfe", b"[" * 20_000, b'{"step": 3}', b'{"kind": "tra']
    (tmp_path / "metrics.jsonl").write_bytes(b"\n".join(rows))
    with MetricsLog(tmp_path, first_step=5):
        pass
    assert steps(tmp_path) == [1]


def test_rows_are_synced_before_the_next_checkpoint(make_config, reporter, monkeypatch) -> None:
    """Otherwise a run could resume, after a power cut, from a checkpoint whose rows are lost."""
    flushed: list[str] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        path = Path(f"/proc/self/fd/{handle}").readlink()
        rows = f" {path.stat().st_size}" if path.name == "metrics.jsonl" else ""
        flushed.append(path.name + rows)
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    folder = train(make_config(training__steps=2, training__learning_rate=1e-9, checkpoint__every=1), reporter)
    states = [place for place, name in enumerate(flushed) if name == "state.json"]
    sizes = [row["step"] for row in read_metrics_log(folder / "metrics.jsonl")]
    assert sizes == [0, 1, 2, 2], "a validation, a step, a step and its validation"
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    ends = [len("".join(lines[:rows])) for rows in (1, 2, 4)]  # of the base, and of both steps
    for place, end in zip(states, ends, strict=True):
        assert f"metrics.jsonl {end}" in flushed[:place]


class FullDisk:
    """Makes writes to metrics.jsonl fail after some bytes, from a certain row on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.is_full, self._write = False, os.write
        monkeypatch.setattr(os, "write", self.write)

    def write(self, handle: int, data: bytes) -> int:
        if not self.is_full or Path(f"/proc/self/fd/{handle}").readlink().name != "metrics.jsonl":
            return self._write(handle, data)
        if bytes(data).startswith(b"{"):
            return self._write(handle, bytes(data)[:7])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def full_from(disk: FullDisk, reporter, at: int):
    stepped = reporter.on_step

    def step_on(step: int, metrics: dict) -> None:
        stepped(step, metrics)
        disk.is_full = step >= at

    reporter.on_step = step_on
    return reporter


def test_unwritable_metrics_log_raises_after_saving_a_checkpoint(make_config, reporter, tmp_path, monkeypatch) -> None:
    disk, quiet = FullDisk(monkeypatch), type(reporter)()
    config = make_config(checkpoint__every=100, checkpoint__keep_best=False)
    with pytest.raises(InputError, match=r"metrics\.jsonl: .*No space left on device.*The checkpoint of this step is"):
        train(config, full_from(disk, reporter, 4))
    assert reporter.steps[-1] == 4, "it ended at once"
    disk.is_full = False
    train(config, quiet)
    assert quiet.steps == [5, 6], "no step was lost"
    assert [row["step"] for row in read_metrics_log(tmp_path / "run/metrics.jsonl") if row["kind"] == "train"] == [
        1, 2, 3, 5, 6
    ]  # fmt: skip


def test_run_continues_with_all_metrics_after_a_checkpoint_frees_disk_space(
    make_config, reporter, tmp_path, monkeypatch, whole_run
) -> None:
    disk, save = FullDisk(monkeypatch), outputs.save_checkpoint

    def make_room(*arguments: object) -> None:
        save(*arguments)
        disk.is_full = False

    monkeypatch.setattr(outputs, "save_checkpoint", make_room)
    train(make_config(), full_from(disk, reporter, 3))
    assert_same_run(whole_run, tmp_path / "run")


def test_failed_flush_raises_although_the_next_one_succeeds(tmp_path: Path, monkeypatch) -> None:
    """After a failed fsync the system may have discarded the data."""
    real, failures = os.fsync, [OSError(errno.EIO, "Input/output error")]

    def fsync(handle: int) -> None:
        if failures:
            raise failures.pop()
        real(handle)

    def checkpoint() -> None:
        with log.flush_before_checkpoint():
            pass

    with MetricsLog(tmp_path, first_step=0) as log:
        monkeypatch.setattr(os, "fsync", fsync)
        with pytest.raises(InputError, match="Input/output error"):
            checkpoint()


def test_non_finite_values_become_null(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, first_step=0) as log:
        log.write("train", 1, {"loss": float("nan")})
    assert next(read_metrics_log(tmp_path / "metrics.jsonl"))["loss"] is None


def test_a_disk_that_stalls_causes_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(metrics_log, "STALLED_S", 0.01)
    with metrics_log.warn_if_stalled(tmp_path):
        until = time.monotonic() + 60
        while not caplog.records and time.monotonic() < until:
            time.sleep(0.002)
    assert "writing this file takes more than 0.01 s; training waits for the disk" in caplog.text
