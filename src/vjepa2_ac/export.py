"""Export a trained run as a merged model, as a checkpoint in Meta's format, or as an adapter with a model card."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Literal

from huggingface_hub import ModelCardData
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.errors import InputError, counted, escaped
from vjepa2_ac.evaluation.rows import Row
from vjepa2_ac.evaluation.summary import with_closed_loop
from vjepa2_ac.model.adapter_folder import ADAPTER_FILE
from vjepa2_ac.model.checkpoints import to_official
from vjepa2_ac.model.lora import merge_adapter, trainable_report
from vjepa2_ac.model.world_model import describe_model_widths, get_model_widths
from vjepa2_ac.reports.metrics_json import METRICS_FILE, Metrics, read_metrics
from vjepa2_ac.reports.write import PLOT
from vjepa2_ac.runs.checkpoint import ADAPTER, SELECTED, read_state, write_torch
from vjepa2_ac.runs.subject import Subject, load_subject, read_config_of_moved_run
from vjepa2_ac.storage import (
    atomic_writer,
    check_local_writable,
    folder_writer,
    require_new_folder,
    translate_write_errors,
    write_atomically,
)
from vjepa2_ac.storage.tensors import require_finite

Form = Literal["merged", "official", "hub"]

OFFICIAL_NAME = "vjepa2-ac.pt"  # name of the file if the destination is a folder
CARD = "README.md"


@dataclass(frozen=True)
class Exported:
    """The result of an export."""

    path: Path  # the file or folder
    checkpoint: str  # description of the exported checkpoint


def export_run(
    folder: Path,
    destination: Path,
    form: Form = "merged",
    checkpoint: str = SELECTED,
    overrides: Iterable[str] = (),
) -> Exported:
    """Export a trained run, atomically.

    An adapter is merged in float32 and then cast to the type of the base model (`model.dtype`).

    Args:
        folder: The run.
        destination: A new or empty folder; for official also a file ending in `.pt`, which must not exist.
        form: merged: the model as a folder for `model.base`. official: one `.pt` with Meta's parameter names and fused
            q, k and v, for the official code. hub: the adapter in PEFT's format with a model card, ready to upload.
        checkpoint: selected (the best, else the newest), newest, best, or a number of optimizer steps.
        overrides: New paths of a moved base model or encoder, as for `api.load_run`.

    Raises:
        InputError: As for `load_run`; the destination is not free or cannot be written; official: Meta's code does not
            support the model; hub: the run has no adapter, or its `metrics.json` is damaged; a weight of the merged
            model is not finite.
    """
    _check_free(destination, form)
    config = read_config_of_moved_run(folder, overrides)
    kind = config.adapter.kind
    if form == "hub" and kind != "lora":
        problem, needed = f"a run without an adapter (adapter.kind: {kind})", "adapter.kind: lora, for --to hub"
        fix = "Export the whole model with --to merged or --to official"
        raise InputError(where=str(folder), found=problem, needed=needed, fix=fix)
    metrics = read_metrics(folder) if form == "hub" and (folder / METRICS_FILE).exists() else None
    run = load_subject(folder, checkpoint, config=config)
    assert run.checkpoint is not None  # noqa: S101  # a run always has a checkpoint
    card = _card(run, run.checkpoint, folder, metrics) if form == "hub" else ""
    merge_adapter(run.world_model)  # also for the Hub, to check that the merged weights are finite
    require_finite(
        run.world_model.predictor.state_dict(),
        where=f"{run.checkpoint}, merged into its base",
        fix="Check lora_alpha in its adapter_config.json, or export another checkpoint: --checkpoint best",
    )
    if form == "hub":
        _write_hub(run.checkpoint, folder, destination, card, metrics)
    elif form == "merged":
        run.world_model.save_pretrained(destination)
    else:
        destination = destination if destination.suffix == ".pt" else destination / OFFICIAL_NAME
        with translate_write_errors(destination), atomic_writer(destination) as file:
            write_torch(to_official(run.world_model), file)
    return Exported(destination, run.checkpoint_label)


def _check_free(destination: Path, form: Form) -> None:
    """Check that a destination is free and can be written. Changes nothing."""
    if destination.suffix == ".pt" and form != "official" and not destination.is_dir():
        problem = "a path that ends in .pt"
        raise InputError(where=str(destination), found=problem, needed=f"a folder, for --to {form}")
    require_new_folder(destination)
    with translate_write_errors(destination):
        check_local_writable(destination)


def _write_hub(checkpoint: Path, folder: Path, destination: Path, card: str, metrics: Metrics | None) -> None:
    """Copy the adapter of a checkpoint, which `load_subject` has verified, and add the card."""
    with folder_writer(destination, ADAPTER_FILE) as fresh:
        for path in (checkpoint / ADAPTER).iterdir():
            shutil.copyfile(path, fresh / path.name)
        if metrics is not None:
            if (folder / PLOT).is_file():
                shutil.copyfile(folder / PLOT, fresh / PLOT)
            written = json.loads((folder / METRICS_FILE).read_bytes())  # paths of this machine are removed
            written["about"] |= {"subject": folder.resolve().name, "checkpoint_path": _evaluated_checkpoint(metrics)}
            written["summary"] |= {"subject": folder.resolve().name}
            write_atomically(fresh / METRICS_FILE, json.dumps(written, indent=1))
        write_atomically(fresh / CARD, card)


def _card(run: Subject, checkpoint: Path, folder: Path, metrics: Metrics | None) -> str:
    """Return the README.md of an adapter, in Markdown, with the Hub's front matter."""
    config, model, name = run.config, run.world_model, escaped(folder.resolve().name)
    environment = Environment(  # Markdown is not escaped
        loader=PackageLoader("vjepa2_ac", "assets"),
        undefined=StrictUndefined,
        autoescape=select_autoescape(),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    code = lambda name: f"`{escaped(str(name)).replace('`', '_')}`"  # noqa: E731 - a code span shows names literally
    environment.filters |= {"code": code, "count": counted, "ratio": _ratio}
    measured = None if metrics is None else _evaluated_checkpoint(metrics)
    summary = None
    if metrics is not None:  # a closed-loop benchmark may be newer than metrics.json
        summary = with_closed_loop(replace(metrics.summary, subject=name), folder, metrics.about.checkpoint)
    front = ModelCardData(
        library_name="peft",
        pipeline_tag="robotics",
        tags=["v-jepa-2-ac", "world-model", "lora"],
        model_name=name,
    )
    return environment.get_template("model_card.md.jinja").render(
        **dict(config),
        run=run,
        name=name,
        evaluation=metrics,
        summary=summary,
        measured=measured,
        plot=PLOT if metrics is not None and (folder / PLOT).is_file() else None,
        base=model.adaptation,
        new_widths=None if model.new_input_projections is None else get_model_widths(model.sizes),
        takes=describe_model_widths(model.sizes),
        steps=read_state(checkpoint).step,
        trained=trainable_report(model),
        version=__version__,
        front=str(front.to_yaml()),
        base_arguments=_base_arguments(config),
        every_setting=config_as_yaml(config.model_copy(update={"run_dir": name})),
    )


def _evaluated_checkpoint(metrics: Metrics) -> str:
    """Return the name of the checkpoint that was evaluated."""
    return PurePath(metrics.about.checkpoint_path).name


def _base_arguments(config: Config) -> str:
    """Return the arguments of `load_model` for the base model, as Python source."""
    words = [repr(config.model.base), f"dtype={config.model.dtype!r}"]
    for name, part in (("sizes", config.model.sizes), ("encoder", config.model.encoder)):
        values = {} if part is None else part.model_dump(mode="json", exclude_defaults=True)
        if values.keys() == {"path"}:
            words.append(f"{name}={values['path']!r}")
        elif values:
            words.append(f"{name}={type(part).__name__}.model_validate({values!r})")
    return ", ".join(words)


def _ratio(row: Row | None) -> str:
    return "not measured" if row is None else str(row.estimate)
