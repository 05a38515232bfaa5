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
RUN/.mirror/            links to what is being sent to checkpoint.remote, while it is
RUN/.lock               a kernel lock, held by the process that is training: released however it ends
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
from vjepa2_ac.config.section import Affects, mark_of
from vjepa2_ac.errors import InputError, shell_command
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, remove_leavings
from vjepa2_ac.storage import read_bounded, try_writing_at, user_can_read, user_can_write, write_atomically
from vjepa2_ac.storage.places import BUILTIN, is_url, literal
from vjepa2_ac.storage.structured import MOST_BYTES, shown, utc_now

logger = logging.getLogger(__name__)

LOCK = ".lock"
CONFIG = "config.yaml"
ENVIRONMENT = "environment.json"
RUN_ID = "run_id"
CALIBRATION = "calibration.json"  # of an auto stride
CHANGES = "changes.json"  # of states in a model step
HELD = ".mirror"
METRICS = "metrics.jsonl"
TENSORBOARD = "tensorboard"
SMALL_FILES = (CONFIG, ENVIRONMENT, CALIBRATION, CHANGES, RUN_ID, METRICS)  # with which a run goes on elsewhere
_ID = re.compile(r"[\w.-]{0,128}")
_MOST_BYTES_OF_ID = 1_000
IMAGINED = "imagined"  # images of what the model imagines

_NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS})
_OF_DATA = ("path", "idle.ranges", "cache_dir", "disk_cache.dir")
MOVABLE = ("model.base", "model.encoder.path")  # the weights there are recognised by their fingerprint
_PATHS = (*(f"{data}.{key}" for data in ("data", "replay.data") for key in _OF_DATA), *MOVABLE)


def check_run_folder(config: Config, *, allow_config_change: bool = False) -> None:
    """Check that the run's folder is free, or belongs to this config, and can be written. Changes nothing.

    Args:
        config: The run.
        allow_config_change: A run of another config is to go on with this one.

    Raises:
        InputError: The folder is a file, somebody else's, of another config, or not writable.
    """
    folder = Path(config.run_dir)
    if folder.exists() and not folder.is_dir():
        raise InputError(where=str(folder), found="a file", needed="a folder for the run", fix="Set another run_dir")
    if (folder / CONFIG).exists():
        changed = [] if allow_config_change else changed_keys(read_run_config(folder), config)
        if differing := [key for key in changed if Affects.RUN in mark_of(key, Config)]:
            found = f"a run of another config; it differs in {', '.join(differing)}"
            same = f"Set another run_dir for a new run, or resume with `{shell_command('train', folder, '--resume')}`"
            fix = f"{same}; where the change is meant, add --allow-config-change"
            raise InputError(where=str(folder), found=found, needed="the same config, to go on with it", fix=fix)
    elif folder.exists() and not all(_is_without_config(path) for path in folder.iterdir()):
        found = "a folder with other things in it, and no config.yaml"
        needed = "an empty or new folder, or one of a run"
        raise InputError(where=str(folder), found=found, needed=needed, fix="Set another run_dir")
    with user_can_write(folder):
        try_writing_at(folder)


def open_run_folder(config: Config, run_name: str, *, allow_config_change: bool = False) -> Path:
    """Create the run's folder, or resume in it, and record this start's versions.

    Args:
        config: The run.
        run_name: What `run_id` gave, or a checkpoint from elsewhere.
        allow_config_change: Resume with this config where the folder has another one.

    Raises:
        InputError: As `check_run_folder`.
    """
    check_run_folder(config, allow_config_change=allow_config_change)
    folder = Path(config.run_dir)
    start = {"seed": config.seed, "folder": str(Path.cwd()), **environment()}
    if changes := write_config(config):  # the first of all files: it makes the folder a run's
        start["config_changes"] = changes
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


def write_config(config: Config) -> list[str]:
    """Write the config of this start into the run's folder if it differs, and return what changed since the last one.

    `train RUN --resume` reads it: a setting that was used for one start holds for the next.
    """
    path, changes = Path(config.run_dir, CONFIG), config_changes(config)
    if changes or not path.exists():
        write_atomically(path, config_as_yaml(config).encode())
    return changes


def asks_nothing_new(config: Config) -> bool:
    """Return whether a config leaves as they are what its run computes, what it measures, and where it reads."""
    changed = changed_keys(read_run_config(Path(config.run_dir)), config)
    return not any(key in _PATHS or (Affects.RUN | Affects.MEASURED) & mark_of(key, Config) for key in changed)


def config_changes(config: Config) -> list[str]:
    """Return a line per setting in which a config differs from that of the run in its folder: key, old, new value."""
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file():
        return []
    old = read_run_config(folder)
    before, now = config_as_flat_dict(old), config_as_flat_dict(config)
    keys = [key for key in changed_keys(old, config) if key != "run_dir"]
    return [f"{key}: {json.dumps(before.get(key))} -> {json.dumps(now.get(key))}" for key in keys]


def is_of_moved(override: str) -> bool:
    """Return whether a `key=value` gives the path of weights that may have been moved."""
    return override.partition("=")[0] in MOVABLE


def is_run(subject: str) -> bool:
    """Return whether this is the folder of a run; otherwise it names a model."""
    return (Path(subject) / CONFIG).is_file()


def read_run_config(folder: Path, overrides: Iterable[str] = ()) -> Config:
    """Return the config of a run; relative paths that do not exist here as seen from where the run was started.

    Args:
        folder: The run's folder.
        overrides: Such as checkpoint.keep=3.

    Raises:
        InputError: Not the folder of a run, or an override is wrong.
    """
    if not (folder / CONFIG).is_file():
        found = "no config.yaml" if folder.is_dir() else "no such folder"
        needed = "the folder of a run, which `vjepa2-ac train CONFIG` makes"
        raise InputError(where=str(folder), found=found, needed=needed)
    overrides = [*overrides, f"run_dir={json.dumps(literal(folder))}"]
    config = load_config_of_run(folder / CONFIG, overrides)
    moved = [f"{key}={json.dumps(path)}" for key, path in _seen_from_start(config, folder)]
    return load_config_of_run(folder / CONFIG, [*overrides, *moved]) if moved else config


def _seen_from_start(config: Config, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the keys of relative paths that exist from a folder in which the run was started, and not from here."""
    flat = config_as_flat_dict(config)
    data_sets = zip(("data", "replay.data"), config.data_sets, strict=False)
    only_names = {f"{name}.idle.ranges" for name, data in data_sets if data.is_cache}  # a part of the cache's key
    starts = [str(start.get("folder")) for start in reversed(_earlier_starts(folder / ENVIRONMENT))]
    for key in _PATHS:
        path = flat.get(key)
        if path is None or path == RANDOM or key in only_names or is_url(path) or path.startswith(BUILTIN):
            continue
        if Path(path).exists():
            continue
        there = next((found for start in starts if (found := Path(start, path)).exists()), None)
        if there is not None:
            yield key, str(there)


def places_elsewhere(config: Config) -> list[str]:
    """Return a line for each place away from this machine that a config names: its knob, and its address.

    A run's config may be untrusted: the addresses in it are shown before they are used.
    """
    knobs = config_as_flat_dict(config).items()
    named = [f"{key}: {value}" for key, value in knobs if isinstance(value, str) and is_url(value)]
    return [*named, "tracking.wandb: online"] if config.tracking.wandb == "online" else named


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
    return path.name == LOCK or (path.name.startswith(f".{CONFIG}.") and path.name.endswith(".partial"))


def _earlier_starts(path: str | Path) -> list[dict[str, Any]]:
    try:
        with user_can_read(path):
            starts = json.loads(read_bounded(path, MOST_BYTES))
    except (InputError, ValueError, RecursionError):  # there is none, or it is damaged
        return []
    return [start for start in starts if isinstance(start, dict)] if isinstance(starts, list) else []


def with_settled_values(config: Config) -> Config:
    """Return the config with the values that the run in its folder has settled.

    These are the stride, if the config says auto, and `data.splits`, if the config does not set it: an older run keeps
    its drawn splits.
    """
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file():
        return config
    run = read_run_config(folder)
    if config.data.stride == "auto" and run.data.stride != "auto":
        config = config.with_stride(run.data.stride)
    data, *others = [
        one if "splits" in one.model_fields_set else one.model_copy(update={"splits": before.splits})
        for one, before in zip(config.data_sets, [*run.data_sets, run.data], strict=False)
    ]
    replay = config.replay and config.replay.model_copy(update={"data": others[0]})
    return config.model_copy(update={"data": data, "replay": replay})


class RunLock:
    """A lock for writing into a run's folder: two training processes would overwrite each other's checkpoints.

    It is held from `take` to the end of the `with` block.

    Args:
        folder: The run's folder; `take` creates it if needed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, FileLock(folder / LOCK)

    def take(self) -> None:
        """Take the lock; does nothing if it is held already.

        On a file system without such locks the run continues without one, with a warning.

        Raises:
            InputError: Another process holds it, which is named if it has begun to train; or the folder cannot be
                written.
        """
        if self._lock.is_locked:
            return
        with user_can_write(self._folder / LOCK):
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire(blocking=False)
            except Timeout:
                found = f"a run that is being trained right now, by {last_start(self._folder / ENVIRONMENT)}"
                needed = "a folder that no other process writes to"
                fix = "Wait until it ends, stop it, or set another run_dir"
                raise InputError(where=str(self._folder), found=found, needed=needed, fix=fix) from None
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                what_to_do = "see that no other process trains in this folder"
                logger.warning("%s: no locks here (%s): %s", self._folder, error.strerror, what_to_do)

    def __enter__(self) -> RunLock:
        """Return the lock, not yet taken."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        self._lock.release()


def last_start(path: str | Path) -> str:
    """Return by which process, where and when the last start in a list of them was made, here or elsewhere."""
    last: dict[str, Any] = (_earlier_starts(path) or [{}])[-1]
    if "host" not in last:
        return "another process"
    return f"process {last.get('process')} on {last['host']}, since {last.get('time')}"
