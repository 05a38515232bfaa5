"""Run a third-party world as a program: lines in and out within limits of time and size, and no orphan process."""

from __future__ import annotations

import json
import os
import select
import shlex
import signal
import sys
import time
from contextlib import ExitStack, suppress
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from threading import Thread
from typing import Any

from vjepa2_ac.errors import InputError

_ANSWER_S = 120.0
LOADING = 5  # the first answer may take this many times as long
_ENDS_S = 10.0  # time that a world has to exit when its input has ended
_MOST_BYTES = 64 << 20  # of a line: an image of 16 million pixels in base64
_MOST_SHOWN = 200  # bytes of a wrong line
_ERROR_BYTES, _ERROR_LINES = 64 << 10, 5  # of the error output: kept, and shown
_KEEPER = "import os, sys; world = int(sys.stdin.readline()); sys.stdin.read(); os.killpg(world, 9)"
PROTOCOL = "docs/worlds.md has the protocol; examples/worlds programs that follow it"


class WorldProcess(ExitStack):
    """A program that answers each line of its input with one line; `close` ends it and every process of its group.

    A second process, the keeper, kills the group when this process dies, even by SIGKILL: the keeper's input ends then,
    because only this process can write to it. Unlike prctl(PR_SET_PDEATHSIG) this works on every Unix, whatever thread
    started the world, and reaches the children of a shell.

    Args:
        command: The program and its arguments, as in a shell.
        timeout_s: Longest wait for an answer; for the first one, which includes loading, `LOADING` times as long. None:
            120 seconds.

    Raises:
        InputError: The program cannot be started.
    """

    def __init__(self, command: str, timeout_s: float | None = None) -> None:
        super().__init__()
        self.where, self._timeout_s, self._errors = f"--world {command!r}", timeout_s or _ANSWER_S, b""
        try:
            keeper = self._started([sys.executable, "-I", "-S", "-c", _KEEPER], DEVNULL)
            self.callback(keeper.kill)
            self._process = self._started(shlex.split(command) or [""], PIPE)
        except (OSError, ValueError) as error:
            self.close()
            raise self.refused(f"it cannot be started: {error}") from None
        keeper.stdin.write(b"%d\n" % self._process.pid)
        os.set_blocking(self._process.stdin.fileno(), False)
        self._output, self._poll = self._process.stdout.fileno(), select.poll()
        self._poll.register(self._output, select.POLLIN)
        self._reader = Thread(target=self._read_errors, daemon=True)
        self._reader.start()
        self.callback(self._end)

    def exchange(self, request: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send a request and return its answer; None: return what the program writes at its start.

        Raises:
            InputError: There is no answer in time, or it is no JSON object, or an error, or not the only one.
        """
        if request is not None:
            self._send(f"{json.dumps(request)}\n".encode())
        line = self._line(self._timeout_s * (LOADING if request is None else 1))
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):
            raise self.refused(f"it wrote {_shown(line)}", "a JSON object in a line") from None
        if not isinstance(answer, dict) or "error" in answer:
            raise self.refused(str(answer["error"] if isinstance(answer, dict) else answer))
        return answer

    def refused(self, found: str, needed: str = "", fix: str = PROTOCOL) -> InputError:
        """Return an error that names the command of this world."""
        return InputError(where=self.where, found=found, needed=needed, fix=fix)

    def _started(self, words: list[str], errors: int) -> Any:
        process = Popen(words, stdin=PIPE, stdout=PIPE, stderr=errors, bufsize=0, start_new_session=True)  # noqa: S603
        return self.enter_context(process)

    def _send(self, line: bytes) -> None:
        if self._poll.poll(0) and (unasked := os.read(self._output, _MOST_SHOWN)):
            raise self.refused(f"it wrote {_shown(unasked)} without a request", "one answer for each request")
        with suppress(BrokenPipeError):  # the program has ended, which `_line` reports
            if self._process.stdin.write(line) is None:  # written as a whole or not at all: it is below PIPE_BUF
                raise self.refused("it does not read its requests", "one answer for each request")

    def _line(self, limit_s: float) -> bytes:
        """Return the next line of the program's output.

        Raises:
            InputError: It does not end in time, or is too long, or is not the last one, or the output has ended.
        """
        parts, end_s = [b""], time.monotonic() + limit_s
        while b"\n" not in parts[-1]:
            if not self._poll.poll(1000 * max(0.0, end_s - time.monotonic())):
                now = f"now {self._timeout_s:g} s, and {LOADING} times as long for the first answer"
                raise self._with_errors(f"no answer within {limit_s:g} s", f"Raise --world-timeout ({now})")
            parts.append(os.read(self._output, 1 << 20))
            if not parts[-1]:
                with suppress(TimeoutExpired):
                    self._process.wait(min(_ENDS_S, self._timeout_s))
                    self._reader.join(1.0)
                status = self._process.returncode
                ended = "closed its output" if status is None else f"ended with status {status}"
                raise self._with_errors(f"it has {ended}")
            if sum(map(len, parts)) > _MOST_BYTES:
                raise self.refused(f"a line of more than {_MOST_BYTES >> 20} MiB", "a JSON object in a line")
        line, _, rest = b"".join(parts).partition(b"\n")
        if rest:
            raise self.refused(f"it wrote {_shown(rest)} after its answer", "one answer for each request")
        return line

    def _with_errors(self, found: str, fix: str = PROTOCOL) -> InputError:
        lines = self._errors.decode(errors="replace").strip().splitlines()[-_ERROR_LINES:]
        return self.refused("\n".join([found, *(line[:_MOST_SHOWN] for line in lines)]) + "\n", fix=fix)

    def _read_errors(self) -> None:
        """Keep the end of the error output, so that neither memory nor disk fills, and the program never waits."""
        while part := self._process.stderr.read(_ERROR_BYTES):
            self._errors = (self._errors + part)[-_ERROR_BYTES:]

    def _end(self) -> None:
        self._process.stdin.close()
        self._process.stdout.close()
        with suppress(TimeoutExpired):
            self._process.wait(min(_ENDS_S, self._timeout_s))
        with suppress(OSError):  # no process of the group is left
            os.killpg(self._process.pid, signal.SIGKILL)
        self._reader.join(1.0)


def _shown(line: bytes) -> str:
    return repr(line[:_MOST_SHOWN].decode(errors="replace").strip())
