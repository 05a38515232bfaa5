"""Recording: images, states and replies of every decision; a full disk or the size limit prevents no decision."""

import errno
import json
import logging
from pathlib import Path

import numpy as np
import pytest

from served import STATE, image, make_controller, request, session
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import read_image
from vjepa2_ac.serving import recording
from vjepa2_ac.serving.recording import DECISIONS_FILE, IMAGES_FOLDER, Recorder
from vjepa2_ac.serving.session import Session, SessionOptions
from vjepa2_ac.serving.wire import pack, unpack


def record(folder: Path, served: Session, requests: list[dict], max_bytes: int = 10**8) -> list[dict]:
    served.recorder = Recorder(folder, {"model": "tiny"}, max_bytes)
    replies = [unpack(served.reply_to(pack(message))) for message in requests]
    assert all(reply["why"] for reply in replies)
    return read_lines(folder)


def read_lines(folder: Path) -> list[dict]:
    path = folder / DECISIONS_FILE
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_recorded_line_contains_images_state_and_reply(tmp_path: Path) -> None:
    mask = np.zeros((48, 60), dtype=bool)
    mask[:20, :30] = True
    requests = [request(step, goal_image=image(100), goal_mask=mask) for step in (0, 1, 0)]
    lines = record(tmp_path / "record", session(), requests)
    for line, message in zip(lines, requests, strict=True):
        frame, goal, recorded_mask = (
            read_image(tmp_path / "record" / name) for name in (line["frame"], *line["goals"])
        )
        np.testing.assert_array_equal(frame, message["observation/image"])
        np.testing.assert_array_equal(goal, image(100))
        np.testing.assert_array_equal(recorded_mask[..., 0] > 0, mask)
        assert (line["state"], line["episode"]) == (STATE.tolist(), 1)
        assert np.shape(line["answer"]["actions"]) == (2, 7)
    assert len(list((tmp_path / "record" / IMAGES_FOLDER).iterdir())) == 4, "each image is stored once"
    assert json.loads((tmp_path / "record/server.json").read_text())["model"] == "tiny"


def test_recording_stops_at_the_size_limit_and_the_server_continues(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    served = session()
    with caplog.at_level(logging.WARNING):
        lines = record(tmp_path / "record", served, [request(step, goal_image=image(100)) for step in range(8)], 60_000)
    assert 0 < len(lines) < 8
    assert caplog.text.count("the size limit is reached") == 1
    assert sum(path.stat().st_size for path in (tmp_path / "record").rglob("*") if path.is_file()) <= 60_000
    assert unpack(served.reply_to(pack(request(9))))["why"] == "planned"


def test_disk_error_stops_the_recording_but_no_decision(tmp_path: Path, caplog, monkeypatch) -> None:
    served = session()
    record(tmp_path / "record", served, [request(0, goal_image=image(100))])

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recording, "write_atomically", fail)
    with caplog.at_level(logging.WARNING):
        for step in (1, 2):
            assert unpack(served.reply_to(pack(request(step))))["why"] == "planned"
        assert unpack(served.reply_to(pack(request(3, goal_image=image(101)))))["why"] == "planned"
    assert caplog.text.count("No space left on device") == 1
    assert len(read_lines(tmp_path / "record")) == 1


def test_recording_into_an_existing_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old/notes").write_text("mine")
    for path in (tmp_path / "old", tmp_path / "old/notes"):
        with pytest.raises(InputError, match="old"):
            Recorder(path, {})
    assert (tmp_path / "old/notes").read_text() == "mine"


def test_dry_run_records_the_planned_states(tmp_path: Path) -> None:
    served = Session(make_controller(), None, SessionOptions(dry_run=True))
    (line,) = record(tmp_path / "record", served, [request(0, goal_image=image(100))])
    assert not np.any(line["answer"]["actions"])
    assert line["answer"]["planned"][0][:3] != STATE[:3].tolist()
