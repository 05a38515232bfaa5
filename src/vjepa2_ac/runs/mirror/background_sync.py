"""Background upload of a run to `checkpoint.remote`.

A thread brings the place up to date (`runs.mirror.upload`); the training loop only calls it, step by step, to mark the
time. Nothing that happens there stops the run. An outage is warned of once, however long it is; and files that are only
on this machine in the end, once more.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from vjepa2_ac.config import CheckpointConfig
from vjepa2_ac.errors import RefusedError, UnreachableError, UserError
from vjepa2_ac.runs.checkpoint import CHECKPOINTS
from vjepa2_ac.runs.mirror.upload import LostPlaceError, RemoteUpdate
from vjepa2_ac.storage.retries import quietly

logger = logging.getLogger(__name__)

LONGEST_WAIT_S = 3600.0  # for the mirror at the end of a run
_LOOK_EVERY_S = 0.1  # whether the machine is about to stop


class Mirror:
    """Keeps another place in sync with a run's folder: in the background, one upload at a time.

    Args:
        update: What is brought up to date.
        config: How often, and how long the run waits for it in the end.
        outage_reported: Whether the user was already warned that the place cannot be reached.
        now_s: Returns the time in seconds, from any origin.
    """

    def __init__(
        self,
        update: RemoteUpdate,
        config: CheckpointConfig,
        *,
        outage_reported: bool = False,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._update, self._config = update, config
        self._outage_reported, self._now_s = outage_reported, now_s
        self._thread: threading.Thread | None = None
        self._is_ending, self._has_ended = threading.Event(), threading.Event()
        self._begun_s, self._is_lost = -float("inf"), False
        self._aim: str | None = None  # the newest local checkpoint when the thread started
        self._sent: str | None = None  # the newest remote one

    def tick(self) -> None:
        """Start an upload if it is due and there is something new; takes next to no time.

        The first checkpoint of a start is sent at once.
        """
        due = self._now_s() - self._begun_s >= 60.0 * self._config.remote_every_minutes
        if due and not self.is_sending and self._update.newest_here() != self._sent:
            self._begin()

    @property
    def is_sending(self) -> bool:
        """Whether an upload is in progress."""
        return self._thread is not None and self._thread.is_alive()

    def finish(self, is_asked_to_stop: Callable[[], bool]) -> None:
        """Upload the newest files, and wait for that; warn if the place is not up to date then.

        Args:
            is_asked_to_stop: Whether the machine is about to stop: then the wait is `checkpoint.remote_wait_seconds`,
                else an hour.
        """
        self._is_ending.set()
        is_short, until_s = False, time.monotonic() + LONGEST_WAIT_S
        for is_last in (False, True):  # the current upload ends, or breaks off if there is a newer one
            if is_last and not self.is_sending:
                self._begin()
            while self._thread and self.is_sending and time.monotonic() < until_s:
                if not is_short and is_asked_to_stop():
                    is_short, until_s = True, time.monotonic() + self._config.remote_wait_seconds
                self._thread.join(_LOOK_EVERY_S)
        in_time = not self.is_sending
        self._has_ended.set()
        if not self._is_lost and not (in_time and self._sent == self._update.newest_here()):
            logger.warning(
                "%s has checkpoints up to %s; what %s has after that is on this machine only%s. A next start sends it",
                self._update.place, self._sent or "those of earlier starts", self._update.folder / CHECKPOINTS,
                "" if in_time else ": there was no more time",
            )  # fmt: skip

    def __enter__(self) -> Mirror:
        """Return the mirror."""
        return self

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        """Stop uploading; if the run ends with an error, upload what exists first."""
        if isinstance(error, Exception) and not self._has_ended.is_set():
            self.finish(lambda: True)
        self._has_ended.set()

    def _begin(self) -> None:
        self._begun_s, self._aim = self._now_s(), self._update.newest_here()
        if not self._is_lost:
            self._thread = threading.Thread(target=self._send, name="mirror", daemon=True)
            self._thread.start()

    def _send(self) -> None:
        try:
            with quietly():
                self._sent = self._update(self._go_on)
            self._outage_reported = False
        except _BrokenOffError:
            pass
        except LostPlaceError as error:
            self._is_lost = True
            logger.warning("checkpoint.remote: %s", error)
        except (UserError, OSError) as error:
            log = logger.info if self._outage_reported else logger.warning
            log(
                "checkpoint.remote is not up to date: %s. Training continues; next attempt in %g minutes",
                reason_of(error), self._config.remote_every_minutes,
            )  # fmt: skip
            self._outage_reported = True
        except Exception:  # no error here may stop the run
            logger.exception("checkpoint.remote: %s is not up to date; training goes on", self._update.place)
        finally:
            self._update.release()

    def _go_on(self) -> None:
        """Cancel the upload if the run has ended, or is ending and has a newer checkpoint."""
        if self._has_ended.is_set() or (self._is_ending.is_set() and self._update.newest_here() != self._aim):
            raise _BrokenOffError


def reason_of(error: Exception) -> str:
    """Return why a place is not up to date; with a fix only if the reason is permanent."""
    if isinstance(error, UnreachableError) and not isinstance(error, RefusedError):
        return f"{error.where}: {error.found}"
    return str(error).rstrip(".")


class _BrokenOffError(Exception):
    """The current upload is no longer needed."""
