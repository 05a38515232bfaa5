"""Rows are appended, survive a kill, and are not written twice."""

import json
import os
from collections.abc import Mapping
from pathlib import Path

from vjepa2_ac.training.journal import Journal, read_journal
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.trackers import Trackers


def steps(folder: Path) -> list[int]:
    return [row["step"] for row in read_journal(folder / "metrics.jsonl")]


def test_rows_read_back(tmp_path: Path) -> None:
    with Journal(tmp_path, first_step=0) as journal:
        journal.write("train", 1, {"loss": 0.5, "by_horizon": [1.0, 2.0]})
    assert list(read_journal(tmp_path / "metrics.jsonl")) == [
        {"kind": "train", "step": 1, "loss": 0.5, "by_horizon": [1.0, 2.0]}
    ]


def test_steps_that_will_be_done_again_are_dropped_on_resume(tmp_path: Path) -> None:
    with Journal(tmp_path, first_step=0) as journal:
        for step in range(6):
            journal.write("train", step, {"loss": 0.5})
    with Journal(tmp_path, first_step=3) as journal:
        journal.write("train", 4, {"loss": 0.4})
    assert steps(tmp_path) == [0, 1, 2, 3, 4]


def test_a_line_left_by_halves_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"kind": "train", "step": 1}) + '\n{"kind": "tra')
    with Journal(tmp_path, first_step=5):
        pass
    assert steps(tmp_path) == [1]


def test_bytes_that_are_no_text_are_dropped_with_their_line(tmp_path: Path) -> None:
    rows = b'{"kind": "train", "step": 1}\n', b"\x00\xff\xfe\n", b'{"kind": "train", "step": 2}\n'
    (tmp_path / "metrics.jsonl").write_bytes(b"".join(rows))
    assert steps(tmp_path) == [1, 2]


def test_rows_are_on_the_disk_before_the_checkpoint_after_them(make_config, reporter, monkeypatch) -> None:
    """Else a power cut could leave a run that goes on behind rows that it does not have."""
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
    sizes = [row["step"] for row in read_journal(folder / "metrics.jsonl")]
    assert sizes == [0, 1, 2, 2], "a validation, a step, a step and its validation"
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    ends = [len("".join(lines[:2])), len("".join(lines))]
    for place, end in zip(states, ends, strict=True):
        assert f"metrics.jsonl {end}" in flushed[:place]


def test_what_json_cannot_hold_becomes_null(tmp_path: Path) -> None:
    with Journal(tmp_path, first_step=0) as journal:
        journal.write("train", 1, {"loss": float("nan")})
    assert next(read_journal(tmp_path / "metrics.jsonl"))["loss"] is None


def test_trackers_get_each_row_and_are_closed_with_the_journal(tmp_path: Path) -> None:
    class Tracker:
        def __init__(self) -> None:
            self.said: list[object] = []

        def log(self, figures: Mapping[str, float], step: int) -> None:
            self.said.append((step, dict(figures)))
            raise RuntimeError("disk quota")

        def close(self) -> None:
            self.said.append("closed")

    working, broken = Tracker(), Tracker()
    working.log = lambda figures, step: working.said.append((step, dict(figures)))  # type: ignore[method-assign]
    trackers = Trackers({"working": lambda: working, "broken": lambda: broken})
    with Journal(tmp_path, first_step=0, trackers=trackers) as journal:
        journal.write("train", 1, {"loss": 0.5})
        journal.write("train", 2, {"loss": 0.25})
    assert steps(tmp_path) == [1, 2]
    assert working.said == [(1, {"train/loss": 0.5}), (2, {"train/loss": 0.25}), "closed"]
    assert broken.said == [(1, {"train/loss": 0.5})], "one that failed is left alone"
