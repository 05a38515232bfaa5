"""Which runs are there, and how is each of their checkpoints measured?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from vjepa2_ac.config import (
    AdapterConfig,
    Config,
    ModelConfig,
    ReplayConfig,
    RldsData,
    TrainingConfig,
    ValidationConfig,
)
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.config.training import CheckpointConfig
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.model.adapter.lora import merge_adapter
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.agent import Planning
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, run_task
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B
from vjepa2_ac.simulation.motion import MotionRecipe
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.training.loop import train

Motions = Literal["narrow", "varied"]

WORLD = replace(DOMAIN_A, name="near", camera=DOMAIN_A.camera.turned(15.0), look=DOMAIN_B.look, lag_s=DOMAIN_B.lag_s)
"""A world that the base half knows: other colours and light, the camera turned by 15 degrees, another lag."""

RECIPES: dict[Motions, MotionRecipe] = {
    "narrow": MotionRecipe(drift_m=(0.01, 0.0, 0.0), turn_rad=0.0, gripper_share=0.0),
    "varied": MotionRecipe(),
}
"""narrow: 1 cm to the front in every model step. varied: random reaching, up to 7.5 cm an axis."""

EPISODES, RECORDED, GOALS = 60, 31, 9_000  # demonstrations, seeds of the recordings and of the problems
STEPS, EVERY = 800, 100
PLANNING = PlanningConfig(
    samples=64,
    iterations=4,
    start_std=0.67,
    limits=LimitsConfig(xyz=(0.075, 0.075, 0.075), gripper_mode="held"),
)
"""As in the evidence: horizon 1, 7.5 cm an axis and model step."""


OFFLINE: dict[str, tuple[str, int]] = {
    "one-step error / persistence": ("one_step.true", 1),
    "rollout error / persistence, last horizon": ("rollout.l1.over_persistence.7", 1),
    "gap of zero actions, negated": ("gap_of_actions.zero", -1),
    "gap of shuffled actions, negated": ("gap_of_actions.shuffled", -1),
    "moves: change with the action, negated": ("ranking.change", -1),
    "own steps: distance of the lowest energy": ("landscapes.distance", 1),
    "moves: rank in a box": ("ranking.box", 1),
    "moves: rank among other directions": ("ranking.shell", 1),
    "moves: rank (the one that selects)": ("ranking.rank", 1),
    "moves: spread of the energy, negated": ("ranking.spread", -1),
}
"""What `evaluate` finds of a model: the key of a row, and its sign, so that less is meant to be better."""


@dataclass(frozen=True)
class Run:
    """One fine-tuning."""

    motions: Motions
    method: Literal["LoRA", "full"]
    seed: int  # decides the order of clips and fresh weights, and the goals
    cure: Literal["", "replay"] = ""  # a quarter of the clips from other worlds; `tables.GONE` has those that are gone

    @property
    def name(self) -> str:
        """What its files are called."""
        return f"{self.motions}-{self.method}{f'-{self.cure}' if self.cure else ''}-s{self.seed}"


@dataclass(frozen=True)
class Cell:
    """One checkpoint of a run; step 0 is the base."""

    run: Run
    step: int

    @property
    def name(self) -> str:
        """What its file is called."""
        return f"{self.run.name}-{self.step:04d}"


def all_runs(seeds: int) -> Iterator[Run]:
    """Yield every run, those that matter most first."""
    for seed in range(seeds):
        for motions in RECIPES:
            yield from (Run(motions, "LoRA", seed), Run(motions, "full", seed))
    for seed in range(seeds):
        yield from (Run("narrow", "LoRA", seed, "replay"), Run("narrow", "full", seed, "replay"))
        yield Run("varied", "LoRA", seed, "replay")


def cells_of(run: Run) -> list[Cell]:
    """Return the checkpoints of a run that are measured: of the cures the base, some, and the last."""
    steps = (0, 200, 400, STEPS) if run.cure else range(0, STEPS + 1, EVERY)
    return [Cell(run, step) for step in steps]


def prepare(folder: Path) -> None:
    """Record what is not there yet: demonstrations, and random worlds as the base was trained on, to replay."""
    specs: dict[str, RecordingSpec] = {
        name: RecordingSpec(WORLD, seed=RECORDED, recipe=recipe) for name, recipe in RECIPES.items()
    }
    specs["replay"] = RecordingSpec("random", seed=RECORDED + 1)
    for name, spec in specs.items():
        if not (folder / f"data-{name}").exists():
            record_dataset(folder / f"data-{name}", spec, episodes=EPISODES)


def config_of(run: Run, folder: Path) -> Config:
    """Return the config that anybody would write; every checkpoint is kept."""
    data = RldsData(
        path=str(folder / f"data-{run.motions}"),
        frames=8,
        stride=4,
        validation_share=0.2,
        test_share=0.2,
        workers=0,
        cache="auto",
        cache_dir=str(folder / "latents"),
    )
    replayed = data.model_copy(update={"path": str(folder / "data-replay"), "validation_share": 0.0, "test_share": 0.0})
    adapter = AdapterConfig(rank=16, alpha=32.0, dropout=0.0) if run.method == "LoRA" else AdapterConfig(kind="none")
    return Config(
        run_dir=str(folder / "runs" / run.name),
        seed=run.seed,
        data=data,
        replay=ReplayConfig(share=0.25, data=replayed) if run.cure == "replay" else None,
        model=ModelConfig(base="builtin:sim-tiny", dtype="float32"),
        adapter=adapter,
        training=TrainingConfig(
            steps=STEPS,
            batch_size=6,
            accumulation=1,
            warmup_steps=20,
            learning_rate=3e-3 if run.method == "LoRA" else 4e-3,
            precision="fp32",
            device="cpu",
            log_every=50,
            allow_weak_base=True,
        ),
        validation=ValidationConfig(every=EVERY, clips=40, batch_size=20),
        checkpoint=CheckpointConfig(every=EVERY, keep=STEPS),
    )


def measure_alone(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Measure a checkpoint in a process of its own, on one thread; its run is trained before, if it is not there."""
    torch.set_num_threads(1)
    config = config_of(cell.run, folder)
    home, step = Path(config.run_dir), str(cell.step)
    rows = [row for row in read_metrics_log(home / "metrics.jsonl") if row["kind"] == "validation"]
    (validated,) = (row for row in rows if row["step"] == cell.step)
    probes = ProbeOptions(ranking_clips=24, samples=32, landscape_clips=4, nodes=5, examples=0)
    asked = EvaluationOptions(clips=48, checkpoint=step, against=(), probes=probes)
    evaluation = evaluate_subject(str(home), asked)
    model = load_subject(home, step).world_model
    if model.adaptation is not None:
        merge_adapter(model)
    spec = BenchmarkOptions("reach", WORLD, goals, GOALS + cell.run.seed)
    result = run_task(spec, Planning(Controller(model.eval(), PLANNING)))
    measured = {row.key: row.value for row in rows_of(evaluation) if row.model == evaluation.trained}
    return {
        "cell": asdict(cell.run) | {"step": cell.step, "name": cell.name},
        "validation": validated,
        "offline": {name: sign * measured[key] for name, (key, sign) in OFFLINE.items()},
        "distance_cm": result.distance_cm.round(3).tolist(),
    }


def train_alone(run: Run, folder: Path) -> None:
    """Train a run in a process of its own, from its newest checkpoint; nothing to do where it is done."""
    torch.set_num_threads(1)
    train(config_of(run, folder), SILENT)
