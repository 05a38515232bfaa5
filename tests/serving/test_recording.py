"""Records: a decision can be made again from them, and neither a full disk nor their size costs one."""

import errno
import json
import logging
from pathlib import Path

import numpy as np
import pytest

from served import STATE, controller, image, request, session
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import read_image
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving import recording
from vjepa2_ac.serving.recording import DECISIONS, IMAGES, Recorder
from vjepa2_ac.serving.session import Session, SessionOptions
from vjepa2_ac.serving.wire import pack, unpack

STAGES = {
    "stages": (
        SubGoal(image(51), "over", at_most=2, gripper="held"),
        SubGoal(image(52), "grasp", at_least=1, at_most=3, gripper="close"),
        SubGoal(image(53), "up"),
    )
}


def recorded(folder: Path, one: Session, requests: list[dict], most_bytes: int = 10**8) -> list[dict]:
    one.recorder = Recorder(folder, {"model": "tiny"}, most_bytes)
    answers = [unpack(one.answer(pack(message))) for message in requests]
    assert all(answer["why"] for answer in answers)
    return lines_of(folder)


def lines_of(folder: Path) -> list[dict]:
    path = folder / DECISIONS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def option(words: list[str], name: str) -> list[str]:
    return [words[place + 1] for place, word in enumerate(words) if word == name]


def test_a_line_says_what_was_asked_and_what_was_answered(tmp_path: Path) -> None:
    asked = [request(step, goal_image=image(100)) for step in (0, 1, 0)]
    lines = recorded(tmp_path / "record", session(), asked)
    assert [(line["episode"], line["decision"]) for line in lines] == [(1, 0), (1, 1), (1, 2)]
    for line, message in zip(lines, asked, strict=True):
        words = line["plan"]
        np.testing.assert_array_equal(
            read_image(tmp_path / "record" / option(words, "--start")[0]), message["observation/image"]
        )
        np.testing.assert_array_equal(read_image(tmp_path / "record" / option(words, "--goal")[0]), image(100))
        state = next(word for word in words if word.startswith("--state=")).removeprefix("--state=")
        assert [float(number) for number in state.split(",")] == STATE.tolist()
        assert np.shape(line["answer"]["actions"]) == (2, 7)
    assert [option(line["plan"], "--seed") for line in lines] == [["0"], ["1"], ["2"]]
    assert len(list((tmp_path / "record" / IMAGES).iterdir())) == 3, "each picture once"
    assert json.loads((tmp_path / "record/server.json").read_text())["format"] == 1


def test_of_goals_in_order_those_that_are_left_are_recorded_with_their_steps(tmp_path: Path) -> None:
    lines = recorded(
        tmp_path / "r", session(goals=STAGES, horizon=2), [request(step, prompt="stages") for step in range(6)]
    )
    goals = [len(option(line["plan"], "--goal")) for line in lines]
    assert goals == [3, 3, 2, 2, 2, 1]
    assert [option(line["plan"], "--durations") for line in lines] == [["2,3"], ["1,3"], ["3"], ["2"], ["1"], []]
    modes = [[word for word in line["plan"] if "gripper_mode" in word] for line in lines]
    assert modes == [
        [f"planning.limits.gripper_mode={mode}"] for mode in ("held", "held", "close", "close", "close")
    ] + [[]]


@pytest.mark.parametrize("changes", [{"context": 2}, {"warm_start": True}])
def test_what_depends_on_decisions_before_it_is_not_said_to_be_repeatable(tmp_path: Path, changes: dict) -> None:
    lines = recorded(
        tmp_path / "record", session(**changes), [request(step, goal_image=image(100)) for step in range(2)]
    )
    assert lines[0]["plan"]
    assert lines[1]["plan"] is None
    assert lines[1]["answer"]["why"] == "planned"


def test_a_mask_is_recorded(tmp_path: Path) -> None:
    mask = np.zeros((48, 60), dtype=bool)
    mask[:20, :30] = True
    (line,) = recorded(tmp_path / "record", session(), [request(0, goal_image=image(100), goal_mask=mask)])
    np.testing.assert_array_equal(read_image(tmp_path / "record" / option(line["plan"], "--mask")[0])[..., 0] > 0, mask)


def test_a_record_ends_at_its_size_and_the_server_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    one = session()
    with caplog.at_level(logging.WARNING):
        lines = recorded(tmp_path / "record", one, [request(step, goal_image=image(100)) for step in range(8)], 60_000)
    assert 0 < len(lines) < 8
    assert caplog.text.count("has reached its size") == 1
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


def test_a_record_does_not_write_into_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old/notes").write_text("mine")
    for place in (tmp_path / "old", tmp_path / "old/notes"):
        with pytest.raises(InputError, match="old"):
            Recorder(place, {}, 1000)
    assert (tmp_path / "old/notes").read_text() == "mine"


def test_a_dry_run_records_what_would_have_been_done(tmp_path: Path) -> None:
    dry = Session(controller(), None, SessionOptions(dry_run=True))
    (line,) = recorded(tmp_path / "record", dry, [request(0, goal_image=image(100))])
    assert not np.any(line["answer"]["actions"])
    assert line["answer"]["planned"][0][:3] != STATE[:3].tolist()


def test_a_stop_between_a_search_and_its_answer_leaves_the_numbers_of_later_decisions_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = session()
    one.recorder = Recorder(tmp_path / "record", {}, 10**8)
    act = one.controller.act

    def stopped_at_the_end(*seen: object, **how: object) -> object:
        try:
            return act(*seen, **how)
        finally:
            one.stopped.set()

    whys = []
    for step in range(3):
        with monkeypatch.context() as patch:
            if step == 1:
                patch.setattr(one.controller, "act", stopped_at_the_end)
            whys.append(unpack(one.answer(pack(request(step, goal_image=image(100)))))["why"])
        one.stopped.clear()
    assert whys == ["planned", "stopped by the page", "planned"]
    lines = lines_of(tmp_path / "record")
    assert [(line["decision"], option(line["plan"], "--seed")) for line in lines] == [(0, ["0"]), (2, ["2"])]


def test_a_frame_that_cannot_be_used_is_recorded_without_words_of_plan(tmp_path: Path) -> None:
    asked = [request(0, goal_image=image(100)), request() | {"observation/image": np.zeros_like(image(0))}]
    lines = recorded(tmp_path / "record", session(), asked)
    assert [(line["answer"]["why"], line["plan"] is None) for line in lines] == [
        ("planned", False),
        ("uniform frame", True),
    ]
