"""The selection study: do checkpoints with a lower error plan better, with low-diversity and diverse data?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from methods import PLANNING, TRAINING
from prepare import BUILTIN, data_a
from results import REACHED_CM
from work import Work

from vjepa2_ac.config import AdapterConfig, Config, ModelConfig, ReplayConfig, ValidationConfig
from vjepa2_ac.config.training import CheckpointConfig
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, run_task
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B
from vjepa2_ac.simulation.motion import MotionRecipe
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.training.loop import train

Motions = Literal["narrow", "varied"]

WORLD = replace(DOMAIN_A, name="near", camera=DOMAIN_A.camera.turned(15.0), look=DOMAIN_B.look, lag_s=DOMAIN_B.lag_s)
"""A small domain shift: other colours and light, the camera turned by 15 degrees, another lag."""

RECIPES: dict[Motions, MotionRecipe] = {
    "narrow": MotionRecipe(drift_m=(0.01, 0.0, 0.0), turn_rad=0.0, gripper_share=0.0),
    "varied": MotionRecipe(),
}
"""narrow: 1 cm to the front in every model step. varied: random reaching, up to 7.5 cm along each axis."""

EPISODES, RECORDED, GOALS = 60, 31, 9_000  # demonstrations, seeds of the recordings and of the problems
SEEDS, STEPS, EVERY = 3, 800, 100

OFFLINE = {
    "one_step": ("one_step.true", 1),
    "error": ("rollout.l1.over_persistence.7", 1),
    "shuffled": ("gap_of_actions.shuffled", -1),
    "ranking": ("ranking.rank", 1),
    "spread": ("ranking.spread", -1),
}
"""Metrics of `evaluate`: the key of a row, and the sign with which lower is better."""


@dataclass(frozen=True)
class Run:
    """One fine-tuning."""

    motions: Motions
    method: Literal["LoRA", "full"]
    seed: int  # decides the order of clips and fresh weights, and the goals
    cure: Literal["", "replay"] = ""  # replay: a quarter of the clips from other worlds

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.motions}-{self.method}{f'-{self.cure}' if self.cure else ''}-s{self.seed}"


@dataclass(frozen=True)
class Cell(Run):
    """One checkpoint of a run; step 0 is the base."""

    step: int = 0

    @property
    def run(self) -> Run:
        """The run."""
        return Run(self.motions, self.method, self.seed, self.cure)

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.run.name}-{self.step:04d}"


def all_cells() -> Iterator[Cell]:
    """Yield the checkpoints of every run, the most important runs first."""
    for seed in range(SEEDS):
        for motions in RECIPES:
            yield from cells_of(Run(motions, "LoRA", seed))
            yield from cells_of(Run(motions, "full", seed))
    for seed in range(SEEDS):
        for run in (Run("narrow", "LoRA", seed), Run("narrow", "full", seed), Run("varied", "LoRA", seed)):
            yield from cells_of(replace(run, cure="replay"))


def cells_of(run: Run) -> list[Cell]:
    """Return the checkpoints of a run that are measured."""
    steps = (0, 200, 400, STEPS) if run.cure else range(0, STEPS + 1, EVERY)
    return [Cell(**asdict(run), step=step) for step in steps]


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Record the demonstrations, and train the runs of the cells; return the number of runs that failed."""
    record_demonstrations(work.folder)
    return work.run(train_alone, [(run, work.folder) for run in dict.fromkeys(cell.run for cell in cells)])


def record_demonstrations(folder: Path) -> None:
    """Record the missing demonstrations, and the random worlds of the base model's training for replay."""
    specs: dict[str, RecordingSpec] = {
        name: RecordingSpec(WORLD, seed=RECORDED, recipe=recipe) for name, recipe in RECIPES.items()
    }
    specs["replay"] = RecordingSpec("random", seed=RECORDED + 1)
    for name, spec in specs.items():
        if not (folder / f"data-{name}").exists():
            record_dataset(folder / f"data-{name}", spec, episodes=EPISODES)


def make_config(run: Run, folder: Path) -> Config:
    """Return the config of a run; every checkpoint is kept."""
    shares = {"frames": 8, "validation_share": 0.2, "test_share": 0.2}
    data = data_a(folder).model_copy(update={"path": str(folder / f"data-{run.motions}"), **shares})
    replayed = data.model_copy(update={"path": str(folder / "data-replay"), "validation_share": 0.0, "test_share": 0.0})
    is_lora = run.method == "LoRA"
    changes = {"steps": STEPS, "learning_rate": 3e-3 if is_lora else 4e-3, "allow_weak_base": True}
    return Config(
        run_dir=str(folder / "selection-runs" / run.name),
        seed=run.seed,
        data=data,
        replay=ReplayConfig(share=0.25, data=replayed) if run.cure == "replay" else None,
        model=ModelConfig(base=BUILTIN, dtype="float32"),
        adapter=AdapterConfig(rank=16, alpha=32.0, dropout=0.0) if is_lora else AdapterConfig(kind="none"),
        training=TRAINING.model_copy(update=changes),
        validation=ValidationConfig(every=EVERY, clips=40, batch_size=20),
        checkpoint=CheckpointConfig(every=EVERY, keep=STEPS),
    )


def train_alone(run: Run, folder: Path) -> None:
    """Train a run from its newest checkpoint; a finished run returns at once."""
    train(make_config(run, folder), SILENT)


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Measure a checkpoint of a trained run."""
    config = make_config(cell.run, folder)
    home, step = Path(config.run_dir), str(cell.step)
    rows = [row for row in read_metrics_log(home / "metrics.jsonl") if row["kind"] == "validation"]
    (validated,) = (row for row in rows if row["step"] == cell.step)
    probes = ProbeOptions(ranking_clips=24, samples=32, landscape_clips=4, nodes=5, examples=0)
    options = EvaluationOptions(clips=48, checkpoint=step, against=(), probes=probes)
    evaluation = evaluate_subject(str(home), options)
    model = load_subject(home, step).world_model
    spec = BenchmarkOptions("reach", WORLD, goals, GOALS + cell.run.seed)
    result = run_task(spec, Planning(Controller(model, PLANNING)))
    measured = {row.key: row.value for row in make_rows(evaluation) if row.model == evaluation.trained}
    return {
        "validation": validated,
        "offline": {name: sign * measured[key] for name, (key, sign) in OFFLINE.items()},
        "distance_cm": result.distance_cm.round(3).tolist(),
    }


def run_of(result: dict[str, Any]) -> Run:
    """Return the run that a result belongs to."""
    return Cell(**result["cell"]).run


def compact(measured: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a measurement that the tables need."""
    ends = [actions[-1] for actions in measured["distance_cm"]]
    validation = measured["validation"]
    kept = {
        "error": validation["rollout_over_persistence_last"],
        "action_ranking_error": validation["action_ranking_error"],
        "left_cm": float(np.mean(ends)),
        "reached": sum(end < REACHED_CM for end in ends),
        "goals": len(ends),
    }
    if not measured["cell"]["cure"]:  # correlations are computed on runs without a cure
        kept["offline"] = measured["offline"]
    return kept
