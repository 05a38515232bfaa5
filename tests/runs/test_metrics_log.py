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
    """Otherwise the rows before a checkpoint could be lost in a power cut, although the run resumes after them."""
    flushed: list[str] = []
    original = os.fsync

    def fsync(handle: int) -> None:
        path = Path(f"/proc/self/fd/{handle}").readlink()
        rows = f" {path.stat().st_size}" if path.name == "metrics.jsonl" else ""
        flushed.append(path.name + rows)
        original(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    folder = train(make_config(training__steps=2, training__learning_rate=1e-9, checkpoint__every=1), reporter)
    states = [index for index, name in enumerate(flushed) if name == "state.json"]
    logged_steps = [row["step"] for row in read_metrics_log(folder / "metrics.jsonl")]
    assert logged_steps == [0, 1, 2, 2], "validation, step 1, step 2, validation"
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    lengths = [
        len("".join(lines[:rows])) for rows in (1, 2, 4)
    ]  # after the base model's validation, and after each step
    for index, end in zip(states, lengths, strict=True):
        assert f"metrics.jsonl {end}" in flushed[:index]


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


def fill_disk_at(disk: FullDisk, reporter, full_step: int):
    on_step = reporter.on_step

    def on_step_with_full_disk(step: int, metrics: dict) -> None:
        on_step(step, metrics)
        disk.is_full = step >= full_step

    reporter.on_step = on_step_with_full_disk
    return reporter


def test_unwritable_metrics_log_raises_after_saving_a_checkpoint(make_config, reporter, tmp_path, monkeypatch) -> None:
    disk, second_reporter = FullDisk(monkeypatch), type(reporter)()
    config = make_config(checkpoint__every=100, checkpoint__keep_best=False)
    with pytest.raises(InputError, match=r"metrics\.jsonl: .*No space left on device.*The checkpoint of this step is"):
        train(config, fill_disk_at(disk, reporter, 4))
    assert reporter.steps[-1] == 4, "the run must end immediately"
    disk.is_full = False
    train(config, second_reporter)
    assert second_reporter.steps == [5, 6], "no step may be lost"
    assert [row["step"] for row in read_metrics_log(tmp_path / "run/metrics.jsonl") if row["kind"] == "train"] == [
        1, 2, 3, 5, 6
    ]  # fmt: skip


def test_run_continues_with_all_metrics_after_a_checkpoint_frees_disk_space(
    make_config, reporter, tmp_path, monkeypatch, whole_run
) -> None:
    disk, save = FullDisk(monkeypatch), outputs.save_checkpoint

    def save_and_free_disk(*arguments: object) -> None:
        save(*arguments)
        disk.is_full = False

    monkeypatch.setattr(outputs, "save_checkpoint", save_and_free_disk)
    train(make_config(), fill_disk_at(disk, reporter, 3))
    assert_same_run(whole_run, tmp_path / "run")


def test_failed_flush_raises_although_the_next_one_succeeds(tmp_path: Path, monkeypatch) -> None:
    """After a failed fsync the system may have discarded the data."""
    original, failures = os.fsync, [OSError(errno.EIO, "Input/output error")]

    def fsync(handle: int) -> None:
        if failures:
            raise failures.pop()
        original(handle)

    def flush_and_save() -> None:
        with log.flush_before_checkpoint():
            pass

    with MetricsLog(tmp_path, first_step=0) as log:
        monkeypatch.setattr(os, "fsync", fsync)
        with pytest.raises(InputError, match="Input/output error"):
            flush_and_save()


def test_non_finite_values_become_null(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, first_step=0) as log:
        log.write("train", 1, {"loss": float("nan")})
    assert next(read_metrics_log(tmp_path / "metrics.jsonl"))["loss"] is None


def test_stalled_disk_causes_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(metrics_log, "STALLED_S", 0.01)
    with metrics_log.warn_if_stalled(tmp_path):
        deadline = time.monotonic() + 60
        while not caplog.records and time.monotonic() < deadline:
            time.sleep(0.002)
    assert "writing this file takes more than 0.01 s; training waits for the disk" in caplog.text
