"""A served robot can be watched and stopped: zeros until the server's side releases it, and no robot pays for it."""

import json
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import InvalidStatus

from browser import browser
from random_decoder import write_decoder
from served import STATE, Running, controller, ended, image, request, serving, session, started
from tiny_models import tiny_model
from vjepa2_ac.decoding.decoder_folder import load_decoder
from vjepa2_ac.explore import watch as watching
from vjepa2_ac.explore.watch import WatchPage
from vjepa2_ac.serving.session import STOPPED, Session
from vjepa2_ac.serving.wire import PlanningClient, pack, unpack
from windows import chromium, header, watched

GOAL = image(100)


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def running(lines: list[str], tmp_path: Path) -> Iterator[Running]:
    decoder = load_decoder(write_decoder(tmp_path / "decoder", tiny_model()))
    with serving(session, watch=WatchPage("the run", decoder, lines.append)) as one:
        yield one


def page(running: Running, origin: str | None = None, path: str = "/watch/socket") -> Any:
    own = running.http if origin is None else origin
    return websockets.sync.client.connect(running.url + path, origin=own, max_size=None, proxy=None)  # type: ignore[arg-type]


def until(page: Any, is_it: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    while not is_it(found := header(page.recv(timeout=60))):
        pass
    return found


def test_a_page_sees_every_newest_decision(running: Running) -> None:
    with page(running) as seen, PlanningClient(running.url) as robot:
        assert header(seen.recv())["kind"] == "hello"
        for number in range(2):
            sent = robot.infer(request(number, goal_image=GOAL))
            told = until(seen, lambda one: one["kind"] == "decision")
            assert told["number"] == number
            np.testing.assert_allclose(told["action"], sent["actions"][0], rtol=1e-6)
            assert told["energy"] == sent["energy"]
            assert [one["name"] for one in told["images"]] == ["camera", "goal", "imagined"]
        with pytest.raises(Exception, match="frame"):
            robot.infer(request(0) | {"observation/image": image(3, 24, 32)})
        assert until(seen, lambda one: one["kind"] == "status" and one["refused"] == 1)["robot"]


def test_stop_makes_zeros_for_this_robot_and_the_next_until_the_server_releases_it(
    running: Running, lines: list[str]
) -> None:
    with page(running) as seen:
        with PlanningClient(running.url) as robot:
            assert np.abs(robot.infer(request(0, goal_image=GOAL))["actions"]).max() > 0
            seen.send(json.dumps({"seq": 5, "kind": "stop"}))
            assert until(seen, lambda one: one["kind"] == "stop")["seq"] == 5
            stopped = robot.infer(request(1))
            assert stopped["why"] == STOPPED
            assert not stopped["actions"].any()
            told = until(seen, lambda one: one["kind"] == "decision" and one["why"] == STOPPED)
            assert not any(told["action"])
        assert "kill -USR1" in lines[0]
        with PlanningClient(running.url) as robot:
            assert not robot.infer(request(0, goal_image=GOAL))["actions"].any()
            running.server.release()
            assert robot.infer(request(0))["actions"].any()
            assert until(seen, lambda one: one["kind"] == "status" and not one["stopped"])


def test_a_search_in_progress_is_stopped() -> None:
    one, begun = session(), threading.Event()
    plan = one.controller.planner.plan

    def slow(*words: Any) -> Any:
        begun.set()
        one.stopped.wait(60)
        return plan(*words)

    one.controller.planner.plan = slow  # type: ignore[method-assign]
    answers: list[Any] = []
    asking = threading.Thread(target=lambda: answers.append(one.answer(packed_request())))
    asking.start()
    assert begun.wait(60)
    one.stopped.set()
    asking.join(60)
    assert unpack(answers[0])["why"] == STOPPED
    assert not unpack(answers[0])["actions"].any()


def packed_request() -> bytes:
    return pack(request(0, goal_image=GOAL))


def test_a_stop_that_comes_after_the_search_is_in_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    one = session()
    checked = Session._checked

    def late(self: Session, state: np.ndarray) -> Any:
        found = checked(self, state)
        self.stopped.set()
        return found

    monkeypatch.setattr(Session, "_checked", late)
    found = unpack(one.answer(packed_request()))  # type: ignore[arg-type]
    assert (found["why"], found["actions"].any()) == (STOPPED, False)


@pytest.mark.parametrize(
    ("path", "origin"), [("/watch/socket", "http://evil.example"), ("/watch/socket", "null"), ("", "http://127.0.0.1")]
)
def test_a_page_of_somebody_else_gets_nothing(running: Running, path: str, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        page(running, origin, path)
    assert refused.value.response.status_code == 403


def test_without_watch_there_is_no_such_page() -> None:
    with serving(session) as running, pytest.raises(InvalidStatus) as refused:
        page(running)
    assert refused.value.response.status_code in {403, 404}


def test_nothing_is_drawn_while_nobody_looks_and_a_failing_decoder_costs_the_robot_nothing(
    running: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    drawn: list[int] = []

    def failing(*_: Any) -> Any:
        drawn.append(1)
        raise RuntimeError("no such image")

    monkeypatch.setattr(watching, "shown", failing)
    own = controller()
    own.reset(GOAL)
    with PlanningClient(running.url) as robot:
        np.testing.assert_array_equal(robot.infer(request(0, goal_image=GOAL))["actions"][0], own.act(image(0), STATE))
        assert not drawn
        with page(running) as seen:
            told = until(seen, lambda one: one["kind"] == "decision")
        assert drawn
        assert [one["name"] for one in told["images"]] == ["camera", "goal"]
        np.testing.assert_array_equal(robot.infer(request(1))["actions"][0], own.act(image(1), STATE))
    assert "no such image" in caplog.text


@pytest.mark.parametrize("message", ["", "[]", "{", "[" * 5000, '{"kind": "go"}', b"\x00\xff"])
def test_what_is_no_stop_is_nothing(running: Running, message: str | bytes) -> None:
    with page(running) as seen, PlanningClient(running.url) as robot:
        seen.send(message)
        assert robot.infer(request(0, goal_image=GOAL))["actions"].any()


def test_the_command_serves_the_page_and_a_signal_releases_it() -> None:
    process, url = started("builtin:sim-tiny", "data.stride=4", "--watch", "--decoder", "builtin:sim-tiny",
                           "planning.samples=8", "planning.iterations=1", "planning.cem.elites=4")  # fmt: skip
    running = Running(url, None)  # type: ignore[arg-type]
    with page(running) as seen:
        seen.send(json.dumps({"seq": 1, "kind": "stop"}))
        until(seen, lambda one: one["kind"] == "status" and one["stopped"])
        process.send_signal(signal.SIGUSR1)
        until(seen, lambda one: one["kind"] == "status" and not one["stopped"])
    assert "released" in ended(process)


def test_a_person_sees_a_decision_and_stops_it_in_a_browser(running: Running) -> None:
    browser()
    with chromium() as started_one, PlanningClient(running.url) as robot:
        seen, wrong = watched(started_one.new_context(viewport={"width": 390, "height": 844}))
        seen.goto(f"{running.http}/watch/")
        seen.wait_for_function("() => !document.querySelector('[data-role=stop]').disabled")
        robot.infer(request(0, goal_image=GOAL))
        seen.locator('[data-role="imagined"]').wait_for(state="visible")
        assert "Decision 1, planned" in seen.locator('[data-role="sentence"]').inner_text()
        assert seen.evaluate("document.documentElement.scrollWidth") <= 390
        seen.keyboard.press("Escape")
        seen.locator('[data-role="stopped"]').wait_for(state="visible")
        assert not robot.infer(request(1))["actions"].any()
        running.server.release()
        seen.locator('[data-role="stopped"]').wait_for(state="hidden")
        assert not wrong


def test_a_page_that_leaves_disturbs_nobody(running: Running) -> None:
    with PlanningClient(running.url) as robot:
        for number in range(3):
            with page(running) as seen:
                seen.recv()
            assert robot.infer(request(number, goal_image=GOAL))["actions"].any()
