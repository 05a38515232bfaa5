"""Checkpoints for an exact resume of a run: adapter, optimizer and step; never the frozen base.

A checkpoint is a folder `step-00001000` with `manifest.json`, which holds the SHA-256 of every other file. It is
written under a temporary name and renamed, so a folder with the final name is complete or was damaged later; the
manifest shows which. A folder with any other name, such as `step-00001000.bak`, is the user's own and is left alone.
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
from vjepa2_ac.storage import is_refusal, read_bounded, sha256_of_file, sync, user_can_read
from vjepa2_ac.storage.structured import MOST_BYTES, json_object, read_json_object, record_of, shown

logger = logging.getLogger(__name__)

CHECKPOINTS = "checkpoints"  # of a run's folder
STATE = "state.json"
MANIFEST = "manifest.json"
ADAPTER = "adapter"  # a folder: what `model.adapter_folder.save_trained` writes
OPTIMIZER = "optimizer.pt"
FETCHING = ".fetching-"  # a checkpoint being fetched, see `runs.mirror`

_WRITING = ".writing-"
SELECTED, NEWEST, BEST = "selected", "newest", "best"

_NAME = re.compile(r"step-([0-9]{8,})")
_NEEDED = "where a run stood, as this program wrote it"
_FIX = "Delete this checkpoint, to use an older one"

Count = Annotated[int, Field(ge=0, lt=2**63)]
SAME_RANK = 0.005  # mean ranks this close are equal: on other clips they differ by more
Finite = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True)
class DataState:
    """What a run has seen of a data set."""

    fingerprint: str  # of its episodes
    windows: Count  # clips of an epoch: their order depends on the number
    broken: Mapping[str, str]  # episodes whose clips could not be read, and why


@dataclass(frozen=True)
class RunState:
    """Progress of a run. Data order, learning rate and random numbers are functions of the step."""

    step: Count  # optimizer steps done
    run_id: str = ""  # a random name that stays with the run wherever it is resumed
    clips_done: Count = 0  # position in the sequence of clips of the whole run
    clips_per_step: PositiveInt | None = None  # of all processes
    clips_asked: PositiveInt | None = None  # of one process, by the config: batch_size * accumulation
    processes: PositiveInt = 1
    best_step: Count | None = None  # the best validation by checkpoint.keep_best; 0: the base's
    best_error: Finite | None = None  # its rollout error
    best_rank: Finite | None = None  # its mean rank of the true action, if that selects
    lowest_rank: Finite | None = None  # of all validations
    base_rank: Finite | None = None  # mean rank of the true action before the first step, if that selects
    measured_on: Mapping[str, str] | None = None  # what validation errors depend on, see `training.resume`
    loss_scale: Mapping[str, int | float] | None = None  # of fp16: state of the gradient scaler
    data: tuple[DataState, ...] = ()  # of its data set, and of the replayed one

    @property
    def best_name(self) -> str | None:
        """The name of the best checkpoint; None if there is none."""
        return None if self.best_step is None else checkpoint_name(self.best_step)

    def measured(self, error: float, rank: float | None = None) -> RunState:
        """Return the state after a validation at its step, which may be the best one.

        Args:
            error: What decides, if there is no rank; and between ranks that are as good as equal.
            rank: Of the best, it is within `SAME_RANK` of the lowest of all.
        """
        if not math.isfinite(error) or (rank is not None and not math.isfinite(rank)):
            return self
        state = self if self.step else replace(self, base_rank=rank)
        has_lower_error = self.best_error is None or error < self.best_error
        if rank is None:
            return replace(state, best_step=self.step, best_error=error) if has_lower_error else state
        lowest = rank if self.lowest_rank is None else min(rank, self.lowest_rank)
        is_beaten = self.best_rank is None or self.best_rank > lowest + SAME_RANK
        if is_beaten or (has_lower_error and rank <= lowest + SAME_RANK):
            return replace(state, best_step=self.step, best_error=error, best_rank=rank, lowest_rank=lowest)
        return replace(state, lowest_rank=lowest)


def checkpoint_name(step: int) -> str:
    """Return the folder name of a step's checkpoint."""
    return f"step-{step:08d}"


def step_of(name: str) -> int | None:
    """Return the step of a checkpoint by the name of its folder; None if the name is no checkpoint's."""
    found = _NAME.fullmatch(name)
    return int(found[1]) if found and name == checkpoint_name(int(found[1])) else None


def listed(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, sorted by step, complete or damaged; none if there is no folder.

    Raises:
        OSError: The folder cannot be listed.
    """
    try:
        names = [entry.name for entry in os.scandir(folder) if step_of(entry.name) is not None and entry.is_dir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [folder / name for name in sorted(names, key=lambda name: step_of(name) or 0)]


def remove_leavings(folder: Path) -> None:
    """Remove the incomplete files of killed starts of this run. No other process may write there."""
    for beginning in (_WRITING, FETCHING):
        for path in folder.glob(f"{beginning}*"):
            if step_of(path.name.removeprefix(beginning)) is not None:
                shutil.rmtree(path, ignore_errors=True)


def write_checkpoint(folder: Path, state: RunState, write_files: Callable[[Path], None], *, keep: int) -> Path:
    """Write a checkpoint atomically, then remove all but the newest `keep` and the best.

    Args:
        folder: The run's checkpoint folder.
        state: Progress of the run.
        write_files: Called with a folder, into which it writes weights and optimizer state.
        keep: How many of the newest checkpoints stay; that of `state.best_step` stays, too.

    Raises:
        InputError: The folder cannot be written (full disk, no permission), or has a complete checkpoint of this or a
            later step, which another process wrote. Older checkpoints are not changed.
        UnreachableError: It has one of such a step that cannot be read.
    """
    final = folder / checkpoint_name(state.step)
    temporary = folder / f"{_WRITING}{final.name}"
    damaged = [path for path in listed(folder) if (step_of(path.name) or 0) >= state.step]  # skipped at the start
    if complete := [path for path in damaged if find_damage(path) is None]:
        found = "a complete checkpoint that another process wrote; it is left as it is"
        raise InputError(where=str(complete[0]), found=found, fix="Start again: the run resumes from this checkpoint")
    try:
        remove_leavings(folder)  # they occupy space
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        write_files(temporary)
        (temporary / STATE).write_text(json.dumps(asdict(state)))
        write_manifest(temporary)
        for path in damaged:
            _remove(path)
        temporary.rename(final)
        sync(folder)
        for old in listed(folder)[:-keep]:
            if step_of(old.name) != state.best_step:
                _remove(old)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        found = f"the checkpoint cannot be written ({error.strerror or error})"
        fix = "Older checkpoints are untouched: make room or pass another run_dir, then resume"
        raise InputError(where=str(final), found=found, fix=fix) from error
    return final


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the newest complete checkpoint, None if there are none; damaged ones are named in a warning.

    Raises:
        InputError: There are checkpoints, and all are damaged.
        UnreachableError: The newest one that is not known to be damaged cannot be read.
    """
    found = listed(folder)
    for path in reversed(found):
        problem = find_damage(path)
        if problem is None:
            return path
        logger.warning("%s: %s; this checkpoint is skipped", path, problem)
    if found:
        damaged = f"all checkpoints are damaged ({counted(len(found), 'checkpoint')})"
        fix = "To start again from step 0, delete this folder"
        raise InputError(where=str(folder), found=damaged, fix=fix)
    return None


def find_damage(checkpoint: Path) -> str | None:
    """Return what is wrong with a checkpoint, or None if every file matches the manifest.

    Raises:
        UnreachableError: A file cannot be read, which does not show that it is damaged.
    """
    name = MANIFEST
    try:
        with user_can_read(checkpoint / MANIFEST):
            files = named_files(read_bounded(checkpoint / MANIFEST, MOST_BYTES))
        if STATE not in files:
            return f"{MANIFEST} does not name {STATE}"
        for name, digest in files.items():
            with user_can_read(checkpoint / name):
                if sha256_of_file(checkpoint / name) != digest:
                    return f"{name} is damaged (its SHA-256 is not the manifest's)"
    except MissingFileError:
        return f"{name} is missing"
    except InputError as error:
        return f"{name} is damaged ({error.found})"
    return None


def read_state(checkpoint: Path) -> RunState:
    """Return the progress of the run at a checkpoint, without a best checkpoint that is missing."""
    state = written_state(checkpoint)
    if state.best_name is None or (checkpoint.parent / state.best_name).is_dir():
        return state
    return replace(state, best_step=None, best_error=None, best_rank=None, lowest_rank=None)


def written_state(checkpoint: Path) -> RunState:
    """Return the progress of the run as it was written.

    Raises:
        InputError: The file is missing or damaged.
    """
    path = checkpoint / STATE
    values = read_json_object(path, needed=_NEEDED, fix=_FIX)  # a loss scale may be infinite
    return record_of(RunState, values, where=str(path), needed=_NEEDED, fix=_FIX)


def _remove(checkpoint: Path) -> None:
    if checkpoint.is_symlink():
        checkpoint.unlink()  # its target is not this run's
    else:
        shutil.rmtree(checkpoint)


# ---- its files: neither manifest nor tensors are trusted, for a checkpoint may come from elsewhere ----


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


def named_files(manifest: bytes) -> dict[str, str]:
    """Return the files that a manifest names, in its own folder, with the SHA-256 of each.

    Raises:
        InputError: It is no manifest, or names a file elsewhere.
    """
    files = json_object(manifest, where=MANIFEST).get("files")
    if not isinstance(files, dict) or not all(isinstance(digest, str) for digest in files.values()):
        raise InputError(where=MANIFEST, found=f"files {shown(files)}", needed="the SHA-256 of each file, by its name")
    for name in files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or str(path) != name:
            raise InputError(where=MANIFEST, found=f"it names {name}, which is outside", needed="files beside it")
    return files


def write_torch(value: object, file: BinaryIO) -> None:
    """Write tensors and plain values.

    Raises:
        OSError: The disk is full, or another system error, which torch itself would hide.
    """
    import torch  # checkpoints are listed without it

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
        UnreachableError: It cannot be read.
    """
    import torch

    needed = "a file that this program wrote"
    with user_can_read(path, needed=needed):
        try:
            _require_as_written(path)
            return torch.load(path, weights_only=True, map_location="cpu")
        except Exception as error:  # of a damaged file torch raises anything
            if is_refusal(error):
                raise
            found = f"cannot be read ({error})"
            if isinstance(error, pickle.UnpicklingError):
                found = "more than tensors and plain values: such a file can run foreign code"
            raise InputError(where=str(path), found=found, needed=needed) from None


def _require_as_written(path: Path) -> None:
    """Refuse other formats that torch reads, too: a small file of these may take any memory.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no zip archive, or its parts are compressed.
    """
    with zipfile.ZipFile(path) as archive:
        if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
            raise ValueError("its parts are compressed")


# ---- selection ----


@dataclass(frozen=True)
class SelectedCheckpoint:
    """A complete checkpoint, and how it was selected."""

    path: Path
    why: str  # how it was selected, in words
    by: str  # how it was requested, as of `select_checkpoint`
    newest: RunState  # progress of the run at its newest checkpoint

    def __str__(self) -> str:
        """Return its name, and how it was selected."""
        return f"{self.path.name} ({self.why})"


def select_checkpoint(run: Path, by: str = SELECTED) -> SelectedCheckpoint:
    """Return a complete checkpoint of a run.

    Args:
        run: The run's folder.
        by: selected: the best where there is one, else the newest; newest; best (by validation, see
            `checkpoint.keep_best`); or a number of optimizer steps.

    Raises:
        InputError: There is no such checkpoint, or it is damaged; names the existing ones.
    """
    folder = run / CHECKPOINTS
    newest = newest_checkpoint(folder)
    if newest is None:
        fix = f"Continue the training with `{shell_command('train', run, '--resume')}`"
        raise InputError(where=str(run), found="a run without a whole checkpoint", needed="at least one", fix=fix)
    state = written_state(newest)
    if by == NEWEST or (by == SELECTED and state.best_step is None):
        why = "the newest" if by == NEWEST else "the newest: none was selected"
        return SelectedCheckpoint(newest, why, by, state)
    is_best = by in {SELECTED, BEST}
    step = state.best_step if is_best else step_of(f"step-{by.zfill(8)}")
    path = folder / checkpoint_name(step or 0)
    problem: str | None
    if step is None:
        why = "no validation yet, it measured something else since, checkpoint.keep_best was off, or it was deleted"
        problem = f"no best checkpoint ({why})" if is_best else f"--checkpoint {by}"
    elif not path.is_dir():
        problem = f"no checkpoint of step {step:,}"
    else:
        problem = (damage := find_damage(path)) and f"{path.name} is damaged: {damage}"
    if problem:
        steps = ", ".join(str(step_of(path.name)) for path in listed(folder) if find_damage(path) is None)
        raise InputError(where=str(folder), found=problem, needed=f"selected, newest, best or one of the steps {steps}")
    measure = "error" if state.best_rank is None else "action ranking"
    return SelectedCheckpoint(path, f"the best by {measure}" if is_best else "as asked for", by, state)
