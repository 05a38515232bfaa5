"""Open a run or a model: load its world model, and report which checkpoint was selected and why."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_of_model
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_folder import CARD, load_trained
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.model_files import require_base_of_run
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.process import is_first_process
from vjepa2_ac.runs.checkpoint import ADAPTER, BEST, NEWEST, SELECTED, SelectedCheckpoint, parse_step, select_checkpoint
from vjepa2_ac.runs.folder import MOVABLE_PATHS, is_run, read_run_config, sets_movable_path
from vjepa2_ac.storage.structured import read_json_object, utc_now

logger = logging.getLogger(__name__)

BASE_MODEL = "base model"


@dataclass(frozen=True)
class Subject:
    """An open run or model: its world model in eval mode, its config, and the source of its weights."""

    name: str  # the run folder, or the name of the model
    config: Config
    world_model: WorldModel  # on the CPU; `load_for_planning` moves it to its device and merges the adapter
    checkpoint: Path | None = None  # the checkpoint folder; None for a model
    checkpoint_label: str = ""  # folder name, and how it was selected; "" for a model
    is_base: bool = False  # the checkpoint has the weights of the base model
    note: str = ""  # a sentence about a checkpoint of step 0; "" for a trained checkpoint
    warnings: tuple[str, ...] = ()  # the note, and a warning if plans may exceed the motions in the training data

    def as_dict(self) -> dict[str, Any]:
        """Return the identity of the model as plain values: its name, and hashes of the weights."""
        model = self.world_model
        return {
            "version": __version__,
            "time": utc_now(),
            "model": {
                "subject": self.name,
                "checkpoint": self.checkpoint_label or None,
                **model.fingerprints()._asdict(),
                "dtype": str(next(model.parameters()).dtype).removeprefix("torch."),
                "device": model.device.type,
                "image_size": model.image_size,
            },
            "warnings": list(self.warnings),
            "control_steps_of_a_model_step": self.config.data.stride,
            "frame_of_states": self.config.data.pose_frame,
        }


def load_subject(
    name: str | Path, checkpoint: str = SELECTED, overrides: Sequence[str] = (), *, config: Config | None = None
) -> Subject:
    """Load a run or a model on the CPU; for a run, the base model with the trained weights of a complete checkpoint.

    A checkpoint whose weights are those of the base model is logged as a warning.

    Args:
        name: A run folder, or a model as in `model.base`.
        checkpoint: For a run: selected, newest, best, or a number of optimizer steps; see
            `runs.checkpoint.select_checkpoint`.
        overrides: New paths of the base model or the encoder of a run: model.base=PATH, model.encoder.path=PATH. The
            fingerprints of the weights must be those with which the run was trained.
        config: The config to use. None: the config of the run with the overrides; for a model the defaults.

    Raises:
        InputError: There is no such run, checkpoint or model, or the base model of the run cannot be loaded.
    """
    name = str(name)
    if not is_run(name):
        if checkpoint != SELECTED:
            problem, needed = f"{name}, which is not the folder of a run", "a run, because a model has no checkpoints"
            raise InputError(where=f"--checkpoint {checkpoint}", found=problem, needed=needed)
        config = config_of_model(name, overrides) if config is None else config
        return Subject(name, config, load_base(config.model.with_base(name), seed=config.seed))
    folder, config = Path(name), config or read_config_of_moved_run(Path(name), overrides)
    require_base_of_run(config.model, folder)
    selected = select_checkpoint(folder, checkpoint)
    world_model = load_base(config.model, seed=config.seed)
    load_trained(world_model, selected.path / ADAPTER, trainable=False)
    note = note_on_untrained_model(config, selected)
    if note and is_first_process():
        logger.warning(note)
    is_base = bool(note) and describe_untrained_model(config, selected.path) == BASE_MODEL
    warnings = tuple(filter(None, (note, note_on_warmup(config, selected))))
    return Subject(name, config, world_model.eval(), selected.path, str(selected), is_base, note, warnings)


def describe_untrained_model(config: Config, checkpoint: Path) -> str:
    """Describe the model of a run before its first step: `BASE_MODEL`, or how it differs from the base model.

    Args:
        config: The config of the run.
        checkpoint: Any checkpoint of the run.

    Raises:
        InputError: The card of the trained weights is damaged.
    """
    if config.model.is_random:
        return "untrained model"
    if "fresh_heads" in read_json_object(checkpoint / ADAPTER / CARD, needed="the card of trained weights"):
        return f"{BASE_MODEL} with untrained input projections"
    if config.adapter.kind == "lora" and config.adapter.peft.get("init_lora_weights") in (False, "orthogonal"):
        return f"{BASE_MODEL} with an untrained adapter"
    return BASE_MODEL


def note_on_untrained_model(config: Config, selected: SelectedCheckpoint) -> str:
    """Return a sentence if a checkpoint is the untrained model, with why it was selected; otherwise ""."""
    if parse_step(selected.path.name):
        return ""
    untrained, state = describe_untrained_model(config, selected.path), selected.newest
    if selected.selection not in {SELECTED, BEST}:
        return f"{'The newest checkpoint' if selected.selection == NEWEST else 'Checkpoint 0'} is the {untrained}."
    if state.step < min(config.validation.every, config.training.steps):
        return f"The selected checkpoint is the {untrained}: no later checkpoint has been validated."
    training = "training" if config.model.is_random else "fine-tuning"
    measure = "the prediction error" if state.best_ranking_error is None else "action ranking"
    return f"The selected checkpoint is the {untrained}: {training} is not shown to improve {measure}."


def note_on_warmup(config: Config, selected: SelectedCheckpoint) -> str:
    """Return a sentence if a checkpoint was saved before the learning rate reached its peak; otherwise ""."""
    step, warmup = parse_step(selected.path.name) or 0, config.training.warmup_steps
    if not 0 < step < warmup:
        return ""
    return f"The checkpoint of step {step:,} is within the warm-up ({warmup:,} steps), so training had hardly begun."


def describe_selection(folder: Path) -> str:
    """Return which checkpoint of a run is selected, by which rule, and its action-ranking error.

    Raises:
        InputError: See `select_checkpoint`.
    """
    config, selected = read_run_config(folder), select_checkpoint(folder)
    state, step = selected.newest, parse_step(selected.path.name) or 0
    lines = [f"Selected checkpoint: step {step:,}, {selected.reason}."]
    if state.best_ranking_error is not None:
        base = ""
        if step and state.base_ranking_error is not None:
            base = f"{describe_untrained_model(config, selected.path)} {100 * state.base_ranking_error:.1f} %, "
        lines.append(f"Action-ranking error in validation: {100 * state.best_ranking_error:.1f} % ({base}chance 50 %).")
    notes = note_on_untrained_model(config, selected), note_on_warmup(config, selected)
    return "\n".join(filter(None, (*lines, *notes)))


def read_config_of_moved_run(folder: Path, overrides: Iterable[str]) -> Config:
    """Return the config of a run, with new paths of the base model and the encoder.

    Args:
        folder: The run folder.
        overrides: The new paths: model.base=PATH, model.encoder.path=PATH.

    Raises:
        InputError: The folder is no run folder, or an override sets another key.
    """
    for override in overrides:
        if not sets_movable_path(override):
            needed = f"the new path of the base model or encoder: {' or '.join(f'{key}=PATH' for key in MOVABLE_PATHS)}"
            raise InputError(
                where=f"override {override}", found="a key that cannot be changed when a run is loaded", needed=needed
            )
    return read_run_config(folder, overrides)
