"""The rates study: learning rates for the labs study, compared by errors on held-out episodes of two other labs.

The study uses neither a lab nor a goal of the labs study. A model's error is that of its rollouts on the validation
episodes, relative to persistence. A prior's error is that of its actions on the test episodes, relative to the zero
action. The labs study uses fixed rates; a table here shows whether another rate has a lower error.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import labs
import numpy as np
from labs import (
    BASE_PRIOR,
    PRETRAINED_PRIOR,
    PRIOR,
    STEPS,
    get_lab,
    make_base_config,
    make_prior_options,
    prepare_base_prior,
    prepare_lab,
)
from results import Figures, as_file_name
from work import Work

from vjepa2_ac.config import ValidationConfig
from vjepa2_ac.policies.action_prior import train_prior
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training.loop import train

LAB_NUMBERS = (101, 102)
ON_BASE_DATA = "action prior, training data of the base model"
CANDIDATES: dict[str, tuple[tuple[float, ...], tuple[int, ...]]] = {  # by method: learning rates, numbers of steps
    "LoRA, rank 4": ((1e-3, 3e-3, 9e-3), (STEPS,)),
    "LoRA, rank 32": ((1e-3, 3e-3, 9e-3), (STEPS,)),
    "full fine-tuning": ((1.3e-3, 4e-3, 1.2e-2), (STEPS,)),
    PRIOR: ((3e-4, 1e-3, 3e-3, 1e-2), (2_000,)),
    PRETRAINED_PRIOR: ((1e-4, 3e-4, 1e-3, 3e-3, 1e-2), (500, 2_000)),
}


@dataclass(frozen=True)
class Cell:
    """One training; the training data of the base model are lab 0."""

    lab: int
    method: str
    rate: float
    steps: int

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"lab-{self.lab:03d}-{as_file_name(self.method)}-{self.rate:g}-{self.steps}"


def all_cells() -> Iterator[Cell]:
    """Yield all cells, lab by lab."""
    for lab in LAB_NUMBERS:
        for method, (rates, steps) in CANDIDATES.items():
            yield from (Cell(lab, method, *values) for values in itertools.product(rates, steps))
    for num_steps in (BASE_PRIOR.steps // 2, BASE_PRIOR.steps):
        yield Cell(0, ON_BASE_DATA, BASE_PRIOR.learning_rate, num_steps)


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the data of the cells' labs, and the prior of the base model's data; return the number of failed labs."""
    if {PRETRAINED_PRIOR, ON_BASE_DATA} & {cell.method for cell in cells}:
        prepare_base_prior(work.folder, work.workers)
    used = [get_lab(number) for number in LAB_NUMBERS if any(cell.lab == number for cell in cells)]
    return work.run(prepare_lab, [(lab, work.folder) for lab in used])


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:  # noqa: ARG001 - as of the other studies
    """Train, and return the error on held-out episodes; there are no goals."""
    run = folder / "rate-runs" / cell.name
    if cell.method in {PRIOR, PRETRAINED_PRIOR, ON_BASE_DATA}:
        on_base = cell.method == ON_BASE_DATA
        config = make_base_config(folder) if on_base else labs.make_config(labs.Cell(cell.lab, cell.method), folder)
        options = BASE_PRIOR if on_base else make_prior_options(cell.method, folder)
        held_out = train_prior(config, run, replace(options, learning_rate=cell.rate, steps=cell.steps)).held_out
        return {"error": held_out["true_goals"]["value"]}
    config = labs.make_config(labs.Cell(cell.lab, cell.method), folder)
    training = config.training.model_copy(update={"learning_rate": cell.rate, "steps": cell.steps})
    validation = ValidationConfig(every=cell.steps, clips=120, batch_size=20, ranking_clips=20, ranking_samples=16)
    train(config.model_copy(update={"run_dir": str(run), "training": training, "validation": validation}), SILENT)
    *_, last = (row for row in read_metrics_log(run / "metrics.jsonl") if row["kind"] == "validation")
    return {"error": last["rollout_over_persistence_last"], "ranking_error": last["action_ranking_error"]}


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:  # noqa: ARG001 - as of the other studies
    """Write the table of all errors to a file, if there are any."""
    if results:
        path.write_text(table(results) + "\n")


def table(results: Sequence[Figures]) -> str:
    """Return the errors of each method, rate and number of steps, averaged over the labs that are measured."""
    heads = ("method", "learning rate", "steps", "labs", "error", "action-ranking error")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    groups: dict[tuple[str, float, int], list[Figures]] = {}
    for result in results:
        cell = result["cell"]
        groups.setdefault((cell["method"], cell["rate"], cell["steps"]), []).append(result)
    for (method, rate, steps), group in sorted(groups.items()):
        error = f"{np.mean([result['error'] for result in group]):.3f}"
        ranking = [result["ranking_error"] for result in group if "ranking_error" in result]
        shown = f"{100 * np.mean(ranking):.1f} %" if ranking else "not defined"
        rows.append(f"| {method} | {rate:g} | {steps} | {len(group)} | {error} | {shown} |")
    return "\n".join(rows)
