"""The predecessor study: the mistakes of the first public fine-tuning of the released model, in the simulator.

V-Jepa-2-Fine-Tuning (leejason2025, December 2025) trained LoRA on DROID's wrist camera, with few steps that end within
the warm-up, and without validation. Its frame rate may have differed from the base model's. The base model here
(builtin:sim-tiny) was trained with exterior cameras and a stride of 4. Each mistake is made alone, and all together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from methods import PLANNING, TRAINING
from prepare import BUILTIN, cache_latents, data_a, encode_clips, exclude_episodes
from results import as_file_name
from work import Work

from vjepa2_ac.config import AdapterConfig, Config, DataConfig, ModelConfig, ValidationConfig
from vjepa2_ac.config.training import CheckpointConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.action_use import Transition, make_transition, measure_landscapes, rank_actions, select_moves
from vjepa2_ac.evaluation.measure import prediction_errors
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import (
    ActionRanking,
    Landscape,
    Landscapes,
    Validation,
    over_persistence,
    rank_difference,
)
from vjepa2_ac.init.dataset_properties import DatasetProperties
from vjepa2_ac.init.draft import Machine, choose_model, make_draft
from vjepa2_ac.init.draft_values import DraftValue
from vjepa2_ac.intervals import Estimate, estimate_mean
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import NEWEST
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, run_task
from vjepa2_ac.simulation.domains import DOMAIN_B
from vjepa2_ac.simulation.motion import CONTROL_RATE_HZ
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.spaces import ActionSpace
from vjepa2_ac.training.cost import USUAL_GPU
from vjepa2_ac.training.loop import train

EXTERIOR, WRIST = "exterior_1_left", "wrist_left"
STRIDE, OTHER_STRIDE = 4, 8  # control steps per model step: the base model's, and twice its duration
STEPS, WARMUP, SHORT = 400, 20, 40
EPISODES, DEMONSTRATIONS, SEEDS, SEED, GOALS_SEED = 48, 20, 3, 64, 64_000
CLIPS, PAIRS, REACH_CM, NODES = 64, 30, 15.0, 7
"""Held-out clips; pairs of frames and half-width of the landscapes, as in the predecessor's notebook; points along each
of dx, dy and dz (the notebook has 25 points along dx and dy)."""
MOVE_M, SAMPLES = 0.075, 32


@dataclass(frozen=True)
class Condition:
    """How the adapter is trained, or the view in which the base model is measured."""

    camera: str = EXTERIOR
    stride: int = STRIDE
    steps: int = STEPS  # 0: the base model
    is_validated: bool = True

    @property
    def view(self) -> str:
        """The camera and the stride, in words."""
        return f"{self.camera.partition('_')[0]}, stride {self.stride}"

    @property
    def planning_stride(self) -> int:
        """The stride in closed loop. The simulator plans from exterior cameras, with the base model's stride then."""
        return self.stride if self.camera == EXTERIOR else STRIDE

    @property
    def warmup_steps(self) -> int:
        """The short schedule ends within its warm-up."""
        return SHORT if self.steps == SHORT else WARMUP


CONDITIONS = {
    "all mistakes": Condition(WRIST, OTHER_STRIDE, SHORT, is_validated=False),
    "done right": Condition(),
    "short schedule": Condition(steps=SHORT),
    "wrist camera": Condition(WRIST),
    "other model step": Condition(stride=OTHER_STRIDE),
}
VIEWS = {
    view.view: view
    for view in (
        Condition(steps=0),
        Condition(WRIST, OTHER_STRIDE, steps=0),
        Condition(WRIST, steps=0),
        Condition(EXTERIOR, OTHER_STRIDE, steps=0),
    )
}
"""Where the base model is measured: for each condition, the camera and stride of its training."""
BASE_VIEW = next(iter(VIEWS))
BASE = {f"base model, {name}": view for name, view in VIEWS.items()}
ALL = {
    name: each
    for trained, condition in CONDITIONS.items()
    for name, each in ((f"base model, {condition.view}", BASE[f"base model, {condition.view}"]), (trained, condition))
}
"""All conditions; each follows the base model in its view, the most important first."""


@dataclass(frozen=True)
class Cell:
    """One training and its measurement, or a measurement of the base model."""

    condition: str
    seed: int  # selects demonstrations, weights and order of clips, and the goals

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{as_file_name(self.condition)}-s{self.seed}"


def all_cells() -> Iterator[Cell]:
    """Yield all cells, seed by seed."""
    for seed in range(SEEDS):
        for name in ALL:
            yield Cell(name, seed)


def prepare(cells: Sequence[Cell], work: Work) -> int:  # noqa: ARG001 - as of the other studies
    """Record the episodes with three cameras, and encode them for each view; return 0 (no failure)."""
    prepare_views(work.folder)
    return 0


def prepare_views(folder: Path) -> None:
    """Record the episodes with three cameras, and encode them for each view."""
    if not (folder / "data-predecessor").exists():
        spec = RecordingSpec(DOMAIN_B, seed=SEED, cameras=3)
        record_dataset(folder / "data-predecessor", spec, episodes=EPISODES)
    for view in VIEWS.values():
        cache_latents(make_data_config(view, folder), BUILTIN)


def make_data_config(condition: Condition, folder: Path) -> DataConfig:
    """Return the data config of a condition; the episodes of the splits are the same for all conditions."""
    update = {
        "path": str(folder / "data-predecessor"),
        "camera": condition.camera,
        "stride": condition.stride,
        "validation_share": 0.2,
        "test_share": 0.3,
    }
    return data_a(folder).model_copy(update=update)


def make_config(cell: Cell, folder: Path) -> Config:
    """Return the config of a cell: the predecessor's adapter, and a learning rate for the tiny model."""
    condition = ALL[cell.condition]
    data = make_data_config(condition, folder)
    excluded = exclude_episodes(data, DEMONSTRATIONS, cell.seed)
    steps, every = max(1, condition.steps), 20 if condition.steps == SHORT else 100
    changes = {
        "steps": steps,
        "warmup_steps": condition.warmup_steps if condition.steps else 0,
        "learning_rate": 3e-3,
        "allow_weak_base": True,
    }
    return Config(
        run_dir=str(folder / "predecessor-runs" / cell.name),
        seed=cell.seed,
        data=data.model_copy(update={"exclude": excluded}),
        model=ModelConfig(base=BUILTIN, dtype="float32"),
        adapter=AdapterConfig(rank=16, alpha=32.0, rslora=True, dropout=0.05),
        training=TRAINING.model_copy(update=changes),
        validation=ValidationConfig(
            every=every if condition.is_validated else steps,
            clips=40,
            batch_size=20,
            ranking_clips=20,
            ranking_samples=16,
        ),
        checkpoint=CheckpointConfig(every=every, keep=STEPS, keep_best="ranking" if condition.is_validated else "off"),
    )


class Recorder(Reporter):
    """Records the warnings and the validations of a run."""

    def __init__(self) -> None:
        self.checked: list[str] | None = None  # the warnings before the first step, which `train --check` prints, too
        self.warnings: list[str] = []
        self.validations: dict[int, Validation] = {}

    def note(self, text: str) -> None:
        """Record a warning."""
        if text.startswith("Warning: "):
            self.warnings.append(text.removeprefix("Warning: "))

    def on_start(self, done: int, total: int) -> None:
        """Record the warnings so far as those of the checks."""
        del done, total
        self.checked = list(self.warnings)

    def on_validation(self, step: int, validation: Validation) -> None:
        """Record a validation."""
        self.validations[step] = validation


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Train and measure a cell on one thread."""
    config, condition = make_config(cell, folder), ALL[cell.condition]
    result: dict[str, Any] = {}
    if not condition.steps:
        model = load_base(config.model, seed=0).eval()
        if cell.seed == 0:  # the held-out clips are the same for all seeds
            result["measured"] = {"own": measure_offline(model, config)}
    else:
        result["init"] = list_init_warnings(condition)
        training = Recorder()
        run = train(config, training)
        result |= {"check": training.checked, "train": training.warnings}
        result |= compare_validations(training.validations)
        model = load_subject(run, NEWEST).world_model.eval()
        result["measured"] = {"own": measure_offline(model, config)}
        if not condition.is_validated:  # does the adapter harm the base model's own view?
            base_view = config.model_copy(update={"data": make_data_config(VIEWS[BASE_VIEW], folder)})
            result["measured"]["base's"] = measure_offline(model, base_view)
    if condition.camera == EXTERIOR or condition.steps:
        seed = GOALS_SEED + 100 * cell.seed
        spec = BenchmarkOptions("reach", DOMAIN_B, goals, seed, stride=condition.planning_stride)
        distances_cm = run_task(spec, Planning(Controller(model, PLANNING))).distance_cm
        result["ends_cm"] = [round(float(each[-1]), 3) for each in distances_cm]
    return result


def list_init_warnings(condition: Condition) -> list[str]:
    """Return the warnings that `init` prints for a data set whose only camera is that of a condition."""
    camera = {"camera": DraftValue(condition.camera)}
    data = DatasetProperties("rlds", "data", camera, DraftValue(float(CONTROL_RATE_HZ)), episodes=EPISODES)
    machine = Machine(None, USUAL_GPU, has_bf16=False, cores=2, free_bytes=10**12)
    return make_draft(data, machine, choose_model(BUILTIN), run_dir="run").warnings


def compare_validations(validations: dict[int, Validation]) -> dict[str, Any]:
    """Return the rollout errors and action-ranking errors of a run, and their differences from the base model."""
    base, rows = validations[0].ranking, list[dict[str, Any]]()
    assert base is not None, "ranking_clips"
    for step, validation in sorted(validations.items()):
        assert validation.ranking is not None, "ranking_clips"
        error = over_persistence(validation.errors, "rollout")[-1].value
        row = {"step": step, "rollout_error": error, "ranking": _interval(validation.ranking.rank)}
        if step:
            row["difference"] = _interval(rank_difference(validation.ranking, base))
        rows.append(row)
    return {"validations": rows}


@torch.no_grad()
def measure_offline(model: WorldModel, config: Config) -> dict[str, Any]:
    """Return rollout error, action-ranking error and landscapes on held-out episodes, with intervals over episodes."""
    space = open_dataset(config.data).spaces.action
    batches = encode_clips(config, model, "test", CLIPS)
    landscapes = measure_landscapes(model, select_pairs(batches), space, ProbeOptions(nodes=NODES, reach_cm=REACH_CM))
    errors = prediction_errors(model, batches)
    ids = landscapes.episode_ids
    return {
        "rollout_error": _interval(over_persistence(errors, "rollout")[-1]),
        "ranking": _interval(rank_moves(model, batches, space).rank),
        "offset_cm": _interval(landscapes.mean("distance")),
        "rank": _interval(landscapes.mean("rank")),
        "sharpness": _interval(landscapes.mean("sharpness")),
        "energy": _interval(estimate_mean(np.array([_energy_at_true_action(each) for each in landscapes.maps]), ids)),
        "relative_energy": _relative_energy(landscapes),
        "random_offset_cm": landscapes.chance_distance,
    }


def select_pairs(batches: list[LatentBatch]) -> list[Transition]:
    """Return the first model step of clips that are spread over all held-out clips."""
    clips = [(batch, row) for batch in batches for row in range(len(batch.starts))]
    indices = np.linspace(0, len(clips) - 1, min(PAIRS, len(clips))).astype(int)
    return [make_transition(batch, row, 0) for batch, row in (clips[index] for index in indices)]


def rank_moves(model: WorldModel, batches: list[LatentBatch], space: ActionSpace) -> ActionRanking:
    """Measure the action-ranking error on all held-out clips, as `evaluate` does."""
    moves = [
        move
        for batch in batches
        for row in range(0, len(batch.starts), 2)
        for move in select_moves(batch, row, space, MOVE_M)
    ]
    return rank_actions(model, moves, space, ProbeOptions(samples=SAMPLES), seed=0)


def _energy_at_true_action(landscape: Landscape) -> float:
    node = tuple(np.abs(landscape.axes - landscape.true[:, None]).argmin(axis=1))
    return float(landscape.energy[node])


def _relative_energy(landscapes: Landscapes) -> float:
    """Return the energy at the true action relative to the mean energy of the grid; 1: as bad as a random action."""
    return float(np.mean([_energy_at_true_action(each) / each.energy.mean() for each in landscapes.maps]))


def _interval(estimate: Estimate) -> list[float]:
    return [estimate.value, estimate.low, estimate.high]
