"""Loading the model of a run's checkpoint."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.adapter_folder import load_trained
from vjepa2_ac.model.base_model import require_base_of_run
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.runs.checkpoint import ADAPTER, SELECTED, select_checkpoint
from vjepa2_ac.runs.folder import MOVABLE, is_of_moved, read_run_config


@dataclass(frozen=True)
class TrainedRun:
    """A run's config, and the model of one of its checkpoints in eval mode."""

    config: Config
    world_model: WorldModel  # with its trained weights, not merged
    checkpoint: Path
    chosen: str  # which checkpoint it is, as text


def load_run(folder: Path, checkpoint: str = SELECTED, config: Config | None = None) -> TrainedRun:
    """Load the model of a run, on the CPU: its base with the trained weights of a complete checkpoint.

    Args:
        folder: The run.
        checkpoint: selected, newest, best, or a number of optimizer steps; see `runs.checkpoint.select_checkpoint`.
        config: The run's config, with changed settings for loading; None: unchanged.

    Raises:
        InputError: Not the folder of a run, no such checkpoint, or its base cannot be loaded.
    """
    config = config or read_run_config(folder)
    require_base_of_run(config.model, folder)
    chosen = select_checkpoint(folder, checkpoint)
    world_model = load_base(config.model, seed=config.seed)
    load_trained(world_model, chosen.path / ADAPTER, trainable=False)
    return TrainedRun(config, world_model, chosen.path, str(chosen))


def run_config_of(folder: Path, overrides: Iterable[str]) -> Config:
    """Return the config of a run whose base or encoder may have been moved.

    Args:
        folder: The run.
        overrides: The new paths: model.base=PATH, model.encoder.path=PATH.

    Raises:
        InputError: Not the folder of a run, or another key is given.
    """
    for override in overrides:
        if not is_of_moved(override):
            needed = f"the new path of what was moved: {' or '.join(f'{key}=PATH' for key in MOVABLE)}"
            raise InputError(where=f"override {override}", found="a setting that loading does not use", needed=needed)
    return read_run_config(folder, overrides)
