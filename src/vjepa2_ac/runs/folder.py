"""The run folder: its files, checks before it is used, and the lock against a second training process.

RUN/config.yaml         the resolved config, including defaults and a calibrated stride
RUN/environment.json    versions, machine, command and working directory of every start
RUN/calibration.json    metrics of each stride, if data.stride was auto
RUN/changes.json        99th percentile of state changes per model step, for limits that are set to `data`
RUN/run_id              the unique id of the run
RUN/metrics.jsonl       metrics, one JSON object per line
RUN/metrics.json        metrics from `evaluate`, displayed in report.html and evaluation.png
RUN/checkpoints/        step-XXXXXXXX folders
RUN/tensorboard/        TensorBoard event files
RUN/wandb/              files of Weights & Biases
RUN/imagined/           predicted frames at each validation, if `validation.decoder` is set; and videos of `imagine`
RUN/.mirror/            links to the files that are being uploaded to checkpoint.remote, during the upload
RUN/.lock               a kernel lock of the training process, released when it ends, also if it is killed
"""

from __future__ import annotations

import errno
import importlib.metadata
import json
import logging
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import changed_keys, config_as_flat_dict, config_as_yaml, load_config_of_run
from vjepa2_ac.config.model import RANDOM
from vjepa2_ac.config.section import Affects, get_effect
from vjepa2_ac.errors import InputError, shell_command
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, remove_incomplete
from vjepa2_ac.storage import (
    check_local_writable,
    read_small_file,
    translate_read_errors,
    translate_write_errors,
    write_atomically,
)
from vjepa2_ac.storage.paths import BUILTIN, is_url, to_config_value
from vjepa2_ac.storage.structured import MAX_BYTES, short_repr, utc_now

logger = logging.getLogger(__name__)

LOCK = ".lock"
CONFIG = "config.yaml"
ENVIRONMENT = "environment.json"
RUN_ID = "run_id"
CALIBRATION = "calibration.json"
CHANGES = "changes.json"
UPLOAD_LINKS = ".mirror"
METRICS = "metrics.jsonl"
TENSORBOARD = "tensorboard"
SMALL_FILES = (CONFIG, ENVIRONMENT, CALIBRATION, CHANGES, RUN_ID, METRICS)  # needed to resume on another machine
_ID = re.compile(r"[\w.-]{0,128}")
_MAX_ID_BYTES = 1_000
IMAGINED = "imagined"

_NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS})
_DATA_PATHS = ("path", "idle.ranges", "cache_dir", "disk_cache.dir")
MOVABLE_PATHS = ("model.base", "model.encoder.path")  # may change, because a fingerprint identifies the weights
_PATHS = (*(f"{data}.{key}" for data in ("data", "replay.data") for key in _DATA_PATHS), *MOVABLE_PATHS)


def check_run_folder(config: Config, *, allow_config_change: bool = False) -> None:
    """Check that the run folder is free or belongs to a run with this config, and is writable. Changes nothing.

    Args:
        config: The config of the run.
        allow_config_change: Accept that the run in the folder has another config.

    Raises:
        InputError: The path is a file, the folder contains other files or a run with another config, or it is not
            writable.
    """
    folder = Path(config.run_dir)
    if folder.exists() and not folder.is_dir():
        raise InputError(where=str(folder), found="a file", needed="a folder for the run", fix="Set another run_dir")
    if (folder / CONFIG).exists():
        changed = [] if allow_config_change else changed_keys(read_run_config(folder), config)
        if differing := [key for key in changed if Affects.RUN in get_effect(key, Config)]:
            problem = f"a run with another config; it differs in {', '.join(differing)}"
            options = (
                f"Set another run_dir for a new run, or resume with `{shell_command('train', folder, '--resume')}`"
            )
            fix = f"{options}. To resume with the changed config, add --allow-config-change"
            raise InputError(where=str(folder), found=problem, needed="the same config, to resume the run", fix=fix)
    elif folder.exists() and not all(_may_precede_config(path) for path in folder.iterdir()):
        problem = "a folder with other files and without config.yaml"
        needed = "a new or empty folder, or the folder of a run"
        raise InputError(where=str(folder), found=problem, needed=needed, fix="Set another run_dir")
    with translate_write_errors(folder):
        check_local_writable(folder)


def open_run_folder(config: Config, run_id: str, *, allow_config_change: bool = False) -> Path:
    """Create the run folder or prepare it for a resume, and record the config and the environment of this start.

    Args:
        config: The config of the run.
        run_id: The id from `read_or_create_run_id`, or from a downloaded checkpoint.
        allow_config_change: Resume with this config if the run in the folder has another one.

    Raises:
        InputError: See `check_run_folder`.
    """
    check_run_folder(config, allow_config_change=allow_config_change)
    folder = Path(config.run_dir)
    start = {"seed": config.seed, "folder": str(Path.cwd()), **environment()}
    if changes := write_config(config):  # written first, because a folder with a config is recognised as a run
        start["config_changes"] = changes
    path = folder / ENVIRONMENT
    write_atomically(path, json.dumps([*_earlier_starts(path), start], indent=1).encode())
    write_atomically(folder / RUN_ID, run_id)
    (folder / CHECKPOINTS).mkdir(exist_ok=True)
    remove_incomplete(folder / CHECKPOINTS)
    # A deleted checkpoint uses disk space as long as links to its files exist.
    shutil.rmtree(folder / UPLOAD_LINKS, ignore_errors=True)
    return folder


def read_or_create_run_id(folder: Path) -> str:
    """Return the id of the run in a folder, or a new random id.

    Raises:
        InputError: The file does not contain a valid id. Its characters are restricted, because trackers use it in
            paths.
    """
    path = folder / RUN_ID
    if not path.is_file():
        return secrets.token_hex(8)
    text = read_small_file(path, _MAX_ID_BYTES).decode(errors="replace").strip()
    if not _ID.fullmatch(text):
        raise InputError(where=str(path), found=short_repr(text), needed="the id of a run: letters, digits and . _ -")
    return text


def write_config(config: Config) -> list[str]:
    """Write the config into the run folder if it differs from the stored config, and return the changes.

    `train RUN --resume` reads this file, so that a changed setting also applies to the next start.
    """
    path, changes = Path(config.run_dir, CONFIG), list_config_changes(config)
    if changes or not path.exists():
        write_atomically(path, config_as_yaml(config).encode())
    return changes


def has_same_results(config: Config) -> bool:
    """Return whether a config has the computation, the measurements and the paths of the stored config of its run."""
    changed = changed_keys(read_run_config(Path(config.run_dir)), config)
    return not any(key in _PATHS or (Affects.RUN | Affects.MEASURED) & get_effect(key, Config) for key in changed)


def list_config_changes(config: Config) -> list[str]:
    """Return a line `key: old -> new` for each value that differs from the config in the run folder."""
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file():
        return []
    old = read_run_config(folder)
    before, now = config_as_flat_dict(old), config_as_flat_dict(config)
    keys = [key for key in changed_keys(old, config) if key != "run_dir"]
    return [f"{key}: {json.dumps(before.get(key))} -> {json.dumps(now.get(key))}" for key in keys]


def sets_movable_path(override: str) -> bool:
    """Return whether a `key=value` override sets a path in `MOVABLE_PATHS`."""
    return override.partition("=")[0] in MOVABLE_PATHS


def is_run(subject: str) -> bool:
    """Return whether a path is a run folder; otherwise it is the name of a model."""
    return (Path(subject) / CONFIG).is_file()


def read_run_config(folder: Path, overrides: Iterable[str] = ()) -> Config:
    """Return the config of a run.

    Relative paths that do not exist in the working directory are resolved from the folder in which the run was started.

    Args:
        folder: The run folder.
        overrides: For example checkpoint.keep=3.

    Raises:
        InputError: The folder is no run folder, or an override is wrong.
    """
    if not (folder / CONFIG).is_file():
        problem = "no config.yaml" if folder.is_dir() else "no such folder"
        needed = "the folder of a run, which `vjepa2-ac train CONFIG` creates"
        raise InputError(where=str(folder), found=problem, needed=needed)
    overrides = [*overrides, f"run_dir={json.dumps(to_config_value(folder))}"]
    config = load_config_of_run(folder / CONFIG, overrides)
    moved = [f"{key}={json.dumps(path)}" for key, path in _resolve_missing_paths(config, folder)]
    return load_config_of_run(folder / CONFIG, [*overrides, *moved]) if moved else config


def _resolve_missing_paths(config: Config, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield key and absolute path of relative paths that exist only in the working directory of an earlier start."""
    flat = config_as_flat_dict(config)
    data_sets = zip(("data", "replay.data"), config.data_sets, strict=False)
    unread = {f"{name}.idle.ranges" for name, data in data_sets if data.is_cache}  # not needed by a latent cache
    starts = [str(start.get("folder")) for start in reversed(_earlier_starts(folder / ENVIRONMENT))]
    for key in _PATHS:
        path = flat.get(key)
        if path is None or path == RANDOM or key in unread or is_url(path) or path.startswith(BUILTIN):
            continue
        if Path(path).exists():
            continue
        existing_path = next((candidate for start in starts if (candidate := Path(start, path)).exists()), None)
        if existing_path is not None:
            yield key, str(existing_path)


def list_remote_locations(config: Config) -> list[str]:
    """Return a line `key: URL` for each remote location in a config.

    The config of a run may be untrusted. Therefore its URLs are displayed before they are used.
    """
    values = config_as_flat_dict(config).items()
    urls = [f"{key}: {value}" for key, value in values if isinstance(value, str) and is_url(value)]
    return [*urls, "tracking.wandb: online"] if config.tracking.wandb == "online" else urls


def environment() -> dict[str, object]:
    """Return the environment of a measurement or start: versions, machine, command and time."""
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


def _may_precede_config(path: Path) -> bool:
    """Return whether a file may exist in a folder before config.yaml: the lock, or a file of a killed start."""
    return path.name == LOCK or (path.name.startswith(f".{CONFIG}.") and path.name.endswith(".partial"))


def _earlier_starts(path: str | Path) -> list[dict[str, Any]]:
    try:
        with translate_read_errors(path):
            starts = json.loads(read_small_file(path, MAX_BYTES))
    except (InputError, ValueError, RecursionError):  # the file is missing or damaged
        return []
    return [start for start in starts if isinstance(start, dict)] if isinstance(starts, list) else []


def with_values_of_run(config: Config) -> Config:
    """Return the config with the values that were decided at the start of its run.

    These are the calibrated stride, if `data.stride` is auto, and `data.splits`, if the config does not set it. So
    a run of an earlier version keeps the splits that it started with.
    """
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file():
        return config
    run_config = read_run_config(folder)
    if config.data.stride == "auto" and run_config.data.stride != "auto":
        config = config.with_stride(run_config.data.stride)
    data, *replay_data = [
        section if "splits" in section.model_fields_set else section.model_copy(update={"splits": before.splits})
        for section, before in zip(config.data_sets, [*run_config.data_sets, run_config.data], strict=False)
    ]
    replay = config.replay and config.replay.model_copy(update={"data": replay_data[0]})
    return config.model_copy(update={"data": data, "replay": replay})


class RunLock:
    """A lock on a run folder, because two training processes would overwrite each other's checkpoints.

    It is held from `take` to the end of the `with` block.

    Args:
        folder: The run folder; `take` creates it if needed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, FileLock(folder / LOCK)

    def take(self) -> None:
        """Acquire the lock; do nothing if it is held already.

        On a file system without locks the run continues without one, with a warning.

        Raises:
            InputError: Another process holds the lock, or the folder is not writable. The message names the process
                if it has started training.
        """
        if self._lock.is_locked:
            return
        with translate_write_errors(self._folder / LOCK):
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire(blocking=False)
            except Timeout:
                problem = f"a run that is in use by {describe_last_start(self._folder / ENVIRONMENT)}"
                needed = "a folder that no other process writes to"
                fix = "Wait until that process exits, stop it, or set another run_dir"
                raise InputError(where=str(self._folder), found=problem, needed=needed, fix=fix) from None
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                advice = "Make sure that no other process trains in this folder"
                logger.warning("%s: no file locks (%s). %s", self._folder, error.strerror, advice)

    def __enter__(self) -> RunLock:
        """Return the lock, not yet acquired."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        self._lock.release()


def describe_last_start(path: str | Path) -> str:
    """Describe the last start in an environment.json: process, host and time."""
    last: dict[str, Any] = (_earlier_starts(path) or [{}])[-1]
    if "host" not in last:
        return "another process"
    return f"process {last.get('process')} on {last['host']}, since {last.get('time')}"
