"""Run the missing measurements of a study, and write docs/evidence.md with its plots.

    python evidence --table                     # write tables and plots from results/*.json (make evidence)
    python evidence --only look --seeds 1       # run a part of the methods study; finished cells are skipped
    python evidence --study selection           # measure every checkpoint of 21 runs in closed loop
    python evidence --study labs                # adapt to twelve random labs
    python evidence --study rates               # compare learning rates for the labs study in two other labs
    python evidence --study iterations          # compare searches of different sizes
    python evidence --study widths              # fine-tune predictors of three widths with several ranks
    python evidence --study bases               # adapt other base models, with random and pre-trained encoders
    python evidence --study variants            # compare six training losses
    python evidence --study predecessor --goals 7    # repeat the mistakes of a public fine-tuning

The methods study compares methods that adapt a base model to a changed scene. The selection study compares metrics that
select a checkpoint. The labs study asks whether adapting helps in a new lab, and whether the advice of the tool is
good. The rates study compares learning rates for the labs study on held-out episodes of other labs, without any goal.
The iterations study asks how many action sequences and iterations a decision needs. The widths study asks which rank
LoRA needs. The bases study asks whether the results depend on the base model and its encoder. The variants study
compares training losses. The predecessor study repeats the mistakes of a public fine-tuning. A finished measurement is
a JSON file in the work folder; the values that the tables need are written to evidence/results.
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
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
GOALS = {"iterations": 50}  # number of goals of each cell by study; 20 for the other studies


def main() -> int:
    """Run the missing measurements, then write tables and plots; return 1 if a cell failed."""
    options = _parse()
    failed = 0
    if not options.table:
        failed = STUDIES[options.study](options)
    write(options.folder)
    return 1 if failed else 0


def write(folder: Path) -> None:
    """Write the results, tables and plots of all measurements."""
    import bases
    import bases_tables
    import iterations
    import iterations_tables
    import labs
    import labs_tables
    import predecessor
    import predecessor_tables
    import rates
    import results
    import selection
    import selection_tables
    import tables
    import variants
    import variants_tables
    import widths
    import widths_tables

    stored, docs = results.RESULTS, ROOT / "docs"
    counts = []
    for study, compact, name_of, write_tables in (
        ("methods", results.compact, results.name_of, tables.write_tables),
        ("selection", selection.compact, selection.name_of, selection_tables.write_tables),
        ("labs", labs.compact, labs.name_of, labs_tables.write_tables),
        ("rates", labs.compact, rates.name_of, rates.write_tables),
        ("iterations", iterations.compact, iterations.name_of, iterations_tables.write_tables),
        ("widths", labs.compact, widths.name_of, widths_tables.write_tables),
        ("bases", labs.compact, bases.name_of, bases_tables.write_tables),
        ("variants", variants.compact, variants.name_of, variants_tables.write_tables),
        ("predecessor", predecessor.compact, predecessor.name_of, predecessor_tables.write_tables),
    ):
        measured = results.read_all(folder / study, stored / f"{study}.json", compact, name_of)
        if measured:
            results.write_all(stored / f"{study}.json", measured)
        write_tables(measured, stored / f"{study}.md", docs)
        counts.append(f"{study} {len(measured)}")
    print(f"docs/evidence.md and evidence/results: {', '.join(counts)} measurements")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", choices=tuple(STUDIES), default="methods")
    parser.add_argument(
        "--folder", type=Path, default=Path("build/evidence"), help="work folder: data, base models, runs, measurements"
    )
    parser.add_argument(
        "--seeds", type=int, default=5, help="largest number of seeds; docs/evidence.md has the number for each change"
    )
    parser.add_argument(
        "--goals", type=int, help="number of goals of each cell (20; 50 for iterations); a table row pools its seeds"
    )
    parser.add_argument(
        "--workers", type=int, default=2, help="number of cells that run in parallel, with one thread each"
    )
    parser.add_argument("--only", default="", help="run only cells whose name contains this text")
    parser.add_argument("--table", action="store_true", help="write tables and plots without running measurements")
    options = parser.parse_args()
    options.goals = options.goals or GOALS.get(options.study, 20)
    return options


def _run_methods(options: argparse.Namespace) -> int:
    from environments import TASKS
    from measure import measure
    from methods import all_cells
    from prepare import prepare
    from results import RESULTS, name_of

    cells = _missing(list(all_cells(options.seeds)), RESULTS / "methods.json", name_of, options)
    absent = {cell.shift for cell in cells if cell.shift in TASKS and not TASKS[cell.shift].is_installed}
    for task in sorted(absent):
        fix = f"Run `make worlds/{TASKS[task].program}` (docs/worlds.md)"
        print(f"{task} is skipped: its environment is not installed. {fix}")
    cells = [cell for cell in cells if cell.shift not in absent]
    prepare(options.folder, {cell.shift for cell in cells}, options.seeds)
    return _in_processes(measure, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_selection(options: argparse.Namespace) -> int:
    from results import RESULTS
    from selection import all_cells, measure_alone, name_of, prepare, train_alone

    cells = _missing(list(all_cells(min(options.seeds, 3))), RESULTS / "selection.json", name_of, options)
    prepare(options.folder)
    runs = list({cell.run.name: cell.run for cell in cells}.values())
    failed = _in_processes(train_alone, [(run, options.folder) for run in runs], options)
    return failed + _in_processes(measure_alone, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_labs(options: argparse.Namespace) -> int:
    from labs import PRETRAINED_PRIOR, all_cells, get_lab, measure, name_of, prepare, prepare_base_prior
    from results import RESULTS

    cells = _missing(list(all_cells()), RESULTS / "labs.json", name_of, options)
    if any(cell.method == PRETRAINED_PRIOR for cell in cells):
        prepare_base_prior(options.folder, options.workers)
    labs = {cell.lab: get_lab(cell.lab) for cell in cells}
    failed = _in_processes(prepare, [(lab, options.folder) for lab in labs.values()], options)
    return failed + _in_processes(measure, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_rates(options: argparse.Namespace) -> int:
    from labs import PRETRAINED_PRIOR, get_lab, prepare, prepare_base_prior
    from rates import LAB_NUMBERS, ON_BASE_DATA, all_cells, measure, name_of
    from results import RESULTS

    cells = _missing(list(all_cells()), RESULTS / "rates.json", name_of, options)
    if {PRETRAINED_PRIOR, ON_BASE_DATA} & {cell.method for cell in cells}:
        prepare_base_prior(options.folder, options.workers)
    labs = [get_lab(number) for number in LAB_NUMBERS if any(cell.lab == number for cell in cells)]
    failed = _in_processes(prepare, [(lab, options.folder) for lab in labs], options)
    return failed + _in_processes(measure, [(cell, options.folder) for cell in cells], options)


def _run_iterations(options: argparse.Namespace) -> int:
    from iterations import TASKS, all_cells, measure, name_of, prepare
    from results import RESULTS

    cells = _missing(list(all_cells()), RESULTS / "iterations.json", name_of, options)
    tasks = [TASKS[name] for name in dict.fromkeys(cell.task for cell in cells)]
    failed = _in_processes(prepare, [(task, options.folder) for task in tasks], options)
    return failed + _in_processes(measure, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_with_base_models(options: argparse.Namespace) -> int:
    """Run a study that trains its own base models."""
    from results import RESULTS

    study = import_module(options.study)
    cells = _missing(list(study.all_cells()), RESULTS / f"{options.study}.json", study.name_of, options)
    if not cells:
        return 0
    study.prepare_data(options.folder, options.workers)
    bases = list(dict.fromkeys(cell.base for cell in cells))
    failed = _in_processes(study.prepare, [(base, options.folder) for base in bases], options)
    return failed + _in_processes(study.measure, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_variants(options: argparse.Namespace) -> int:
    from results import RESULTS
    from variants import Seed, all_cells, measure, name_of, prepare

    cells = _missing(list(all_cells(options.seeds)), RESULTS / "variants.json", name_of, options)
    seeds = [Seed(number) for number in sorted({cell.seed for cell in cells})]
    failed = _in_processes(prepare, [(seed, options.folder) for seed in seeds], options)
    return failed + _in_processes(measure, [(cell, options.folder, options.goals) for cell in cells], options)


def _run_predecessor(options: argparse.Namespace) -> int:
    from predecessor import all_cells, measure, name_of, prepare
    from results import RESULTS

    cells = _missing(list(all_cells(min(options.seeds, 3))), RESULTS / "predecessor.json", name_of, options)
    prepare(options.folder)
    return _in_processes(measure, [(cell, options.folder, options.goals) for cell in cells], options)


STUDIES = {
    "methods": _run_methods,
    "selection": _run_selection,
    "labs": _run_labs,
    "rates": _run_rates,
    "iterations": _run_iterations,
    "widths": _run_with_base_models,
    "bases": _run_with_base_models,
    "variants": _run_variants,
    "predecessor": _run_predecessor,
}


def _missing(cells: list[Any], stored: Path, name_of: Callable[[Any], str], options: argparse.Namespace) -> list[Any]:
    """Return the cells without a measurement."""
    (options.folder / options.study).mkdir(parents=True, exist_ok=True)
    known = {path.stem for path in (options.folder / options.study).glob("*.json")}
    if stored.exists():
        known |= {name_of(result) for result in json.loads(stored.read_text())}
    missing = [cell for cell in cells if options.only in cell.name and cell.name not in known]
    print(f"measuring {len(missing)} of {len(cells)} cells", flush=True)
    return missing


def _in_processes(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], options: argparse.Namespace) -> int:
    """Run each call in a new process and write its result; return the number of failed calls.

    Raises:
        BrokenProcessPool: A process was killed, most likely because it used too much memory.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    context, failed = multiprocessing.get_context("spawn"), 0
    with ProcessPoolExecutor(options.workers, mp_context=context, max_tasks_per_child=1) as pool:
        futures = {pool.submit(function, *arguments): arguments[0] for arguments in calls}
        for number, future in enumerate(as_completed(futures), start=1):
            name = futures[future].name
            try:
                result = future.result()
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
            print(f"{number}/{len(futures)} {name}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
