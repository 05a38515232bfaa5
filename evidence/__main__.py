"""Run the missing measurements of both studies, and write docs/evidence.md with its plots.

    python evidence --table                     # write tables and plots from results/*.json (make evidence)
    python evidence --only look --seeds 1       # run a part of the methods study; finished cells are skipped
    python evidence --study selection           # measure every checkpoint of 21 runs in closed loop

The methods study compares methods that adapt a base model to a changed scene. The selection study compares metrics that
select a checkpoint. A finished measurement is a JSON file in the work folder; the values that the tables need are
written to evidence/results.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run the missing measurements, then write tables and plots; return 1 if a cell failed."""
    options = _parse()
    failed = 0
    if not options.table:
        failed = (_run_methods if options.study == "methods" else _run_selection)(options)
    write(options.folder)
    return 1 if failed else 0


def write(folder: Path) -> None:
    """Write the results, tables and plots of all measurements."""
    import results
    import selection
    import selection_tables
    import tables

    kept, docs = results.KEPT, ROOT / "docs"
    of_methods = results.read_all(folder / "methods", kept / "methods.json", results.compact, results.name_of)
    results.write_all(kept / "methods.json", of_methods)
    tables.write_tables(of_methods, kept / "methods.md", docs / "evidence.md")
    tables.draw(of_methods, docs / "evidence.png")
    of_selection = results.read_all(folder / "selection", kept / "selection.json", selection.compact, selection.name_of)
    results.write_all(kept / "selection.json", of_selection)
    selection_tables.write_tables(of_selection, kept / "selection.md", docs / "ranking.png")
    print(f"docs/evidence.md and evidence/results: {len(of_methods)} cells, {len(of_selection)} checkpoints")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", choices=("methods", "selection"), default="methods")
    parser.add_argument(
        "--folder", type=Path, default=Path("build/evidence"), help="work folder: data, base models, runs, measurements"
    )
    parser.add_argument(
        "--seeds", type=int, default=5, help="largest number of seeds; docs/evidence.md has the number for each change"
    )
    parser.add_argument(
        "--goals", type=int, default=20, help="number of goals of each cell; a table row pools its seeds"
    )
    parser.add_argument(
        "--workers", type=int, default=2, help="number of cells that run in parallel, with one thread each"
    )
    parser.add_argument("--only", default="", help="run only cells whose name contains this text")
    parser.add_argument("--table", action="store_true", help="write tables and plots without running measurements")
    return parser.parse_args()


def _run_methods(options: argparse.Namespace) -> int:
    from environments import TASKS
    from measure import measure
    from methods import all_cells
    from prepare import prepare
    from results import KEPT, name_of

    cells = _missing(list(all_cells(options.seeds)), KEPT / "methods.json", name_of, options)
    absent = {cell.shift for cell in cells if cell.shift in TASKS and not TASKS[cell.shift].is_installed}
    for task in sorted(absent):
        fix = f"Run `make worlds/{TASKS[task].program}` (docs/worlds.md)"
        print(f"{task} is skipped: its environment is not installed. {fix}")
    cells = [cell for cell in cells if cell.shift not in absent]
    prepare(options.folder, {cell.shift for cell in cells}, options.seeds)
    return _in_processes(measure, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_selection(options: argparse.Namespace) -> int:
    from results import KEPT
    from selection import all_cells, measure_alone, name_of, prepare, train_alone

    cells = _missing(list(all_cells(min(options.seeds, 3))), KEPT / "selection.json", name_of, options)
    prepare(options.folder)
    runs = list({cell.run.name: cell.run for cell in cells}.values())
    failed = _in_processes(train_alone, [(run, options.folder) for run in runs], options)
    return failed + _in_processes(measure_alone, [(cell, options.folder, options.goals) for cell in cells], options)


def _missing(cells: list[Any], kept: Path, name_of: Callable[[Any], str], options: argparse.Namespace) -> list[Any]:
    """Return the cells without a measurement."""
    (options.folder / options.study).mkdir(parents=True, exist_ok=True)
    known = {path.stem for path in (options.folder / options.study).glob("*.json")}
    known |= {name_of(one) for one in json.loads(kept.read_text())}
    missing = [cell for cell in cells if options.only in cell.name and cell.name not in known]
    print(f"measuring {len(missing)} of {len(cells)} cells", flush=True)
    return missing


def _in_processes(do: Callable[..., Any], work: Sequence[tuple[Any, ...]], options: argparse.Namespace) -> int:
    """Run each call in a new process and write its result; return the number of failed calls.

    Raises:
        BrokenProcessPool: A process was killed, most likely because it used too much memory.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    context, failed = multiprocessing.get_context("spawn"), 0
    with ProcessPoolExecutor(options.workers, mp_context=context, max_tasks_per_child=1) as pool:
        waiting = {pool.submit(do, *one): one[0] for one in work}
        for number, done in enumerate(as_completed(waiting), start=1):
            name = waiting[done].name
            try:
                result = done.result()
            except BrokenProcessPool:
                raise
            except Exception as error:  # the other cells continue
                print(f"{name} failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
                failed += 1
                continue
            if result is not None:
                path = options.folder / options.study / f"{name}.json"
                path.with_suffix(".part").write_text(json.dumps(result, indent=1))
                path.with_suffix(".part").rename(path)
            print(f"{number}/{len(waiting)} {name}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
