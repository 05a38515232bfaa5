"""A wall clock that jumps by a day, as on a machine that wakes up or asks for the time late, changes nothing."""

import os
import time
from pathlib import Path

import pytest

from vjepa2_ac.storage.files import remove_abandoned

DAY_S = 86_400.0


@pytest.mark.parametrize("jump_s", [-DAY_S, 0.9 * DAY_S])
def test_what_another_machine_is_writing_stays_though_our_clock_has_jumped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump_s: float
) -> None:
    path = tmp_path / ".file.abcdef01.partial"
    path.write_bytes(b"half")
    now = time.time()
    os.utime(path, (now, now))
    monkeypatch.setattr(time, "time", lambda: now + jump_s)
    remove_abandoned(tmp_path)
    assert path.exists()
