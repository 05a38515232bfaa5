"""Repeat the measurements of the studies, and write their tables and plots into docs/.

    python evidence --table                     # write tables and plots from results/*.json (make evidence)
    python evidence                             # run labs, widths, variants and predecessor (about five hours)
    python evidence --study labs --only lab-03  # run a part of a study; finished cells are skipped

    labs          does adapting help in a new lab, and does the advice of the tool select well?
    widths        does the rank that LoRA needs grow with the width of the predictor?
    bases         do the results depend on the base model, and is a pre-trained encoder better than a random one?
    variants      does another training loss make better plans?
    iterations    how many action sequences and iterations does a decision need?
    predecessor   the mistakes of a public fine-tuning, in the simulator
    selection     do checkpoints with a lower error plan better?
    rates         learning rates for the labs study, compared on other labs without any goal
    methods       single domain shifts and third-party simulators; takes more than 15 hours

A finished measurement is a JSON file in the work folder. The values that the tables need are written to
evidence/results, with the commit, the version of PyTorch and the processor time of each cell.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
STUDIES = {  # by name: the modules with the cells and with the tables
    "labs": ("labs", "labs_tables"),
    "widths": ("widths", "widths_tables"),
    "bases": ("bases", "bases_tables"),
    "variants": ("variants", "variants_tables"),
    "iterations": ("iterations", "iterations_tables"),
    "predecessor": ("predecessor", "predecessor_tables"),
    "selection": ("selection", "selection_tables"),
    "rates": ("rates", "rates"),
    "methods": ("measure", "tables"),
}
DEFAULT = ("labs", "widths", "variants", "predecessor")
GOALS, OTHER_GOALS = 20, {"iterations": 50, "predecessor": 7}  # number of goals of each cell


def main() -> int:
    """Run the missing measurements, then write tables and plots; return 1 if a cell failed."""
    options = _parse()
    failed = 0
    for study in [] if options.table else options.study or DEFAULT:
        failed += run(study, options)
    write(options.folder)
    return 1 if failed else 0


def run(name: str, options: argparse.Namespace) -> int:
    """Run the missing measurements of a study; return how many parts of it failed."""
    from work import Work

    started, module = time.monotonic(), STUDIES[name][0]
    study, work = import_module(module), Work(options.folder, options.workers)
    cells = _list_missing(study, name, options)
    if not cells:
        return 0
    failed = study.prepare(cells, work)
    failed += work.measure(name, module, cells, options.goals or OTHER_GOALS.get(name, GOALS))
    print(f"{name}: {(time.monotonic() - started) / 60:.0f} minutes", flush=True)
    return int(failed)


def _list_missing(study: Any, name: str, options: argparse.Namespace) -> list[Any]:
    """Return the cells without a measurement."""
    from results import RESULTS

    cells, stored = list(study.all_cells()), RESULTS / f"{name}.json"
    known = {path.stem for path in (options.folder / name).glob("*.json")}
    if stored.exists() and not options.again:
        known |= {study.Cell(**result["cell"]).name for result in json.loads(stored.read_text())}
    missing = [cell for cell in cells if options.only in cell.name and cell.name not in known]
    print(f"{name}: measuring {len(missing)} of {len(cells)} cells", flush=True)
    return missing


def write(folder: Path) -> None:
    """Write the results, tables and plots of all studies."""
    from results import RESULTS, read_all, write_all

    counts = []
    for name, (module, tables) in STUDIES.items():
        study, stored = import_module(module), RESULTS / f"{name}.json"
        measured = read_all(folder / name, stored, getattr(study, "compact", dict), study.Cell)
        if measured:
            write_all(stored, measured)
        import_module(tables).write_tables(measured, stored.with_suffix(".md"), ROOT / "docs")
        counts.append(f"{name} {len(measured)}")
    print(f"docs and evidence/results: {', '.join(counts)} measurements")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--study", action="append", choices=tuple(STUDIES), help=f"may be repeated; default: {', '.join(DEFAULT)}"
    )
    parser.add_argument("--only", default="", help="run only cells whose name contains this text")
    parser.add_argument("--again", action="store_true", help="also repeat the measurements that are stored in results/")
    parser.add_argument("--folder", type=Path, default=Path("build/evidence"), help="work folder")
    parser.add_argument("--workers", type=int, default=2, help="number of processes, with one thread each")
    parser.add_argument("--goals", type=int, help=f"number of goals of each cell (default: {GOALS}; {OTHER_GOALS})")
    parser.add_argument("--table", action="store_true", help="write tables and plots without running measurements")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
