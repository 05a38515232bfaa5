"""Retries of network operations: which failures are temporary, how long to wait, and when to give up."""

from __future__ import annotations

import json
import logging
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

from vjepa2_ac.errors import RefusedError, UnreachableError, UserError, counted

logger = logging.getLogger(__name__)

_T = TypeVar("_T")

# 499: when a part of an upload fails, gcsfs cancels the upload and raises the status of the cancellation.
_TEMPORARY_STATUS = frozenset({408, 425, 429, 499, *range(500, 600)})
_NO_ACCESS = frozenset({401, 403, 407})
_MISSING_ERRORS = (FileNotFoundError, IsADirectoryError, NotADirectoryError)
_MAX_SUMMARY_LENGTH = 300
_FAILURES_BEFORE_WARNING = 3
_WARNING_INTERVAL_S = 30.0


@dataclass(frozen=True)
class RetryPolicy:
    """Limits of retries: at most `attempts` attempts of `timeout_s` each, with waits between them.

    The waits double from `first_wait_s` to `longest_wait_s`. Up to half of each wait is random, so that many processes
    do not retry at the same moment. An attempt takes longer in a library without time-outs or with its own retries
    (huggingface_hub: six). No attempt starts after `total_s`.
    """

    attempts: int = 8
    first_wait_s: float = 0.5
    longest_wait_s: float = 16.0
    timeout_s: float = 30.0
    total_s: float = 300.0

    def wait_s(self, failures: int) -> float:
        """Return the wait in seconds after the given number of failures in a row."""
        longest: float = min(self.first_wait_s * 2 ** (failures - 1), self.longest_wait_s)
        return (
            longest * (1 + secrets.randbelow(1001) / 1000) / 2
        )  # `secrets` leaves the seeded random generators unchanged


DEFAULT = RetryPolicy()  # takes at most 1 minute if attempts fail immediately, 5 minutes if the server never responds


def call_with_retries(
    where: str,
    action: Callable[[float], _T],
    *,
    policy: RetryPolicy,
    access: str,
    operation: str = "read",
    progress: Callable[[], int] = lambda: 0,
) -> _T:
    """Call an action, retry it after temporary failures, and return its result.

    Args:
        where: What is read or written, for messages.
        action: Called with its time limit in seconds.
        policy: Number of attempts, waits and time limits.
        access: The fix if permission is missing, as a sentence.
        operation: "read" or "written", for messages.
        progress: Returns the progress of an action that can resume. Attempts and time are counted from zero after
            each attempt that made progress.

    Raises:
        InputError: Raised by the action, like any other `UserError`.
        OSError: There is no such file, or a file was expected instead of a folder, or a folder instead of a file.
        UnreachableError: All attempts failed; a RefusedError if permission is missing or the failure is permanent.
    """
    started, failures, last_progress = time.monotonic(), 0, progress()
    while True:
        try:
            return action(policy.timeout_s)
        except (*_MISSING_ERRORS, UserError):
            raise
        except Exception as error:
            if type(error).__module__ == "builtins" and not isinstance(error, OSError | ValueError | EOFError):
                raise  # a programming error such as a TypeError
            if not _is_temporary(error):
                is_denied = http_status(error) in _NO_ACCESS or _is_login_error(error)
                problem = f"{'no permission' if is_denied else f'cannot be {operation}'} ({_summary(error)})"
                fix = access if is_denied else "Check the URL"
                raise RefusedError(where=where, found=problem, fix=fix) from error
            if progress() > last_progress:
                started, failures = time.monotonic(), 0
            last_progress, failures = progress(), failures + 1
            wait_s, seconds = policy.wait_s(failures), time.monotonic() - started
            if failures >= policy.attempts or seconds + wait_s > policy.total_s:
                problem = f"{counted(failures, 'attempt')} in {seconds:.0f} s failed. Last error: {_summary(error)}"
                fix = "Check the network and run the command again; training resumes from the newest checkpoint"
                raise UnreachableError(where=where, found=problem, fix=fix) from error
            _log_failure(failures, "%s: %s. Next attempt in %.1f s", where, _summary(error), wait_s)
        time.sleep(wait_s)


@contextmanager
def suppress_retry_warnings() -> Iterator[None]:
    """Log retried failures in this thread at level INFO, for callers that can continue without the result."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


_quiet = ContextVar("_quiet", default=False)
_last_warning_s = [-_WARNING_INTERVAL_S]


def _log_failure(failures: int, text: str, *arguments: object) -> None:
    """Log a failure: as a warning from the third failure of a call, at most every 30 s, otherwise at level INFO."""
    now = time.monotonic()
    is_late = failures >= _FAILURES_BEFORE_WARNING and now - _last_warning_s[0] > _WARNING_INTERVAL_S
    is_warning = is_late and not _quiet.get()
    if is_warning:
        _last_warning_s[0] = now
    logger.log(logging.WARNING if is_warning else logging.INFO, text, *arguments)


def http_status(error: BaseException) -> int | None:
    """Return the HTTP status of an error from any client library, or None."""
    for holder in (error, getattr(error, "response", None)):
        for name in ("code", "status", "status_code"):
            status = getattr(holder, name, None)
            if isinstance(status, int | str) and str(status).isdigit():
                return int(status)
    is_forbidden = isinstance(error, PermissionError) or str(error).startswith("Forbidden")  # the text of gcsfs
    return 403 if is_forbidden else None


def _is_temporary(error: Exception) -> bool:
    status = http_status(error)
    if status is not None:
        return status in _TEMPORARY_STATUS
    if _is_login_error(error):
        return type(error).__name__ == "TransportError" or bool(getattr(error, "retryable", False))
    # A JSON error comes from a truncated listing. FileExistsError means that a precondition of the server failed.
    return isinstance(error, json.JSONDecodeError) or not isinstance(error, ValueError | FileExistsError)


def _is_login_error(error: Exception) -> bool:
    return type(error).__module__.startswith("google.auth") or "Credentials" in type(error).__name__


def _summary(error: Exception) -> str:
    """Return the message of a library's error on one line."""
    status = http_status(error)
    text = " ".join(str(getattr(error, "message", "") or error).split())
    text = text if len(text) <= _MAX_SUMMARY_LENGTH else f"{text[:_MAX_SUMMARY_LENGTH]}…"
    name = "time-out" if isinstance(error, TimeoutError) else type(error).__name__
    return ": ".join(part for part in (f"HTTP {status}" if status else name, text) if part)
