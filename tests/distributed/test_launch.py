"""Launcher variables that are left in the environment cause an error within seconds."""

import logging
import threading
from typing import Any

import pytest

from vjepa2_ac import distributed
from vjepa2_ac.errors import InputError, UnreachableError

VARIABLES = {"RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29511"}


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that sets launcher variables and replaces the rendezvous."""

    def launched(variables: dict[str, str], rendezvous: Any = None) -> None:
        for name in VARIABLES:
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(
            distributed, "rendezvous", rendezvous or (lambda *_, **__: pytest.fail("rendezvous was called"))
        )
        monkeypatch.setattr(distributed.torch.distributed, "init_process_group", lambda *_, **__: None)

    return launched


@pytest.mark.parametrize(
    "changes",
    [
        {"MASTER_ADDR": None},
        {"MASTER_PORT": "http"},
        {"RANK": "2"},
        {"RANK": "1", "WORLD_SIZE": None},
        {"WORLD_SIZE": "two"},
    ],
)
def test_incomplete_launcher_variables_raise(launched: Any, changes: dict[str, str | None]) -> None:
    variables = {name: value for name, value in (VARIABLES | changes).items() if value is not None}
    launched(variables)
    with pytest.raises(InputError, match="Unset RANK and WORLD_SIZE if you did not start several") as caught:
        distributed._join_process_group("gloo")
    assert all(f"{name}={value}" in str(caught.value) for name, value in variables.items())


class Store:
    def set_timeout(self, _: object) -> None: ...


@pytest.mark.parametrize(
    ("changes", "missing"),
    [
        ({"RANK": "1"}, "process 1 of 2"),
        ({"WORLD_SIZE": "4"}, "the other 3 of 4 processes"),
    ],
)
def test_missing_processes_are_reported_while_waiting(
    launched: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, changes: Any, missing: str
) -> None:
    reported = threading.Event()

    def rendezvous(*_: object, **__: object) -> Any:
        assert reported.wait(60)
        yield Store(), 0, 2

    launched(VARIABLES | changes, rendezvous)
    monkeypatch.setattr(distributed, "_REPORT_AFTER_S", 0.01)
    monkeypatch.setattr(distributed._log, "warning", lambda *words: (logging.warning(*words), reported.set()))
    distributed._join_process_group("gloo")
    (message,) = caplog.messages
    assert message.startswith(f"Waiting for {missing} at 127.0.0.1:29511. Unset RANK and WORLD_SIZE")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        ("Timed out after 601 seconds waiting for clients. 3/4 clients joined.", "Only 3 of 4 processes joined"),
        ("connection refused", "Not all 4 processes joined"),
    ],
)
def test_processes_that_never_join_raise(launched: Any, error: str, message: str) -> None:
    def rendezvous(*_: object, **__: object) -> Any:
        raise RuntimeError(error)
        yield

    launched(VARIABLES | {"WORLD_SIZE": "4"}, rendezvous)
    with pytest.raises(UnreachableError, match=f"processes of this run: {message} within 10 minutes"):
        distributed._join_process_group("gloo")
