"""Does a lower error plan better? Narrow and varied demonstrations, and every checkpoint in closed loop.

    python benchmarks/trap                          # all of it (make trap); goes on where it stopped
    python benchmarks/trap --only narrow --seeds 1  # a part of it
    python benchmarks/trap --table                  # table and picture again, of what is there

Checkpoints that are measured stand in OUT/trap.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from runs import Cell, Run, all_runs, cells_of


def main() -> int:
    """Do what is not there yet, then write table and picture; return 1 where something failed."""
    options = _parse()
    from tables import write_tables

    failed = 0
    if not options.table:
        failed = _run_all([run for run in all_runs(options.seeds) if options.only in run.name], options)
    write_tables(options.out, options.picture)
    return 1 if failed else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("trap"), help="data and runs")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="where figures and tables go")
    parser.add_argument("--picture", type=Path, help="where the picture goes")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--goals", type=int, default=20, help="of each checkpoint")
    parser.add_argument("--workers", type=int, default=2, help="at once, one thread each")
    parser.add_argument("--only", default="", help="runs whose name has this in it")
    parser.add_argument("--table", action="store_true", help="run nothing")
    return parser.parse_args()


def _run_all(runs: Sequence[Run], options: argparse.Namespace) -> int:
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from cell_processes import in_processes
    from runs import measure_alone, prepare, train_alone
    from tables import read_cells, write_cells

    prepare(options.folder)
    known = read_cells(options.out)
    missing = [cell for run in runs for cell in cells_of(run) if cell.name not in known]
    print(f"{len(runs)} runs; {len(missing)} checkpoints are to be measured", flush=True)

    def keep(cell: Cell, figures: dict[str, Any]) -> None:
        write_cells(options.out, read_cells(options.out) | {cell.name: figures})
        ends = [way[-1] for way in figures["distance_cm"]]
        rank, error = (figures["validation"][key] for key in ("action_ranking_error", "rollout_over_persistence_last"))
        print(f"{cell.name}: error {error:.3f}, rank {rank:.3f}, {sum(ends) / len(ends):.1f} cm left", flush=True)

    failed = 0
    for some in _in_turn(list({cell.run.name: cell.run for cell in missing}.values()), options.workers):
        failed += in_processes(train_alone, [(run, options.folder) for run in some], options.workers, lambda *_: None)
        work = [(cell, options.folder, options.goals) for cell in missing if cell.run in some]
        failed += in_processes(measure_alone, work, options.workers, keep)
    return failed


def _in_turn(runs: Sequence[Run], at_once: int) -> list[Sequence[Run]]:
    """Return the runs in parts, so that what matters most is measured before the rest is trained."""
    return [runs[first : first + at_once] for first in range(0, len(runs), at_once)]


if __name__ == "__main__":
    sys.exit(main())
