"""Checkpoints from which a run resumes exactly: adapter, optimizer and step, without the frozen base model.

A checkpoint is a folder `step-00001000` with `manifest.json`, which contains the SHA-256 of every other file. It is
written under a temporary name and then renamed. A folder with the final name is therefore complete, or was damaged
later, which the manifest shows. Folders with other names, such as `step-00001000.bak`, are never changed.
"""

from __future__ import annotations

import json
import logging
import math
import os
import pickle
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, BinaryIO

from pydantic import Field

from vjepa2_ac.config.section import PositiveInt
from vjepa2_ac.errors import InputError, MissingFileError, counted, shell_command
from vjepa2_ac.storage import is_os_read_error, read_small_file, sha256_of_file, sync, translate_read_errors
from vjepa2_ac.storage.structured import MAX_BYTES, parse_json_object, parse_record, read_json_object, short_repr

logger = logging.getLogger(__name__)

CHECKPOINTS = "checkpoints"  # subfolder of a run folder
STATE = "state.json"
MANIFEST = "manifest.json"
ADAPTER = "adapter"  # subfolder, written by `model.adapter_folder.save_trained`
OPTIMIZER = "optimizer.pt"
FETCHING = ".fetching-"  # prefix of a checkpoint that is being downloaded, see `runs.open_run`

_WRITING = ".writing-"
SELECTED, NEWEST, BEST = "selected", "newest", "best"

_NAME = re.compile(r"step-([0-9]{8,})")
_NEEDED = "the state of a run, as written by vjepa2-ac"
_FIX = "Delete this checkpoint to use an older one"

Count = Annotated[int, Field(ge=0, lt=2**63)]
RANKING_TOLERANCE = 0.005  # absolute; smaller differences in action-ranking error count as equal
Finite = Annotated[float, Field(allow_inf_nan=False)]


_FILE_KEYS = {  # attribute of `RunState` -> key in state.json, where they differ
    "clips_per_process": "clips_asked",
    "num_processes": "processes",
    "best_ranking_error": "best_rank",
    "lowest_ranking_error": "lowest_rank",
    "base_ranking_error": "base_rank",
    "validation_settings": "measured_on",
}


@dataclass(frozen=True)
class DataState:
    """A data set as used by a run so far."""

    fingerprint: str  # hash of the episodes
    windows: Count  # number of clips per epoch; the order of the clips depends on it
    broken: Mapping[str, str]  # episodes that could not be read -> reason


@dataclass(frozen=True)
class RunState:
    """Progress of a run. Data order, learning rate and random numbers are functions of the step."""

    step: Count  # completed optimizer steps
    run_id: str = ""  # random id of the run, the same on every machine
    clips_done: Count = 0  # position in the sequence of clips of the whole run
    clips_per_step: PositiveInt | None = None  # summed over all processes
    clips_per_process: PositiveInt | None = None  # per process, from the config: batch_size * accumulation
    num_processes: PositiveInt = 1
    best_step: Count | None = None  # step of the best validation by checkpoint.keep_best; 0: before training
    best_error: Finite | None = None  # rollout error of the best validation
    best_ranking_error: Finite | None = None  # action-ranking error of the best validation, with keep_best=ranking
    lowest_ranking_error: Finite | None = None  # lowest action-ranking error of all validations
    base_ranking_error: Finite | None = None  # action-ranking error before the first step, with keep_best=ranking
    validation_settings: Mapping[str, str] | None = None  # settings that affect the errors; see `training.resume`
    loss_scale: Mapping[str, int | float] | None = None  # state of the gradient scaler, with fp16
    data: tuple[DataState, ...] = ()  # the data set and, if configured, the replay data set

    @property
    def best_name(self) -> str | None:
        """The folder name of the best checkpoint, or None."""
        return None if self.best_step is None else checkpoint_name(self.best_step)

    def with_validation(self, error: float, ranking_error: float | None = None) -> RunState:
        """Return the state after a validation at the current step, which becomes the best one if it is better.

        Args:
            error: The rollout error. Without `ranking_error` the validation with the lowest rollout error is the best.
            ranking_error: The action-ranking error. Only validations within `RANKING_TOLERANCE` of the lowest one are
                candidates; among them, the one with the lowest rollout error is the best.
        """
        if not math.isfinite(error) or (ranking_error is not None and not math.isfinite(ranking_error)):
            return self
        state = self if self.step else replace(self, base_ranking_error=ranking_error)
        has_lower_error = self.best_error is None or error < self.best_error
        if ranking_error is None:
            return replace(state, best_step=self.step, best_error=error) if has_lower_error else state
        lowest = ranking_error if self.lowest_ranking_error is None else min(ranking_error, self.lowest_ranking_error)
        is_beaten = self.best_ranking_error is None or self.best_ranking_error > lowest + RANKING_TOLERANCE
        if is_beaten or (has_lower_error and ranking_error <= lowest + RANKING_TOLERANCE):
            return replace(
                state,
                best_step=self.step,
                best_error=error,
                best_ranking_error=ranking_error,
                lowest_ranking_error=lowest,
            )
        return replace(state, lowest_ranking_error=lowest)


def checkpoint_name(step: int) -> str:
    """Return the folder name of the checkpoint of a step."""
    return f"step-{step:08d}"


def parse_step(name: str) -> int | None:
    """Return the step of a checkpoint from its folder name; None for other names."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match and name == checkpoint_name(int(match[1])) else None


def list_checkpoints(folder: Path) -> list[Path]:
    """Return all checkpoints in a folder, complete or damaged, sorted by step; empty if the folder does not exist.

    Raises:
        OSError: The folder cannot be listed.
    """
    try:
        names = [entry.name for entry in os.scandir(folder) if parse_step(entry.name) is not None and entry.is_dir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [folder / name for name in sorted(names, key=lambda name: parse_step(name) or 0)]


def remove_incomplete(folder: Path) -> None:
    """Remove incomplete checkpoints left by killed processes. No other process may write into the folder."""
    for prefix in (_WRITING, FETCHING):
        for path in folder.glob(f"{prefix}*"):
            if parse_step(path.name.removeprefix(prefix)) is not None:
                shutil.rmtree(path, ignore_errors=True)


def write_checkpoint(folder: Path, state: RunState, write_files: Callable[[Path], None], *, keep: int) -> Path:
    """Write a checkpoint atomically, then remove all but the newest `keep` and the best.

    Args:
        folder: The checkpoint folder of the run.
        state: The progress of the run.
        write_files: Writes weights and optimizer state into the folder that it receives.
        keep: Number of newest checkpoints to keep; the checkpoint of `state.best_step` is also kept.

    Raises:
        InputError: The folder cannot be written (full disk, no permission), or another process has written a complete
            checkpoint of this or a later step. Older checkpoints are not changed.
        UnreachableError: A checkpoint of this or a later step exists and cannot be read.
    """
    final = folder / checkpoint_name(state.step)
    temporary = folder / f"{_WRITING}{final.name}"
    later = [path for path in list_checkpoints(folder) if (parse_step(path.name) or 0) >= state.step]
    if complete := [path for path in later if find_damage(path) is None]:
        problem = "a complete checkpoint of another process, which is not overwritten"
        raise InputError(where=str(complete[0]), found=problem, fix="Run the same command again to resume from it")
    try:
        remove_incomplete(folder)  # frees disk space
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        write_files(temporary)
        values = {_FILE_KEYS.get(name, name): value for name, value in asdict(state).items()}
        (temporary / STATE).write_text(json.dumps(values))
        write_manifest(temporary)
        for path in later:  # all are damaged: the run did not resume from them
            _remove(path)
        temporary.rename(final)
        sync(folder)
        for old in list_checkpoints(folder)[:-keep]:
            if parse_step(old.name) != state.best_step:
                _remove(old)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        problem = f"the checkpoint cannot be written ({error.strerror or error})"
        fix = "Older checkpoints are unchanged. Free disk space, then run the same command again to resume"
        raise InputError(where=str(final), found=problem, fix=fix) from error
    return final


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the newest complete checkpoint, or None without checkpoints; log a warning for each damaged one.

    Raises:
        InputError: All checkpoints are damaged.
        UnreachableError: A checkpoint cannot be read, which does not show whether it is damaged.
    """
    checkpoints = list_checkpoints(folder)
    for path in reversed(checkpoints):
        problem = find_damage(path)
        if problem is None:
            return path
        logger.warning("%s: %s; this checkpoint is skipped", path, problem)
    if checkpoints:
        damaged = f"all checkpoints are damaged ({counted(len(checkpoints), 'checkpoint')})"
        fix = "To start again from step 0, delete this folder"
        raise InputError(where=str(folder), found=damaged, fix=fix)
    return None


def find_damage(checkpoint: Path) -> str | None:
    """Return a description of the damage of a checkpoint, or None if every file matches the manifest.

    Raises:
        UnreachableError: A file cannot be read, which does not show whether it is damaged.
    """
    name = MANIFEST
    try:
        with translate_read_errors(checkpoint / MANIFEST):
            files = parse_manifest(read_small_file(checkpoint / MANIFEST, MAX_BYTES))
        if STATE not in files:
            return f"{MANIFEST} does not name {STATE}"
        for name, digest in files.items():
            with translate_read_errors(checkpoint / name):
                if sha256_of_file(checkpoint / name) != digest:
                    return f"{name} is damaged (its SHA-256 differs from the manifest)"
    except MissingFileError:
        return f"{name} is missing"
    except InputError as error:
        return f"{name} is damaged ({error.found})"
    return None


def read_state(checkpoint: Path) -> RunState:
    """Return the progress of the run at a checkpoint, without a best checkpoint if its folder is missing."""
    state = read_state_file(checkpoint)
    if state.best_name is None or (checkpoint.parent / state.best_name).is_dir():
        return state
    return replace(state, best_step=None, best_error=None, best_ranking_error=None, lowest_ranking_error=None)


def read_state_file(checkpoint: Path) -> RunState:
    """Return the progress of the run from state.json, unchanged.

    Raises:
        InputError: The file is missing or damaged.
    """
    path = checkpoint / STATE
    values = read_json_object(path, needed=_NEEDED, fix=_FIX)  # a loss scale may be infinite
    names = {key: name for name, key in _FILE_KEYS.items()}
    values = {names.get(key, key): value for key, value in values.items()}
    return parse_record(RunState, values, where=str(path), needed=_NEEDED, fix=_FIX)


def _remove(checkpoint: Path) -> None:
    if checkpoint.is_symlink():
        checkpoint.unlink()  # never delete the target of a link
    else:
        shutil.rmtree(checkpoint)


# ---- files of a checkpoint: manifest and tensors are not trusted, because a checkpoint may be downloaded ----


def write_manifest(folder: Path) -> None:
    """Flush every file of a folder to the disk, then write the manifest.

    Raises:
        OSError: The folder cannot be read or written.
    """
    manifest = folder / MANIFEST
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != manifest)
    digests = {}
    for path in files:
        sync(path)
        digests[str(path.relative_to(folder))] = sha256_of_file(path)
    for inner in {path.parent for path in files} - {folder}:
        sync(inner)
    manifest.write_text(json.dumps({"files": digests}, indent=1))
    sync(manifest)
    sync(folder)


def parse_manifest(manifest: bytes) -> dict[str, str]:
    """Parse a manifest: relative path of each file -> SHA-256.

    Raises:
        InputError: It is no manifest, or names a file outside its folder.
    """
    files = parse_json_object(manifest, where=MANIFEST).get("files")
    if not isinstance(files, dict) or not all(isinstance(digest, str) for digest in files.values()):
        raise InputError(where=MANIFEST, found=f"files {short_repr(files)}", needed="the SHA-256 of each file by name")
    for name in files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or str(path) != name:
            raise InputError(
                where=MANIFEST,
                found=f"the path {name!r}, which is outside the folder",
                needed="files in the folder of the manifest",
            )
    return files


def write_torch(value: object, file: BinaryIO) -> None:
    """Write tensors and plain values.

    Raises:
        OSError: The disk is full, or another system error, which torch would hide in a RuntimeError.
    """
    import torch  # imported here, because listing checkpoints does not need it

    try:
        torch.save(value, file)
    except RuntimeError as error:
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def read_torch(path: Path) -> Any:
    """Return the tensors and plain values of a file, on the CPU. Nothing in it is executed.

    Raises:
        InputError: The file is missing, damaged, or contains more than tensors and plain values.
        UnreachableError: The file cannot be read.
    """
    import torch

    needed = "a file written by vjepa2-ac"
    with translate_read_errors(path, needed=needed):
        try:
            _require_uncompressed_zip(path)
            return torch.load(path, weights_only=True, map_location="cpu")
        except Exception as error:  # torch raises errors of any type for a damaged file
            if is_os_read_error(error):
                raise
            problem = f"cannot be read ({error})"
            if isinstance(error, pickle.UnpicklingError):
                problem = "objects other than tensors and plain values, which could execute code"
            raise InputError(where=str(path), found=problem, needed=needed) from None


def _require_uncompressed_zip(path: Path) -> None:
    """Refuse all formats but uncompressed zip archives: a small file of another format can need unlimited memory.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is no zip archive, or its entries are compressed.
    """
    with zipfile.ZipFile(path) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("it is compressed")


# ---- selection ----

_NOT_SELECTED = "the newest, none was selected by validation"
_REQUESTED = "as requested"


def selection_reason(description: str) -> str:
    """Return how a checkpoint was selected, from its description in a file: str(SelectedCheckpoint), of any version."""
    reason = description.partition(" (")[2].removesuffix(")")
    # Before 2026-12-01 these two reasons were described in other words.
    if reason.startswith("as "):
        return _REQUESTED
    return _NOT_SELECTED if "none was selected" in reason else reason


@dataclass(frozen=True)
class SelectedCheckpoint:
    """A complete checkpoint, and how it was selected."""

    path: Path
    reason: str  # how it was selected, as text
    selection: str  # the argument of `select_checkpoint`
    newest: RunState  # progress of the run at its newest checkpoint

    def __str__(self) -> str:
        """Return the folder name, and how the checkpoint was selected."""
        return f"{self.path.name} ({self.reason})"


def select_checkpoint(run: Path, selection: str = SELECTED) -> SelectedCheckpoint:
    """Select a complete checkpoint of a run.

    Args:
        run: The run folder.
        selection: selected (the best if there is one, otherwise the newest), newest, best (by validation, see
            `checkpoint.keep_best`), or a number of optimizer steps.

    Raises:
        InputError: There is no such checkpoint, or it is damaged; the message lists the complete checkpoints.
    """
    folder = run / CHECKPOINTS
    newest = newest_checkpoint(folder)
    if newest is None:
        fix = f"Resume training with `{shell_command('train', run, '--resume')}`"
        raise InputError(where=str(run), found="a run without a complete checkpoint", needed="at least one", fix=fix)
    state = read_state_file(newest)
    if selection == NEWEST or (selection == SELECTED and state.best_step is None):
        reason = "the newest" if selection == NEWEST else _NOT_SELECTED
        return SelectedCheckpoint(newest, reason, selection, state)
    is_best = selection in {SELECTED, BEST}
    step = state.best_step if is_best else parse_step(f"step-{selection.zfill(8)}")
    path = folder / checkpoint_name(step or 0)
    problem: str | None
    if step is None:
        causes = "no validation, changed validation settings, checkpoint.keep_best=off, or a deleted checkpoint"
        problem = f"no best checkpoint ({causes})" if is_best else f"--checkpoint {selection}"
    elif not path.is_dir():
        problem = f"no checkpoint of step {step:,}"
    else:
        problem = (damage := find_damage(path)) and f"{path.name} is damaged: {damage}"
    if problem:
        steps = ", ".join(str(parse_step(path.name)) for path in list_checkpoints(folder) if find_damage(path) is None)
        raise InputError(where=str(folder), found=problem, needed=f"selected, newest, best or one of the steps {steps}")
    measure = "error" if state.best_ranking_error is None else "action ranking"
    reason = f"the best by {measure}" if is_best else _REQUESTED
    return SelectedCheckpoint(path, reason, selection, state)
