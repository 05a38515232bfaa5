"""A wall clock that jumps by a day, as on a machine that wakes up or asks for the time late, changes nothing."""

import ast
import os
import time
from pathlib import Path

import pytest

from paths import ROOT
from vjepa2_ac.storage.files import remove_abandoned

SOURCE = ROOT / "src/vjepa2_ac"
DAY_S = 86_400.0
WALL = {"time", "time_ns", "now", "today", "utcnow"}
AGES_OF_FILES = {"storage/files.py"}  # which only the wall clock tells


def asks_for_the_wall_clock(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in WALL
        and isinstance(node.func.value, ast.Name) and node.func.value.id in {"time", "datetime", "date"}
    )  # fmt: skip


def test_nothing_waits_or_is_due_by_the_wall_clock() -> None:
    asking = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        if any(map(asks_for_the_wall_clock, ast.walk(ast.parse(path.read_text()))))
    }
    assert asking == AGES_OF_FILES


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
