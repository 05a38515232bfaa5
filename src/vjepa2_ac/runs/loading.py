"""Loading the model of a run's checkpoint, and what the selection of this checkpoint says about the training."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.adapter_folder import CARD, load_trained
from vjepa2_ac.model.base_model import require_base_of_run
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.process import is_first
from vjepa2_ac.runs.checkpoint import ADAPTER, BEST, NEWEST, SELECTED, SelectedCheckpoint, select_checkpoint, step_of
from vjepa2_ac.runs.folder import MOVABLE, is_of_moved, read_run_config
from vjepa2_ac.storage.structured import read_json_object

logger = logging.getLogger(__name__)

BASE_MODEL = "base model"


@dataclass(frozen=True)
class TrainedRun:
    """A run's config, and the model of one of its checkpoints in eval mode."""

    config: Config
    world_model: WorldModel  # with its trained weights, not merged
    checkpoint: Path
    chosen: str  # which checkpoint it is, as text
    is_base: bool = False  # the checkpoint has the weights of the base model
    note: str = ""  # a sentence about a checkpoint of step 0; "" for a trained one

    def warn_if_untrained(self) -> None:
        """Log the note, in the first of several processes."""
        if self.note and is_first():
            logger.warning(self.note)


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
    note = note_about(config, chosen)
    is_base = bool(note) and untrained_model(config, chosen.path) == BASE_MODEL
    return TrainedRun(config, world_model, chosen.path, str(chosen), is_base, note)


def untrained_model(config: Config, checkpoint: Path) -> str:
    """Return what the model of a run is before its first step, as text: `BASE_MODEL`, or a model that differs from it.

    Args:
        config: Of the run.
        checkpoint: Any checkpoint of the run.

    Raises:
        InputError: The card of the trained weights is damaged.
    """
    if config.model.random is not None:
        return "untrained model"
    if "fresh_heads" in read_json_object(checkpoint / ADAPTER / CARD, needed="the card of trained weights"):
        return f"{BASE_MODEL} with untrained input heads"
    if config.adapter.kind == "lora" and config.adapter.peft.get("init_lora_weights") in (False, "orthogonal"):
        return f"{BASE_MODEL} with an untrained adapter"
    return BASE_MODEL


def note_about(config: Config, chosen: SelectedCheckpoint) -> str:
    """Return a sentence that says that a checkpoint is the untrained model, and why it was selected; "": it is not."""
    if step_of(chosen.path.name):
        return ""
    untrained, state = untrained_model(config, chosen.path), chosen.newest
    if chosen.by not in {SELECTED, BEST}:
        return f"{'The newest checkpoint' if chosen.by == NEWEST else 'Checkpoint 0'} is the {untrained}."
    if state.step < min(config.validation.every, config.training.steps):
        return f"The selected checkpoint is the {untrained}: no later checkpoint has been validated."
    training = "training" if config.model.base is None else "fine-tuning"
    measure = "the prediction error" if state.best_rank is None else "action ranking"
    return f"The selected checkpoint is the {untrained}: {training} did not improve {measure}."


def describe_selection(folder: Path) -> str:
    """Return which checkpoint of a run is selected, by which rule, and its action-ranking error.

    Raises:
        InputError: As `select_checkpoint`.
    """
    config, chosen = read_run_config(folder), select_checkpoint(folder)
    state, step = chosen.newest, step_of(chosen.path.name) or 0
    lines = [f"Selected checkpoint: step {step:,}, {chosen.why}."]
    if state.best_rank is not None:
        base = ""
        if step and state.base_rank is not None:
            base = f"{untrained_model(config, chosen.path)} {100 * state.base_rank:.1f} %, "
        lines.append(f"Action-ranking error in validation: {100 * state.best_rank:.1f} % ({base}chance 50 %).")
    return "\n".join(filter(None, (*lines, note_about(config, chosen))))


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
