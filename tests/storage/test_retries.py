"""Waits of retries: they grow, vary, and end."""

import json
import time

import pytest
from google.auth.exceptions import RefreshError

from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.storage import retries
from vjepa2_ac.storage.retries import RetryPolicy, with_retries

AT_ONCE = RetryPolicy(attempts=3, first_wait_s=0.0, longest_wait_s=0.0)


@pytest.mark.parametrize("error", [TypeError("ours"), KeyError("ours"), AssertionError("ours")])
def test_a_mistake_of_ours_is_neither_tried_again_nor_blamed_on_the_network(error: Exception) -> None:
    calls = []

    def action(timeout_s: float) -> None:
        calls.append(timeout_s)
        raise error

    with pytest.raises(type(error), match="ours"):
        with_retries("gs://a", action, policy=AT_ONCE, access="")
    assert calls == [AT_ONCE.timeout_s]


class StatusError(Exception):
    def __init__(self, status: int) -> None:
        super().__init__("as another library says it")
        self.response = type("Response", (), {"status_code": status})()


class NoCredentialsError(Exception):
    """As botocore says it."""


@pytest.mark.parametrize(
    ("error", "attempts", "words"),
    [
        (ConnectionResetError("gone"), 3, "not reached in 3 attempts"),
        (OSError(5, "of a library that we do not know"), 3, "not reached in 3 attempts"),
        (TimeoutError(), 3, "the last: time-out"),
        (StatusError(503), 3, "HTTP 503: as another library says it"),
        (json.JSONDecodeError("Unterminated string", '{"items": [{"na', 12), 3, "JSONDecodeError: Unterminated"),
        (RefreshError("the login service is down", retryable=True), 3, "the login service is down"),
        (RefreshError("invalid_grant: expired"), 1, "no permission.*expired.*Log in so"),
        (NoCredentialsError("none found"), 1, "no permission.*none found.*Log in so"),
        (StatusError(403), 1, r"no permission \(HTTP 403"),
        (PermissionError("not yours"), 1, "no permission.*Log in so"),
        (OSError("Forbidden: https://somewhere\nno"), 1, r"no permission \(HTTP 403: Forbidden.*Log in so"),
        (ValueError("Bad Request"), 1, "cannot be read.*Bad Request.*Check the address"),
    ],
)
def test_errors_of_any_library_are_told_apart(error: Exception, attempts: int, words: str) -> None:
    calls = []

    def action(timeout_s: float) -> None:
        calls.append(timeout_s)
        raise error

    with pytest.raises(UnreachableError, match=words) as caught:
        with_retries("gs://a", action, policy=AT_ONCE, access="Log in so")
    assert len(calls) == attempts
    assert caught.value.__cause__ is error
    assert "\n" not in str(caught.value)


def test_a_library_that_takes_long_over_each_attempt_is_not_asked_for_hours(monkeypatch: pytest.MonkeyPatch) -> None:
    now, calls = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def action(timeout_s: float) -> None:
        calls.append(timeout_s)
        now[0] += 80.0  # as huggingface_hub does where nothing answers
        raise ConnectionResetError

    with pytest.raises(UnreachableError, match="not reached in 4 attempts over 320 s"):
        with_retries("hf://a", action, policy=RetryPolicy(first_wait_s=0.0, total_s=300.0), access="")
    assert len(calls) == 4


def test_a_network_that_stays_away_is_spoken_of_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def action(_timeout_s: float) -> None:
        raise ConnectionResetError("gone")

    def spoken(attempts: int) -> int:
        caplog.clear()
        policy = RetryPolicy(attempts=attempts, first_wait_s=0.0, longest_wait_s=0.0)
        with pytest.raises(UnreachableError):
            with_retries("gs://a/b", action, policy=policy, access="")
        return sum(record.levelname == "WARNING" for record in caplog.records)

    monkeypatch.setattr(retries, "_last_warning_s", [float("-inf")])
    assert spoken(attempts=3) == 0  # two failures are nothing
    assert spoken(attempts=6) == 1
    assert spoken(attempts=6) == 0  # said already
