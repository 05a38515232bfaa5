"""Damage to files, as by disks, copies, editors and other users: missing permissions, changed bytes, failed writes."""

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

_READ_ANYTHING = 1 << 1 | 1 << 2  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH


@contextmanager
def without_permission(*paths: Path) -> Iterator[None]:
    """Remove all permissions of files or folders; root also gives up the right to read every file, in this thread."""
    modes = {path: path.stat().st_mode for path in paths}
    libc, header = ctypes.CDLL(None, use_errno=True), (ctypes.c_uint32 * 2)(0x20080522, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable, twice
    if os.geteuid() == 0:
        if sys.platform != "linux":
            pytest.skip("root may read every file here")
        assert libc.capget(header, sets) == 0
    effective = sets[0]
    for path in paths:
        path.chmod(0)
    try:
        sets[0] = effective & ~_READ_ANYTHING
        assert os.geteuid() or libc.capset(header, sets) == 0
        yield
    finally:
        sets[0] = effective
        assert os.geteuid() or libc.capset(header, sets) == 0
        for path, mode in modes.items():
            path.chmod(mode)


def mutated(data: bytes, generator: np.random.Generator) -> bytes:
    """Return bytes with one random damage: a flipped bit, a replaced, deleted, doubled or zeroed part, truncation."""
    start = int(generator.integers(len(data)))
    end = min(len(data), start + int(2 ** generator.uniform(0, 12)))
    middle = {
        "flip": bytes([data[start] ^ 1 << int(generator.integers(8))]) + data[start + 1 : end],
        "foreign": generator.bytes(end - start),
        "lost": b"",
        "twice": data[start:end] * 2,
        "blank": bytes(end - start),
        "cut": None,
    }[str(generator.choice(["flip", "foreign", "lost", "twice", "blank", "cut"]))]
    return data[:start] if middle is None else data[:start] + middle + data[end:]


class KilledError(BaseException):
    """Simulates that the process is killed; no clean-up code catches it."""


class Faults:
    """Makes the n-th operation that changes the disk fail, in any code."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.set()
        functions = [(os, name) for name in ("mkdir", "rename", "replace", "fsync")]
        for owner, name in [*functions, (Path, "write_text"), (Path, "write_bytes")]:
            monkeypatch.setattr(owner, name, self._failing(getattr(owner, name)))

    def set(self, number: int = -1, error: BaseException | None = None) -> None:
        """Restart the count of operations, and set the number of the operation that raises `error`."""
        self.num_operations, self._fails_at, self._error = 0, number, error

    def _failing(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(*arguments: Any, **options: Any) -> Any:
            self.num_operations += 1
            if self.num_operations == self._fails_at and self._error is not None:
                raise self._error
            return real(*arguments, **options)

        return operation
