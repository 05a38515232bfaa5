"""The widths study: does the rank that LoRA needs grow with the width of the predictor?

Predictors of three widths have the same depth, and are pre-trained with the same data and the same number of steps.
Each is then fine-tuned in two labs with LoRA of several ranks and in full. Of two learning rates, the one with the
lower action-ranking error on the validation episodes of the lab is used. All rates are divided by the width, as in
Yang et al. 2022 (arXiv 2203.03466, µP, for hidden matrices and Adam).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labs import Cell as LabCell
from labs import closed_loop, evaluate, get_lab, make_config, prepare_lab
from methods import PLANNING
from prepare import BASE_CONFIG, BUILTIN, base_data, prepare_base_data
from results import as_file_name
from work import Work

from vjepa2_ac.config import Config, ModelConfig
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.export import export_run
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import NEWEST
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.benchmark import Planning
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.validation import RANKING_ERROR

WIDTHS, DEPTH, HEAD_DIM = (128, 256, 384), 2, 32
RANKS, FULL, BASE = (1, 4, 16, 64), "full fine-tuning", "base model"
METHODS = (BASE, *(f"LoRA, rank {rank}" for rank in RANKS), FULL)
LABS = (1, 2)
RATES = (1.5e-3, 5e-3)  # of predictors with width 128
BASE_STEPS, BASE_RATE = 5_000, 1.5e-3


@dataclass(frozen=True)
class BaseModel:
    """A base model that is pre-trained."""

    width: int

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"base model of width {self.width}"


@dataclass(frozen=True)
class Cell:
    """One method in one lab, with the predictor of one width."""

    width: int
    lab: int
    method: str

    @property
    def base(self) -> BaseModel:
        """The base model."""
        return BaseModel(self.width)

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"width-{self.width}-lab-{self.lab:02d}-{as_file_name(self.method)}"


def all_cells() -> Iterator[Cell]:
    """Yield all cells, the wide predictors first, because they take longer."""
    for width in reversed(WIDTHS):
        for lab in LABS:
            for method in METHODS:
                yield Cell(width, lab, method)


def prepare_data(folder: Path, workers: int) -> None:
    """Record and encode the training data of the base models, and the demonstrations of the labs."""
    prepare_base_data(folder, workers)
    for number in LABS:
        prepare_lab(get_lab(number), folder)


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the data and the base models of the cells; return the number of base models that failed."""
    prepare_data(work.folder, work.workers)
    return work.run(prepare_base, [(base, work.folder) for base in dict.fromkeys(cell.base for cell in cells)])


def prepare_base(base: BaseModel, folder: Path) -> None:
    """Pre-train a base model on one thread."""
    if _base_folder(folder, base.width).exists():
        return
    fresh = folder / f"fresh-width-{base.width}"
    if not fresh.exists():
        _make_fresh_model(base.width).save_pretrained(fresh)
    config = load_config(
        BASE_CONFIG,
        [
            f"run_dir={folder / f'base-run-width-{base.width}'}",
            f"training.steps={BASE_STEPS}",
            f"training.learning_rate={BASE_RATE * WIDTHS[0] / base.width}",
            "training.allow_weak_base=true",
        ],
    )
    model = ModelConfig(base=str(fresh), dtype="float32")
    config = config.model_copy(update={"data": base_data(folder), "model": model})
    export_run(train(config, SILENT), _base_folder(folder, base.width))


def _make_fresh_model(width: int) -> WorldModel:
    """Return the encoder of the built-in model with a random predictor."""
    model = load_base(ModelConfig(base=BUILTIN, dtype="float32"), seed=0)
    changes = {"width": width, "depth": DEPTH, "heads": width // HEAD_DIM}
    sizes = model.sizes.model_copy(update={"predictor": model.sizes.predictor.model_copy(update=changes)})
    fresh = WorldModel.random(sizes, seed=width, near_persistence=True)
    fresh.encoder = model.encoder
    return fresh


def _base_folder(folder: Path, width: int) -> Path:
    return folder / f"base-width-{width}"


def make_cell_config(cell: Cell, folder: Path, rate: float) -> Config:
    """Return the config of a training with a learning rate, which is given for width 128."""
    config = make_config(LabCell(cell.lab, cell.method), folder)
    model = ModelConfig(base=str(_base_folder(folder, cell.width)), dtype="float32")
    training = config.training.model_copy(update={"learning_rate": rate * WIDTHS[0] / cell.width})
    steps = training.steps
    return config.model_copy(
        update={
            "run_dir": str(folder / "widths-runs" / f"{cell.name}-{rate:g}"),
            "model": model,
            "training": training,
            "validation": config.validation.model_copy(update={"every": steps}),
            "checkpoint": config.checkpoint.model_copy(update={"every": steps}),
        }
    )


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Train and measure a cell on one thread."""
    result: dict[str, Any] = {}
    if cell.method == BASE:
        subject = load_base(make_cell_config(cell, folder, RATES[0]).model, seed=0).eval()
    else:
        runs = {rate: train(make_cell_config(cell, folder, rate), SILENT) for rate in RATES}
        validated = {rate: _validated_ranking(run) for rate, run in runs.items()}
        rate = min(validated, key=lambda key: validated[key])
        result |= {"rate": rate, "validated": list(validated.values()), "rows": evaluate(runs[rate], NEWEST)["rows"]}
        subject = load_subject(runs[rate], NEWEST).world_model
    result["ends_cm"] = closed_loop(LabCell(cell.lab, cell.method), goals)(Planning(Controller(subject, PLANNING)))
    return result


def _validated_ranking(run: Path) -> float:
    rows = [row for row in read_metrics_log(run / "metrics.jsonl") if row["kind"] == "validation"]
    return float(rows[-1][RANKING_ERROR])
