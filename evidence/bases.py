"""The bases study: do the results depend on the base model, and is a pre-trained encoder better than a random one?

Base models differ in the seed and in the encoder: random, or pre-trained by predicting masked pixels or masked latents.
Each predictor is trained as that of the built-in base model (random encoder, seed 0) and then fine-tuned in two labs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from labs import Cell as LabCell
from labs import closed_loop, evaluate, get_lab, make_config, make_data_config, prepare_lab
from methods import PLANNING
from prepare import BASE_CONFIG, BUILTIN, base_data, cache_latents, prepare_base_data
from pretrain_encoder import pretrain, read_frames
from results import as_file_name
from work import Work

from vjepa2_ac.config import Config, DecoderConfig, ModelConfig
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.decoding.training import train_decoder
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.export import export_run
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import NEWEST
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.benchmark import Planning
from vjepa2_ac.training.loop import train

EncoderKind = Literal["random", "pixels", "latents"]
BASES: tuple[tuple[EncoderKind, int], ...] = (
    ("random", 0), ("random", 1), ("random", 2), ("pixels", 0), ("latents", 0),
)  # fmt: skip
ZERO_SHOT, HELD_OUT = "base model", "held-out scenes"
METHODS = (HELD_OUT, ZERO_SHOT, "LoRA, rank 32", "full fine-tuning")
LABS = (1, 2)
DECODER = DecoderConfig(size="tiny", frames=4_000, steps=1_000, batch_size=32, learning_rate=2e-3)
HELD_OUT_ROWS = (
    "rollout.l1.over_persistence.3",
    "ranking.rank",
    "ranking.spread",
    "spread.3",
    "decoded.psnr_db.whole.truth.3",
)


@dataclass(frozen=True)
class BaseModel:
    """A base model: the kind of its encoder, and the seed of encoder and predictor."""

    encoder: EncoderKind
    seed: int

    @property
    def name(self) -> str:
        """Name for messages and files."""
        return f"base-{self.encoder}-{self.seed}"

    def location(self, folder: Path) -> str:
        """Return the value of `model.base`."""
        return BUILTIN if self == BaseModel("random", 0) else str(folder / self.name)


@dataclass(frozen=True)
class Cell:
    """A measurement of a base model in a lab; lab 0 stands for held-out scenes of its training data."""

    encoder: EncoderKind
    seed: int
    lab: int
    method: str

    @property
    def base(self) -> BaseModel:
        """The base model."""
        return BaseModel(self.encoder, self.seed)

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.base.name}-lab-{self.lab:02d}-{as_file_name(self.method)}"


def all_cells() -> Iterator[Cell]:
    """Yield all cells."""
    for encoder, seed in BASES:
        yield Cell(encoder, seed, 0, HELD_OUT)
        for lab in LABS:
            for method in METHODS[1:]:
                yield Cell(encoder, seed, lab, method)


def prepare_data(folder: Path, workers: int) -> None:
    """Record the frames for the encoders, the data of the base models, and the demonstrations of the labs."""
    read_frames(folder / "video", load_base(ModelConfig(base=BUILTIN, dtype="float32"), seed=0).image_size)
    prepare_base_data(folder, workers)
    for number in LABS:
        prepare_lab(get_lab(number), folder)


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the data and the base models of the cells; return the number of base models that failed."""
    prepare_data(work.folder, work.workers)
    return work.run(prepare_base, [(base, work.folder) for base in dict.fromkeys(cell.base for cell in cells)])


def prepare_base(base: BaseModel, folder: Path) -> None:
    """Pre-train a base model on one thread, and encode all data with its encoder."""
    if base.location(folder) == BUILTIN:
        return
    fresh, made = folder / f"fresh-{base.name}", Path(base.location(folder))
    if not fresh.exists():
        sizes = load_base(ModelConfig(base=BUILTIN, dtype="float32"), seed=0).sizes
        model = WorldModel.random(sizes, seed=100 + base.seed, near_persistence=True)
        if base.encoder != "random":
            pretrain(model, read_frames(folder / "video", model.image_size), base.encoder, base.seed)
        model.save_pretrained(fresh)
    if not made.exists():
        options = [f"run_dir={folder / f'run-{base.name}'}", f"seed={base.seed}", "training.allow_weak_base=true"]
        config = load_config(BASE_CONFIG, options)
        model_config = ModelConfig(base=str(fresh), dtype="float32")
        data = base_data(folder)
        cache_latents(data, str(fresh))
        export_run(train(config.model_copy(update={"data": data, "model": model_config}), SILENT), made)
    for number in LABS:
        cache_latents(make_data_config(get_lab(number), folder), str(made))


def make_cell_config(cell: Cell, folder: Path) -> Config:
    """Return the config of a fine-tuning."""
    config = make_config(LabCell(cell.lab, cell.method), folder)
    return config.model_copy(
        update={
            "run_dir": str(folder / "bases-runs" / cell.name),
            "model": ModelConfig(base=cell.base.location(folder), dtype="float32"),
            "validation": config.validation.model_copy(update={"every": config.training.steps}),
            "checkpoint": config.checkpoint.model_copy(update={"every": config.training.steps}),
        }
    )


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Train and measure a cell on one thread."""
    if cell.method == HELD_OUT:
        return {"rows": _measure_held_out(cell.base, folder)}
    result: dict[str, Any] = {}
    config = make_cell_config(cell, folder)
    if cell.method == ZERO_SHOT:
        model = load_base(config.model, seed=0).eval()
    else:
        run = train(config, SILENT)
        result["rows"] = evaluate(run, NEWEST)["rows"]
        model = load_subject(run, NEWEST).world_model
    ends_cm = closed_loop(LabCell(cell.lab, cell.method), goals)(Planning(Controller(model, PLANNING)))
    return result | {"ends_cm": ends_cm}


def _measure_held_out(base: BaseModel, folder: Path) -> dict[str, float]:
    """Return metrics of a base model on held-out episodes of its training data, also of decoded rollouts."""
    location = base.location(folder)
    data = base_data(folder).model_copy(update={"cache": "off"})
    decoder = DECODER.model_copy(update={"folder": str(folder / f"decoder-{base.name}")})
    config = Config(
        run_dir=str(folder / "none"), data=data, model=ModelConfig(base=location, dtype="float32"), decoder=decoder
    )
    probes = ProbeOptions(samples=32, landscape_clips=0, examples=0)
    options = EvaluationOptions(
        clips=128,
        data=config,
        probes=probes,
        decoder=str(train_decoder(config)),
        out=folder / f"evaluation-{base.name}",
    )
    rows = make_rows(evaluate_subject(location, options))
    return {f"{row.model} {row.key}": row.value for row in rows if row.key in HELD_OUT_ROWS and np.isfinite(row.value)}
