"""How much faster do processes that share an evaluation end? The same command, alone and on two cores.

    python benchmarks/shared_evaluation.py RUN [--processes 1 2] [options of evaluate]

Each process has one thread. Printed are seconds from start to end, in which loading is not shared, and the ratio to one
process; `metrics.json` of both are held against each other.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2], help="the first one is alone")
    options, more = parser.parse_known_args(arguments)
    print("| processes | seconds | times as fast | largest relative difference |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        alone, rows = 0.0, list[float]()
        for count in options.processes:
            out = Path(scratch) / f"{count}"
            seconds = _seconds(["evaluate", options.run, "--out", str(out), *more], count)
            written = json.loads((out / "metrics.json").read_text())["rows"]
            found = [row["value"] for row in written if row["value"] is not None]
            alone, rows = alone or seconds, rows or found
            off = max(abs(one - other) / max(abs(one), 1e-9) for one, other in zip(rows, found, strict=True))
            print(f"| {count} | {seconds:.1f} | {alone / seconds:.2f} | {off:.1e} |", flush=True)


def _seconds(words: Sequence[str], processes: int) -> float:
    from ranks import finish, free_port, start_rank

    port, began = free_port(), time.monotonic()
    finish([start_rank(["-m", "vjepa2_ac.cli", *words], rank, processes, port) for rank in range(processes)], 0, 3600.0)
    return time.monotonic() - began


if __name__ == "__main__":
    main()
