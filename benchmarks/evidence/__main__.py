"""Does LoRA fine-tuning help? A base meets a shifted world: every method, side by side, on goals it was not chosen by.

    python benchmarks/evidence                          # all cells (make evidence); goes on where it stopped
    python benchmarks/evidence --only look --seeds 1    # a part of it
    python benchmarks/evidence --choose                 # the settings, on validation episodes and goals

Cells that are done stand in FOLDER/results as JSON; table and plot are made of whatever is there.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from pathlib import Path
from typing import Any

from cells import Cell, all_cells, candidate_cells
from other_worlds import TASKS


def main() -> int:
    """Run what is not there yet, then write the table and the plot; return 1 where a cell failed."""
    options = _parse()
    from prepare import prepare
    from results import read_results
    from table import place_in, write_tables

    folder, results = options.folder, options.folder / ("choosing" if options.choose else "results")
    if options.page:
        place_in(options.page)  # before the hours, not after them
    results.mkdir(parents=True, exist_ok=True)
    if options.table:
        write_tables(folder, options.out, options.page, options.done)
        return 0
    cells = list(candidate_cells() if options.choose else all_cells(options.seeds))
    cells = [cell for cell in cells if options.only is None or options.only in cell.name]
    for task in sorted({cell.shift for cell in cells if cell.shift in TASKS and not TASKS[cell.shift].is_there}):
        print(
            f"{task} is left out: make worlds/{TASKS[task].program} makes its environment (docs/worlds.md)", flush=True
        )
        cells = [cell for cell in cells if cell.shift != task]
    there = {one["cell"]["name"] for one in read_results(results, options.done)}
    missing = [cell for cell in cells if cell.name not in there]
    prepare(folder, {cell.shift for cell in missing}, options.seeds)
    print(f"{len(cells)} cells, {len(cells) - len(missing)} of them done", flush=True)
    failed = _run(missing, results, options)
    if not options.choose:
        write_tables(folder, options.out, options.page, options.done)
    return 1 if failed else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("evidence"), help="data, bases, runs, results")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="where table and plot go")
    parser.add_argument("--page", type=Path, help="a page whose short table is to be made anew")
    parser.add_argument("--seeds", type=int, default=5, help="at most; docs/evidence.md has those of each change")
    parser.add_argument("--goals", type=int, default=20, help="of each run; a row pools its seeds")
    parser.add_argument("--workers", type=int, default=2, help="cells at once, one thread each")
    parser.add_argument("--only", help="cells whose name has this in it")
    parser.add_argument("--choose", action="store_true", help="run what the learning rates were chosen from")
    parser.add_argument("--done", type=Path, help="an evidence.json whose cells are not run again")
    parser.add_argument("--table", action="store_true", help="make table and plot again, run nothing")
    return parser.parse_args()


def _run(cells: list[Cell], results: Path, options: argparse.Namespace) -> int:
    """Run cells, each in a process of its own; return how many failed."""
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from cell_processes import in_processes
    from measure import measure_alone
    from results import last, reached

    numbers = itertools.count(1)

    def keep(cell: Cell, figures: dict[str, Any]) -> None:
        path = _result(results, cell)
        path.with_suffix(".part").write_text(json.dumps(figures, indent=1))
        path.with_suffix(".part").rename(path)
        solved = reached(figures)
        error = f"error {last(figures):.3f}, " if "shifted" in figures else ""
        done = f"{next(numbers)}/{len(cells)} {cell.name}: {error}reached {sum(solved)}/{len(solved)}"
        print(f"{done}, {figures['minutes']:.1f} min", flush=True)

    work = [(cell, options.folder, options.goals, options.choose) for cell in cells]
    return in_processes(measure_alone, work, options.workers, keep)


def _result(results: Path, cell: Cell) -> Path:
    return results / f"{cell.name}.json"


if __name__ == "__main__":
    sys.exit(main())
