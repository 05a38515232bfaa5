"""Export of a trained run: as one merged model, as Meta's checkpoint, or as an adapter for the Hub."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jinja2 import TemplateError

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.episode import POSE_WIDTHS
from vjepa2_ac.errors import InputError
from vjepa2_ac.export.model_card import model_card
from vjepa2_ac.model.adapter.adapter_file import ADAPTER_FILE
from vjepa2_ac.model.adapter.merging import merge_adapter
from vjepa2_ac.model.checkpoints.official import to_official
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.model.network.input_heads import widths_of_model
from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics
from vjepa2_ac.reports.write import PLOT
from vjepa2_ac.runs.checkpoint import ADAPTER, SELECTED
from vjepa2_ac.runs.files import write_torch
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.runs.loading import TrainedRun, load_run
from vjepa2_ac.storage import atomic_writer, folder_writer, is_empty, try_writing_at, user_can_write, write_atomically

Form = Literal["merged", "official", "hub"]

OFFICIAL_NAME = "vjepa2-ac.pt"  # in a folder; a destination that ends in .pt is the file itself
CARD = "README.md"
_FILES = frozenset({".bin", ".ckpt", ".h5", ".onnx", ".pt", ".pth", ".safetensors"})  # not names of folders


@dataclass(frozen=True)
class Exported:
    """The result of an export."""

    path: Path  # the file or folder
    checkpoint: str  # the one it was made from, as text


def export_run(folder: Path, destination: Path, form: Form = "merged", checkpoint: str = SELECTED) -> Exported:
    """Export a trained run, atomically.

    An adapter is merged in float32, then cast to the type of the base's weights (`model.dtype`).

    Args:
        folder: The run.
        destination: A new or empty folder; for official also a file ending in `.pt`, which must not exist.
        form: merged: the model as a folder, which `model.base` takes. official: one `.pt` with Meta's names, q, k
            and v fused, for the official code. hub: the adapter in PEFT's format with a model card, ready to upload.
        checkpoint: selected (the best, else the newest), newest, best, or a number of optimizer steps.

    Raises:
        InputError: As `load_run`; the destination is occupied or cannot be written; official: the model is of another
            width than Meta's code, or without states; hub: the run has no adapter, or its `metrics.json` is damaged; or
            a weight of the merged model is not finite, whatever the form.
    """
    _check_free(destination, form)
    config = read_run_config(folder)
    if form == "hub":
        _check_adapter(folder, config)
        evaluation = _read_evaluation(folder)
        run = load_run(folder, checkpoint)
        _write_hub(run, folder, destination, evaluation)
        return Exported(destination, run.chosen)
    run = load_run(folder, checkpoint)
    if form == "official":
        _check_predictor(folder, run.world_model.sizes)
    _merge(run)
    if form == "merged":
        run.world_model.save_pretrained(destination)
        return Exported(destination, run.chosen)
    path = destination if destination.suffix == ".pt" else destination / OFFICIAL_NAME
    with user_can_write(path), atomic_writer(path) as file:
        write_torch(to_official(run.world_model), file)
    return Exported(path, run.chosen)


def _merge(run: TrainedRun) -> None:
    """Merge the trained weights into the model, and check that every weight is then finite."""
    merge_adapter(run.world_model)
    require_finite(
        run.world_model.predictor.state_dict(),
        where=f"{run.checkpoint}, merged into its base",
        fix="Check lora_alpha in its adapter_config.json, or export another checkpoint: --checkpoint best",
    )


def _check_free(destination: Path, form: Form) -> None:
    """Check that a destination is free and can be written. Changes nothing."""
    is_own = form == "official" and destination.suffix == ".pt"
    if destination.suffix in _FILES and not is_own and not destination.is_dir():
        file = f"a file that ends in .pt, or a folder for {OFFICIAL_NAME}"
        needed = file if form == "official" else f"a folder, for --to {form}"
        raise InputError(where=str(destination), found=f"the name of a {destination.suffix} file", needed=needed)
    with user_can_write(destination):
        if destination.exists() and not (destination.is_dir() and is_empty(destination)):
            raise InputError(where=str(destination), found="something is there already", needed="a new or empty folder")
        try_writing_at(destination)


def _check_adapter(folder: Path, config: Config) -> None:
    if config.adapter.kind != "lora":
        raise InputError(
            where=str(folder),
            found=f"a run without an adapter (adapter.kind: {config.adapter.kind})",
            needed="one with adapter.kind: lora, for --to hub",
            fix="Export the whole model with --to merged or --to official",
        )


def _check_predictor(folder: Path, sizes: ModelSizes) -> None:
    """Check that Meta's code has such a predictor."""
    fix, widths = "Export it with --to merged, which `model.base` takes", widths_of_model(sizes)
    if not sizes.predictor.use_states:
        raise InputError(
            where=str(folder),
            found="a predictor without states (predictor.use_states: false)",
            needed="one with states: Meta's code has no other, and would miss the weights of its state encoder",
            fix=fix,
        )
    if widths != POSE_WIDTHS:
        raise InputError(
            where=str(folder),
            found=f"a model of states of {widths.state} and actions of {widths.action} numbers",
            needed="7 and 7: Meta's code has one width for both, and makes that of the camera's pose one less",
            fix=fix,
        )


def _write_hub(run: TrainedRun, folder: Path, destination: Path, evaluation: dict[str, Any] | None) -> None:
    """Copy the adapter of a checkpoint, which load_run has verified, and put the card beside it."""
    plot = folder / PLOT if evaluation is not None and (folder / PLOT).is_file() else None
    adapter = run.checkpoint / ADAPTER
    try:
        card = model_card(run, folder.resolve().name, evaluation, plot.name if plot else None)
    except (KeyError, TypeError, ValueError, AttributeError, TemplateError) as error:
        raise _damaged(folder, error) from None
    _merge(run)  # the merged model is not written, but an adapter that makes it not finite is of no use
    with folder_writer(destination, ADAPTER_FILE) as fresh:
        for path in (*sorted(adapter.iterdir()), *([plot] if plot else [])):
            shutil.copyfile(path, fresh / path.name)
        if evaluation is not None:
            write_atomically(fresh / METRICS_FILE, json.dumps(evaluation, indent=1))
        write_atomically(fresh / CARD, card)


def _read_evaluation(folder: Path) -> dict[str, Any] | None:
    """Return the result of `evaluate` for a run, without paths of this machine; None if there is none."""
    if not (folder / METRICS_FILE).exists():
        return None
    metrics = read_metrics(folder)
    try:
        about = {**metrics["about"], "subject": folder.resolve().name}
        return {**metrics, "about": {**about, "checkpoint_path": Path(about["checkpoint_path"]).name}}
    except (TypeError, KeyError) as error:
        raise _damaged(folder, error) from None


def _damaged(folder: Path, error: Exception) -> InputError:
    return InputError(
        where=str(folder / METRICS_FILE),
        found=f"metrics that cannot be used ({error!r})",
        needed="what `vjepa2-ac evaluate` writes",
        fix=f"Write it again with `vjepa2-ac evaluate {folder}`, or delete it",
    )
