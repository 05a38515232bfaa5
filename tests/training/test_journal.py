"""Rows are appended, survive a kill, and are not written twice."""

import json
from pathlib import Path

from vjepa2_ac.training.journal import Journal, read_journal


def steps(folder: Path) -> list[int]:
    return [row["step"] for row in read_journal(folder / "metrics.jsonl")]


def test_rows_read_back(tmp_path: Path) -> None:
    with Journal(tmp_path, first_step=0, tensorboard=False) as journal:
        journal.write("train", 1, {"loss": 0.5, "by_horizon": [1.0, 2.0]})
    assert list(read_journal(tmp_path / "metrics.jsonl")) == [
        {"kind": "train", "step": 1, "loss": 0.5, "by_horizon": [1.0, 2.0]}
    ]


def test_steps_that_will_be_done_again_are_dropped_on_resume(tmp_path: Path) -> None:
    with Journal(tmp_path, first_step=0, tensorboard=False) as journal:
        for step in range(6):
            journal.write("train", step, {"loss": 0.5})
    with Journal(tmp_path, first_step=3, tensorboard=False) as journal:
        journal.write("train", 4, {"loss": 0.4})
    assert steps(tmp_path) == [0, 1, 2, 3, 4]


def test_a_line_left_by_halves_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"kind": "train", "step": 1}) + '\n{"kind": "tra')
    with Journal(tmp_path, first_step=5, tensorboard=False):
        pass
    assert steps(tmp_path) == [1]


def test_what_json_cannot_hold_becomes_null(tmp_path: Path) -> None:
    with Journal(tmp_path, first_step=0, tensorboard=False) as journal:
        journal.write("train", 1, {"loss": float("nan")})
    assert next(read_journal(tmp_path / "metrics.jsonl"))["loss"] is None


def test_tensorboard_gets_the_numbers(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with Journal(tmp_path, first_step=0, tensorboard=True) as journal:
        journal.write("train", 7, {"loss": 0.25})
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/loss")] == [(7, 0.25)]


def test_a_tracker_that_fails_never_stops_the_journal(tmp_path: Path) -> None:
    class Broken:
        def add_scalar(self, *_: object) -> None:
            raise RuntimeError("disk quota")

        def close(self) -> None: ...

    with Journal(tmp_path, first_step=0, tensorboard=False) as journal:
        journal._tensorboard = Broken()
        journal.write("train", 1, {"loss": 0.5})
        journal.write("train", 2, {"loss": 0.5})
    assert steps(tmp_path) == [1, 2]
