"""Check the types of the benchmarks: each folder is a program of its own, whose files import one another.

python scripts/check_benchmarks.py
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOOSELY = ("--follow-imports=silent", "--no-warn-return-any", "--allow-untyped-calls", "--no-warn-unused-ignores")


def main() -> int:
    """Return 1 where mypy finds something."""
    folder = ROOT / "benchmarks"
    programs = [sorted(map(str, folder.glob("*.py"))), *([str(one.parent)] for one in folder.glob("*/__main__.py"))]
    failed = 0
    for files in programs:
        path = os.pathsep.join(map(str, (folder, files[0], ROOT / "tests/support")))
        command = [sys.executable, "-m", "mypy", *LOOSELY, *files]
        failed |= subprocess.run(command, cwd=ROOT, env={**os.environ, "MYPYPATH": path}, check=False).returncode  # noqa: S603
    return int(failed != 0)


if __name__ == "__main__":
    sys.exit(main())
