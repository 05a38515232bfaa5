"""What can be done with a run that was trained? Load its model, evaluate it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.data.windows import Split
from vjepa2_ac.evaluation.evaluate import Evaluation, evaluate
from vjepa2_ac.evaluation.plots import plot_evaluation
from vjepa2_ac.evaluation.report import evaluation_as_dict
from vjepa2_ac.latents import require_widths
from vjepa2_ac.model.load import load_base
from vjepa2_ac.model.lora import load_trained
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.assembly import make_accelerator
from vjepa2_ac.training.checkpoint import ADAPTER
from vjepa2_ac.training.chosen import NEWEST, choose_checkpoint
from vjepa2_ac.training.run_folder import read_run_config

EVALUATION, PLOT = "evaluation.json", "evaluation.png"


@dataclass(frozen=True)
class TrainedRun:
    """A run's config and the model of one of its checkpoints, on the CPU."""

    config: Config
    world_model: WorldModel
    checkpoint: Path
    chosen: str  # which checkpoint it is, in words


@dataclass(frozen=True)
class Evaluated:
    """What was measured of a run."""

    evaluation: Evaluation
    checkpoint: str  # which one, in words
    files: tuple[Path, ...]  # that were written


def load_run(folder: Path, checkpoint: str = NEWEST) -> TrainedRun:
    """Load the model of a run: its base with the trained weights of a whole checkpoint.

    Args:
        folder: The run.
        checkpoint: newest, best, or a number of optimizer steps; see `training.chosen`.

    Raises:
        InputError: Not the folder of a run, no such checkpoint, or its base cannot be loaded.
    """
    config = read_run_config(folder)
    chosen = choose_checkpoint(folder, checkpoint)
    world_model = load_base(config.model, seed=config.seed)
    load_trained(world_model, chosen.path / ADAPTER, trainable=False)
    return TrainedRun(config, world_model, chosen.path, str(chosen))


def evaluate_run(folder: Path, *, split: Split, clips: int, checkpoint: str = NEWEST) -> Evaluated:
    """Measure a run on held-out episodes; write `evaluation.json` and `evaluation.png` into its folder.

    Args:
        folder: The run.
        split: Which held-out episodes.
        clips: At most so many, spread over the episodes.
        checkpoint: newest, best, or a number of optimizer steps.

    Raises:
        InputError: As `load_run`; or the split has no episodes.
    """
    run = load_run(folder, checkpoint)
    config = run.config
    dataset = open_dataset(config.data)
    require_widths(run.world_model, dataset.widths, where=str(folder))
    batches = validation_batches(dataset, split, clips=clips, batch_size=config.validation.batch_size)
    accelerator = make_accelerator(config)
    run.world_model.to(accelerator.device)
    with accelerator.autocast():
        evaluation = evaluate(
            run.world_model,
            batches,
            has_base=config.model.base is not None,
            device=accelerator.device,
            encode_chunk=config.model.encode_chunk,
            seconds_per_step=dataset.config.model_stride / dataset.control_rate_hz,
        )
    figures = folder / EVALUATION
    which = {"checkpoint": str(run.checkpoint), "chosen": run.chosen}
    about = {**which, "split": split, **evaluation_as_dict(evaluation)}
    write_atomically(figures, json.dumps(about, indent=1).encode())
    return Evaluated(evaluation, run.chosen, (plot_evaluation(evaluation, folder / PLOT), figures))
