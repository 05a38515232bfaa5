"""The server: it listens once the model is loaded, serves one robot at a time, and stays responsive while it plans."""

import asyncio
import contextlib
import http.client
import random
import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import websockets.asyncio.client
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidStatus

from ranks import wait_until
from served import STATE, ServerAddress, image, make_controller, request, serving, session
from vjepa2_ac.errors import InputError, UnreachableError
from vjepa2_ac.serving import access
from vjepa2_ac.serving.access import Access
from vjepa2_ac.serving.client import PlanningClient
from vjepa2_ac.serving.server import PlanningServer
from vjepa2_ac.serving.session import Session
from vjepa2_ac.serving.wire import pack, unpack

KEY = "correct-horse-battery-staple"


def get(server: ServerAddress, path: str, **headers: str) -> tuple[int, str]:
    host, port = server.http.removeprefix("http://").split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=120)
    try:
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        return response.status, response.read().decode()
    finally:
        connection.close()


@contextlib.contextmanager
def connect(server: ServerAddress, **options: object) -> Iterator[websockets.sync.client.ClientConnection]:
    with websockets.sync.client.connect(
        server.url, compression=None, max_size=None, proxy=None, **options
    ) as connection:
        yield connection


class SlowSession:
    """A session whose search ends when the test sets `go`, and which records when the client disconnects."""

    def __init__(self) -> None:
        self.session, self.is_planning, self.go, self.is_cancelled = (
            session(),
            threading.Event(),
            threading.Event(),
            threading.Event(),
        )
        plan = self.session.controller.planner.plan

        def slow_plan(*args: object) -> object:
            self.is_planning.set()
            while not self.go.is_set():
                if args[3]():
                    self.is_cancelled.set()
                    break
                time.sleep(0.005)
            return plan(*args)

        self.session.controller.planner.plan = slow_plan


def test_actions_received_over_the_socket_equal_those_of_the_controller() -> None:
    controller = make_controller()
    controller.reset(image(100))
    with serving(session) as server, PlanningClient(server.url) as client:
        for step in range(3):
            reply = client.infer(request(step, goal_image=image(100)))
            np.testing.assert_array_equal(reply["actions"][0], controller.act(image(step), STATE))
        with pytest.raises(InputError, match="frame: 32 x 24 pixels"):
            client.infer(request(3) | {"observation/image": image(3, 24, 32)})
        np.testing.assert_array_equal(client.infer(request(3))["actions"][0], controller.act(image(3), STATE))


def test_server_listens_only_after_the_model_is_loaded() -> None:
    stop, lines = asyncio.Event(), list[str]()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    def load() -> tuple[Session, dict]:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port))
        assert not lines
        return session(), {}

    def print_status(line: str) -> None:
        lines.append(line)
        stop.set()

    assert asyncio.run(PlanningServer(Access("127.0.0.1"), port, print_status).run(load, stop))
    assert lines == [f"listening on ws://127.0.0.1:{port}"]


def test_used_port_raises_before_and_after_loading() -> None:
    def load() -> tuple[Session, dict]:
        late_sockets.append(socket.create_server(("127.0.0.1", port)))
        return session(), {}

    late_sockets = list[socket.socket]()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    for _ in range(2):
        with pytest.raises(InputError, match=f"127.0.0.1:{port}: the server cannot listen"):
            asyncio.run(PlanningServer(Access("127.0.0.1"), port, print).run(load, asyncio.Event()))
    (late_socket,) = late_sockets
    late_socket.close()


def test_server_stopped_while_loading_does_not_listen() -> None:
    async def stop_while_loading() -> bool:
        stop = asyncio.Event()
        asyncio.get_running_loop().call_later(0.1, stop.set)
        return await PlanningServer(Access("127.0.0.1"), 0, print).run(lambda: (go.wait(120), session())[1:] * 2, stop)

    go = threading.Event()
    assert not asyncio.run(stop_while_loading()), "the planning thread has not ended"
    go.set()


def test_second_robot_is_rejected_until_the_first_disconnects() -> None:
    with serving(session) as server:
        first = PlanningClient(server.url)
        port = first._connection.local_address[1]
        with pytest.raises(UnreachableError, match=f"HTTP 503: busy: the robot at 127.0.0.1:{port} is connected"):
            PlanningClient(server.url)
        assert get(server, "/healzth")[0] == 404
        assert get(server, "/healthz")[0] == 200
        first.infer(request(0, goal_image=image(100)))
        first.close()
        wait_until(lambda: "vjepa2_ac_robots 0" in get(server, "/metrics")[1])
        with PlanningClient(server.url) as second, pytest.raises(InputError, match="no goal was set in this episode"):
            second.infer(request(1))


def test_pings_are_answered_during_a_long_decision() -> None:
    slow = SlowSession()

    async def ping_during_decision(url: str) -> None:
        async with websockets.asyncio.client.connect(url, compression=None, proxy=None) as connection:
            await connection.recv()
            await connection.send(pack(request(0, goal_image=image(100))))
            await asyncio.to_thread(slow.is_planning.wait, 120)
            for _ in range(3):
                await asyncio.wait_for(await connection.ping(), 120)
            slow.go.set()
            assert unpack(await connection.recv())["why"] == "planned"

    with serving(lambda: slow.session) as server:
        asyncio.run(ping_during_decision(server.url))


def test_disconnect_cancels_the_search_and_the_next_client_is_served() -> None:
    slow = SlowSession()
    with serving(lambda: slow.session) as server:
        with connect(server) as connection:
            connection.recv()
            connection.send(pack(request(0, goal_image=image(100))))
            assert slow.is_planning.wait(120)
        assert slow.is_cancelled.wait(120)
        slow.go.set()
        wait_until(lambda: "vjepa2_ac_robots 0" in get(server, "/metrics")[1])
        with PlanningClient(server.url) as client:
            assert client.infer(request(1, goal_image=image(100)))["why"] == "planned"


def test_server_shutdown_does_not_wait_for_a_decision() -> None:
    slow = SlowSession()
    with contextlib.ExitStack() as client:
        with serving(lambda: slow.session) as server:
            connection = client.enter_context(connect(server))
            connection.recv()
            connection.send(pack(request(0, goal_image=image(100))))
            assert slow.is_planning.wait(120)
        assert not slow.go.is_set()
        assert slow.is_cancelled.is_set()
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=120)


def test_key_is_required_for_robots_and_metrics_but_not_for_health_checks() -> None:
    with serving(session, Access("127.0.0.1", KEY)) as server:
        for key in (None, KEY + "x"):
            with pytest.raises(UnreachableError, match="HTTP 401: a valid key is required"):
                PlanningClient(server.url, key)
        assert get(server, "/metrics")[0] == 401
        assert get(server, "/metrics", Authorization=f"Api-Key {KEY}")[0] == 200
        assert get(server, "/healthz")[0] == 200
        with PlanningClient(server.url, KEY) as client:
            assert client.infer(request(0, goal_image=image(1)))["why"] == "planned"
        assert 'connections_refused_total{status="401"} 3' in get(server, "/metrics", Authorization=f"Api-Key {KEY}")[1]


def test_requests_from_web_pages_are_rejected() -> None:
    with serving(session) as server:
        for headers, status in (({"origin": "http://evil.example"}, 403), ({"origin": "null"}, 403)):
            with pytest.raises(InvalidStatus) as caught, connect(server, **headers):
                pass
            assert caught.value.response.status_code == status
        assert get(server, "/metrics", Host="evil.example")[0] == 403
        with connect(server) as connection:
            assert unpack(connection.recv()) == {}


def test_invalid_message_gets_an_error_and_the_next_request_is_served() -> None:
    valid, rng = bytearray(pack(request(0, goal_image=image(100)))), random.Random(0)  # noqa: S311
    with serving(session) as server, connect(server) as connection:
        connection.recv()
        connection.send("a text")
        assert connection.recv(timeout=120) == "received a text message. Expected a binary message in msgpack"
        for _ in range(300):
            mutated = bytearray(valid)
            for _ in range(rng.randint(1, 4)):
                mutated[rng.randrange(120)] = rng.randrange(256)
            connection.send(bytes(mutated[: rng.choice([len(mutated), rng.randrange(len(mutated))])]))
            reply = connection.recv(timeout=120)
            assert isinstance(reply, bytes) or (len(reply) < 1000 and "Traceback" not in reply)
        connection.send(bytes(valid))
        reply = unpack(connection.recv(timeout=120))
        assert reply["why"] == "planned"
        metrics = get(server, "/metrics")[1]
        assert "requests_failed_total 0" in metrics
        assert 'decisions_total{why="planned"} ' in metrics
        assert "decision_seconds_count" in metrics


def test_too_large_message_closes_the_connection_but_not_the_server() -> None:
    with serving(session) as server:
        with connect(server) as connection:
            connection.recv()
            with contextlib.suppress(ConnectionClosed, OSError):
                connection.send(bytes(33 << 20))
            with pytest.raises(ConnectionClosed) as caught:
                connection.recv(timeout=120)
        assert caught.value.rcvd is None or caught.value.rcvd.code == 1009
        wait_until(lambda: "vjepa2_ac_robots 0" in get(server, "/metrics")[1])
        with PlanningClient(server.url) as client:
            assert client.infer(request(0, goal_image=image(1)))["why"] == "planned"


def test_server_shutdown_does_not_wait_for_uncancellable_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "SHUTDOWN_TIMEOUT_S", 0.1)
    served, is_replying, go = session(), threading.Event(), threading.Event()
    served.reply_to = lambda *_: (is_replying.set(), go.wait(120))[1]
    with contextlib.ExitStack() as client:
        with serving(lambda: served) as server:
            connection = client.enter_context(connect(server))
            connection.recv()
            connection.send(pack(request(0, endpoint="score")))
            assert is_replying.wait(120)
        assert not go.is_set()
        go.set()


def test_client_timeout_raises_and_closes_the_connection() -> None:
    slow = SlowSession()
    with serving(lambda: slow.session) as server:
        client = PlanningClient(server.url, timeout_s=0.1)
        with pytest.raises(UnreachableError, match=r"no reply within 0\.1 s.*connect again"):
            client.infer(request(0, goal_image=image(100)))
        with pytest.raises(
            UnreachableError, match="the connection was lost"
        ):  # the late reply to the first request is not returned
            client.infer(request(1))
        assert slow.is_cancelled.wait(120)
        slow.go.set()


@pytest.mark.parametrize("deadline_s", [5.0, 300.0])
def test_client_timeout_is_longer_than_the_servers_deadline(deadline_s: float) -> None:
    with serving(session, metadata={"deadline_s": deadline_s}) as server, PlanningClient(server.url) as client:
        assert client._timeout_s == max(120.0, 2 * deadline_s)
