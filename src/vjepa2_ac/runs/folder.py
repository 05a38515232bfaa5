"""The folder of a run: its files, and its owner.

RUN/config.yaml         the resolved config, defaults and a chosen stride included
RUN/environment.json    versions, machine, command and folder of every start
RUN/calibration.json    metrics of each stride, where data.stride was auto
RUN/changes.json        how far states change in a model step (99th percentile): what `data` means in planning.limits
RUN/run_id              a name that no other run has
RUN/metrics.jsonl       metrics, a row per line
RUN/metrics.json        what `evaluate` measured; report.html and evaluation.png show it
RUN/checkpoints/        step-XXXXXXXX folders
RUN/tensorboard/        event files; RUN/wandb/ likewise
RUN/imagined/           what is imagined at each validation, where `validation.decoder` is set; and films of `imagine`
RUN/not_finite/         clips of a step that could not be done
RUN/.mirror/            links to what is being sent to checkpoint.remote, while it is
RUN/.lock               held by the process that is training, see `runs.lock`
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import secrets
import shutil
import sys
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import changed_keys, config_as_flat_dict, config_as_yaml, load_config_of_run
from vjepa2_ac.config.section import Affects, mark_of
from vjepa2_ac.errors import InputError
from vjepa2_ac.places import is_url, literal
from vjepa2_ac.runs.checkpoint import remove_leavings
from vjepa2_ac.runs.lock import LOCK
from vjepa2_ac.runs.own_files import refuse_links_out
from vjepa2_ac.storage import read_bounded, try_writing_at, write_atomically
from vjepa2_ac.storage.structured import MOST_BYTES, json_list, shown, utc_now

CONFIG = "config.yaml"
ENVIRONMENT = "environment.json"
RUN_ID = "run_id"
CALIBRATION = "calibration.json"  # of an auto stride
CHANGES = "changes.json"  # of states in a model step
CHECKPOINTS = "checkpoints"
HELD = ".mirror"
METRICS = "metrics.jsonl"
TENSORBOARD, WANDB = "tensorboard", "wandb"
_ID = re.compile(r"[\w.-]{0,128}")
_MOST_BYTES_OF_ID = 1_000
IMAGINED = "imagined"  # images of what the model imagines
NOT_FINITE = "not_finite"  # each process writes its own, on the disk that it sees

_OWN = (
    *(LOCK, CONFIG, ENVIRONMENT, CALIBRATION, CHANGES, RUN_ID, METRICS),
    *(CHECKPOINTS, HELD, TENSORBOARD, WANDB, NOT_FINITE, IMAGINED),
)
_FILLED = (NOT_FINITE, IMAGINED)  # folders of files that are written one by one


def check_run_folder(config: Config, *, allow_config_change: bool = False) -> None:
    """Check that the run's folder is free, or belongs to this config, and can be written. Changes nothing.

    Args:
        config: The run.
        allow_config_change: A run of another config is to go on with this one.

    Raises:
        InputError: The folder is a file, somebody else's, of another config, or not writable; or what is to be written
            into it is a link to elsewhere.
    """
    folder = Path(config.run_dir)
    if folder.exists() and not folder.is_dir():
        raise InputError(where=str(folder), found="a file", needed="a folder for the run", fix="Set another run_dir")
    written = (f"{name}/{path.name}" for name in _FILLED for path in (folder / name).glob("*"))
    refuse_links_out(folder, [*_OWN, *written])
    if (folder / CONFIG).exists():
        if not allow_config_change:
            _refuse_another_config(folder, config)
    elif folder.exists() and not all(_is_without_config(path) for path in folder.iterdir()):
        found = "a folder with other things in it, and no config.yaml"
        needed = "an empty or new folder, or one of a run"
        raise InputError(where=str(folder), found=found, needed=needed, fix="Set another run_dir")
    _check_writable(folder)


def open_run_folder(config: Config, run_name: str, *, allow_config_change: bool = False) -> Path:
    """Create the run's folder, or resume in it, and record this start's versions.

    Args:
        config: The run.
        run_name: What `run_id` gave, or a checkpoint from elsewhere.
        allow_config_change: Go on with this config where the folder has another, and note what changed with this start.

    Raises:
        InputError: As `check_run_folder`.
    """
    check_run_folder(config, allow_config_change=allow_config_change)
    folder = Path(config.run_dir)
    start = {"seed": config.seed, "folder": str(Path.cwd()), **environment()}
    if (changes := config_changes(config)) and allow_config_change:
        start["config_changes"] = changes
    is_new = not (folder / CONFIG).exists()
    if is_new or allow_config_change or _paths(read_run_config(folder)) != _paths(config):  # the data were moved
        # First of all files: it makes the folder a run's.
        write_atomically(folder / CONFIG, config_as_yaml(config).encode())
    path = folder / ENVIRONMENT
    write_atomically(path, json.dumps([*_earlier_starts(path), start], indent=1).encode())
    write_atomically(folder / RUN_ID, run_name)
    (folder / CHECKPOINTS).mkdir(exist_ok=True)
    remove_leavings(folder / CHECKPOINTS)
    shutil.rmtree(folder / HELD, ignore_errors=True)  # links keep the room of checkpoints that are gone
    return folder


def run_id(folder: Path) -> str:
    """Return the name that a run got at its first start; a new one where there is none.

    Raises:
        InputError: It cannot be a name: it becomes part of those that trackers give.
    """
    path = folder / RUN_ID
    if not path.is_file():
        return secrets.token_hex(8)
    name = read_bounded(path, _MOST_BYTES_OF_ID).decode(errors="replace").strip()
    if not _ID.fullmatch(name):
        raise InputError(where=str(path), found=shown(name), needed="the name of a run, letters and digits")
    return name


def config_changes(config: Config) -> list[str]:
    """Return a line per setting in which a config differs from that of the run in its folder: key, old, new value."""
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file():
        return []
    old = read_run_config(folder)
    before, now = config_as_flat_dict(old), config_as_flat_dict(config)
    keys = [key for key in changed_keys(old, config) if key != "run_dir"]
    return [f"{key}: {json.dumps(before.get(key))} -> {json.dumps(now.get(key))}" for key in keys]


def is_run(subject: str) -> bool:
    """Return whether this is the folder of a run; otherwise it names a model."""
    return (Path(subject) / CONFIG).is_file()


def read_run_config(folder: Path) -> Config:
    """Return the config of a run.

    Raises:
        InputError: Not the folder of a run.
    """
    if not (folder / CONFIG).is_file():
        found = "no config.yaml" if folder.is_dir() else "no such folder"
        needed = "the folder of a run, which `vjepa2-ac train CONFIG` makes"
        raise InputError(where=str(folder), found=found, needed=needed)
    return load_config_of_run(folder / CONFIG, [f"run_dir={json.dumps(literal(folder))}"])


def places_elsewhere(config: Config) -> list[str]:
    """Return a line for each place away from this machine that a config names: its knob, and its address.

    A run's config may be untrusted: the addresses in it are shown before they are used.
    """
    knobs = config_as_flat_dict(config).items()
    named = [f"{key}: {value}" for key, value in knobs if isinstance(value, str) and is_url(value)]
    return [*named, "tracking.wandb: online"] if config.tracking.wandb == "online" else named


def start_folders(folder: Path) -> list[Path]:
    """Return the folders in which a run was started, the last one first."""
    starts = [start for start in _earlier_starts(folder / ENVIRONMENT) if isinstance(start, dict)]
    return [Path(start["folder"]) for start in reversed(starts) if isinstance(start.get("folder"), str)]


def environment() -> dict[str, object]:
    """Return what a figure should be read with: versions, machine, command, time."""
    packages = ("vjepa2-ac", "torch", "transformers", "peft", "accelerate", "numpy", "scipy", "simplejpeg")
    return {
        "time": utc_now(),
        "command": sys.argv,
        "python": platform.python_version(),
        "machine": platform.platform(),
        "host": platform.node(),
        "process": os.getpid(),
        "packages": {name: importlib.metadata.version(name) for name in packages},
    }


def _is_without_config(path: Path) -> bool:
    """Return whether a file may be where no config is: after a start that was killed, or of a process not the first."""
    return path.name in {LOCK, NOT_FINITE} or (path.name.startswith(f".{CONFIG}.") and path.name.endswith(".partial"))


def _earlier_starts(path: Path) -> list[object]:
    try:
        return json_list(read_bounded(path, MOST_BYTES), where=str(path))
    except (OSError, InputError):
        return []


def _paths(config: Config) -> list[str]:
    return [data.path for data in config.data_sets]


def _refuse_another_config(folder: Path, config: Config) -> None:
    changed = changed_keys(read_run_config(folder), config)
    differing = [key for key in changed if Affects.RUN in mark_of(key, Config)]
    if differing:
        found = f"a run of another config; it differs in {', '.join(differing)}"
        fix = (
            f"Set another run_dir for a new run, or go on with `vjepa2-ac train {folder} --resume`; where the change is"
            " meant, add --allow-config-change"
        )
        raise InputError(where=str(folder), found=found, needed="the same config, to go on with it", fix=fix)


def _check_writable(folder: Path) -> None:
    try:
        try_writing_at(folder)
    except OSError as error:
        found = f"cannot be written ({error.strerror})"
        raise InputError(where=str(folder), found=found, fix="Set run_dir to a folder of yours") from None


def with_settled_stride(config: Config) -> Config:
    """Return a config whose stride is a number where the run in its folder has chosen one: it is chosen once."""
    folder = Path(config.run_dir)
    if config.data.stride != "auto" or not (folder / CONFIG).is_file():
        return config
    stride = read_run_config(folder).data.stride
    return config if stride == "auto" else with_stride(config, stride)


def with_stride(config: Config, stride: int) -> Config:
    """Return the config with a stride that was found out."""
    return config.model_copy(update={"data": config.data.with_stride(stride)})
