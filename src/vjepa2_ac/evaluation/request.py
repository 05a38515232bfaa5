"""Options of an evaluation, and the config that results from them. PyTorch is not imported."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import config_as_dict, parse_config
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.planning.settings import resolve_data_limits
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, SELECTED, checkpoint_name, select_checkpoint
from vjepa2_ac.runs.folder import is_run, read_run_config, sets_movable_path
from vjepa2_ac.storage.paths import BUILTIN


@dataclass(frozen=True)
class ProbeOptions:
    """Options of action ranking, energy landscapes and examples; with 0 clips a measurement is skipped."""

    ranking_clips: int = 32
    samples: int = 64  # alternative actions per move from the box, and the same number from the shell
    landscape_clips: int = 8
    nodes: int = 9  # grid points along each axis of a landscape
    reach_cm: float = (
        7.5  # half-width of the box and of landscapes, and maximum length of moves; as in upstream's notebook
    )
    examples: int = 4
    at_once: int = 64  # samples per batch


@dataclass(frozen=True)
class EvaluationOptions:
    """The options of an evaluation."""

    split: Split = "test"
    clips: int = 256  # maximum number of clips, spread over the episodes
    checkpoint: str = SELECTED  # checkpoint of a run: selected, newest, best, or a number of optimizer steps
    data: Config | None = None  # config of the data; None: the data of the run. Required for a model
    # Models to compare with: "base", runs, models. None: the base model of a run; a model is not compared.
    against: Sequence[str] | None = None
    out: Path | None = None  # output folder; None: the folder of the run
    probes: ProbeOptions = field(default_factory=ProbeOptions)
    decoder: str | None = None  # folder of a decoder, or builtin:sim-tiny; with it, decoded rollouts are measured
    # Overrides of the config: keys of planning, and model.base=PATH for a run whose base model was moved.
    overrides: Sequence[str] = ()


def resolve_config(subject: str, options: EvaluationOptions) -> Config:
    """Return the config for an evaluation, with the overrides applied.

    Args:
        subject: The folder of a run, or a model as in `model.base`.
        options: The options.

    Raises:
        InputError: A model has no data, an override is invalid, or a folder or a checkpoint is missing.
    """
    config = _select_config(subject, options)
    for override in options.overrides:
        if not (override.startswith("planning.") or (is_run(subject) and sets_movable_path(override))):
            needed = "keys of planning, such as planning.samples=200; or, for a run, model.base=PATH"
            raise InputError(where="override", found=override, needed=needed)
    config = parse_config(config_as_dict(config), options.overrides, where="overrides")
    if not is_run(subject):
        return config
    _require_checkpoint(Path(subject), options.checkpoint)
    return resolve_data_limits(config, Path(subject))


def _require_checkpoint(run: Path, checkpoint: str) -> None:
    """Check that the checkpoint of a requested step exists. Its files are verified when they are loaded."""
    if checkpoint.isdecimal() and not (run / CHECKPOINTS / checkpoint_name(int(checkpoint))).is_dir():
        select_checkpoint(run, checkpoint)  # raises, and lists the existing steps


def require_single_process(environment: Mapping[str, str] = os.environ) -> None:
    """Check that there is only one process: several processes would repeat the work and write the same files.

    Raises:
        InputError: torchrun or `accelerate launch` started several processes.
    """
    if (num_processes := environment.get("WORLD_SIZE", "1")) != "1":
        needed = "one process, since only train, encode and evaluate share work between processes"
        fix = "Start the command without torchrun or accelerate launch"
        raise InputError(where="torchrun", found=counted(int(num_processes), "process"), needed=needed, fix=fix)


def _select_config(subject: str, options: EvaluationOptions) -> Config:
    """Return the config of a run, with `options.data` if given. For a model, return the config of the data."""
    run_config = read_run_config(Path(subject)) if is_run(subject) else None
    if options.data is None:
        if run_config is None:
            if Path(subject).is_file() and Path(subject).suffix in {".yaml", ".yml"}:
                fix = "Pass the folder that run_dir in this config names"
                raise InputError(where=subject, found="a config file", needed="the folder of a run", fix=fix)
            problem = "no such folder"
            if subject.startswith(BUILTIN) or Path(subject).exists():
                problem = "a model, or a folder without config.yaml"
            fix = "For a model, add --data CONFIG; `evaluate` also needs --out FOLDER"
            needed = "the folder of a run, which `vjepa2-ac train CONFIG` creates"
            raise InputError(where=subject, found=problem, needed=needed, fix=fix)
        return run_config
    if options.out is None:
        problem, needed = "no output folder", "one, since metrics.json in a run's folder is that of the run's own data"
        raise InputError(where="--data without --out", found=problem, needed=needed, fix="Add --out FOLDER")
    require_stride(options.data.data, to="evaluate")
    return options.data if run_config is None else run_config.model_copy(update={"data": options.data.data})
