"""Records: images, states and answers of every decision; neither a full disk nor the size limit costs a decision."""

import errno
import json
import logging
from pathlib import Path

import numpy as np
import pytest

from served import STATE, controller, image, request, session
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import read_image
from vjepa2_ac.serving import recording
from vjepa2_ac.serving.recording import DECISIONS, IMAGES, Recorder
from vjepa2_ac.serving.session import Session, SessionOptions
from vjepa2_ac.serving.wire import pack, unpack


def recorded(folder: Path, one: Session, requests: list[dict], most_bytes: int = 10**8) -> list[dict]:
    one.recorder = Recorder(folder, {"model": "tiny"}, most_bytes)
    answers = [unpack(one.answer(pack(message))) for message in requests]
    assert all(answer["why"] for answer in answers)
    return lines_of(folder)


def lines_of(folder: Path) -> list[dict]:
    path = folder / DECISIONS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_a_line_has_images_state_and_answer(tmp_path: Path) -> None:
    mask = np.zeros((48, 60), dtype=bool)
    mask[:20, :30] = True
    asked = [request(step, goal_image=image(100), goal_mask=mask) for step in (0, 1, 0)]
    lines = recorded(tmp_path / "record", session(), asked)
    for line, message in zip(lines, asked, strict=True):
        frame, goal, seen = (read_image(tmp_path / "record" / name) for name in (line["frame"], *line["goals"]))
        np.testing.assert_array_equal(frame, message["observation/image"])
        np.testing.assert_array_equal(goal, image(100))
        np.testing.assert_array_equal(seen[..., 0] > 0, mask)
        assert (line["state"], line["episode"]) == (STATE.tolist(), 1)
        assert np.shape(line["answer"]["actions"]) == (2, 7)
    assert len(list((tmp_path / "record" / IMAGES).iterdir())) == 4, "each image once"
    assert json.loads((tmp_path / "record/server.json").read_text())["model"] == "tiny"


def test_a_record_ends_at_its_size_and_the_server_continues(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    one = session()
    with caplog.at_level(logging.WARNING):
        lines = recorded(tmp_path / "record", one, [request(step, goal_image=image(100)) for step in range(8)], 60_000)
    assert 0 < len(lines) < 8
    assert caplog.text.count("it has its largest size") == 1
    assert sum(path.stat().st_size for path in (tmp_path / "record").rglob("*") if path.is_file()) <= 60_000
    assert unpack(one.answer(pack(request(9))))["why"] == "planned"


def test_a_disk_that_fails_ends_the_record_and_no_decision(tmp_path: Path, caplog, monkeypatch) -> None:
    one = session()
    recorded(tmp_path / "record", one, [request(0, goal_image=image(100))])

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recording, "write_atomically", fail)
    with caplog.at_level(logging.WARNING):
        for step in (1, 2):
            assert unpack(one.answer(pack(request(step))))["why"] == "planned"
        assert unpack(one.answer(pack(request(3, goal_image=image(101)))))["why"] == "planned"
    assert caplog.text.count("No space left on device") == 1
    assert len(lines_of(tmp_path / "record")) == 1


def test_a_record_does_not_write_into_an_existing_folder(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old/notes").write_text("mine")
    for place in (tmp_path / "old", tmp_path / "old/notes"):
        with pytest.raises(InputError, match="old"):
            Recorder(place, {})
    assert (tmp_path / "old/notes").read_text() == "mine"


def test_a_dry_run_records_what_would_have_been_done(tmp_path: Path) -> None:
    dry = Session(controller(), None, SessionOptions(dry_run=True))
    (line,) = recorded(tmp_path / "record", dry, [request(0, goal_image=image(100))])
    assert not np.any(line["answer"]["actions"])
    assert line["answer"]["planned"][0][:3] != STATE[:3].tolist()
