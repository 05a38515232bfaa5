"""Open the training and replay data sets; check that their clips can share a batch and match earlier starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vjepa2_ac.config import Config, ReplayConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index import fingerprint_of
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.data.selection import named
from vjepa2_ac.data.splits import describe_splits
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.adapter.adapter_folder import read_card
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, Reporter
from vjepa2_ac.runs.checkpoint import ADAPTER, CHECKPOINTS, newest_checkpoint, written_state
from vjepa2_ac.runs.folder import CONFIG, read_run_config

_STEP_TOLERANCE = 0.01  # by which the time of a model step may differ
_CLIPS_TRIED = 8  # one is read; the others are for clips skipped by data.broken_episodes


def open_data_sets(config: Config, reporter: Reporter) -> list[Dataset]:
    """Open the data set of a run, and that of `replay` where there is one.

    Raises:
        InputError: One cannot be opened; or the second one's spaces or the time of its steps are others.
    """
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    if splits := describe_splits(dataset.table, config.data):
        reporter.note(f"Splits: {splits}.")
    return [dataset] if config.replay is None else [dataset, _open_replay(config.replay, dataset, reporter)]


def _open_replay(replay: ReplayConfig, dataset: Dataset, reporter: Reporter) -> Dataset:
    replayed = open_dataset(replay.data, progress=reporter.task(INDEXING))
    if replayed.widths != dataset.widths or replayed.spaces != dataset.spaces:
        found, needed = (
            f"states of {one.widths.state} and actions of {one.widths.action} numbers ({one.config.states})"
            for one in (replayed, dataset)
        )
        where, fix = f"replay.data.path: {replayed.config.path}", "Replay a data set of the same kind of robot"
        raise InputError(where=where, found=found, needed=f"{needed}, as data have them", fix=fix)
    found_s, needed_s = (one.config.model_stride / one.control_rate_hz for one in (replayed, dataset))
    if not math.isclose(found_s, needed_s, rel_tol=_STEP_TOLERANCE):  # data sets have different control rates
        found = f"{replayed.config.stride}: model steps of {found_s:.3g} s"
        needed = f"{needed_s:.3g} s, as those of data (stride {dataset.config.stride})"
        fix = f"Set replay.data.stride={needed_s * replayed.control_rate_hz:.3g}, or the other one"
        raise InputError(where="replay.data.stride", found=found, needed=needed, fix=fix)
    windows = replayed.windows("train")
    reporter.note(f"Replay: {replay.share:.0%} of the clips are from {replay.data.path}, which has {len(windows):,}.")
    hashes = dataset.table.id_hash[dataset.taking_part & ~dataset.members("train")]
    places = np.flatnonzero(replayed.members("train") & np.isin(replayed.table.id_hash, hashes))
    if held_out := sorted(replayed.table.identity(int(place)) for place in places):
        reporter.note(
            f"Warning: {counted(len(held_out), 'episode')} that the first data set holds out are replayed in training:"
            f" {named(held_out)}. Add them to replay.data.exclude."
        )
    return replayed


def first_clip(dataset: Dataset, split: Split = "train") -> Batch:
    """Return a clip of a split, the first that can be read."""
    return next(validation_batches(dataset, split, clips=_CLIPS_TRIED, batch_size=1))


def require_fitting_clips(first: Dataset, others: Sequence[Dataset]) -> None:
    """Refuse a second data set whose clips cannot be in one batch with those of the first; latents to come may.

    Raises:
        InputError: They are of other pictures, or latents of another type; says how they differ.
    """
    for replayed in others:
        if any(one.config.takes_latents and not one.config.is_cache for one in (first, replayed)):
            continue  # not encoded yet
        found, needed = (_form(first_clip(dataset)) for dataset in (replayed, first))
        if found != needed:
            needed = f"{needed}, as data have them: clips of both are in one micro-batch"
            fix = "Take latents instead: set data.cache and replay.data.cache to auto, with the same cache_dtype"
            raise InputError(where="replay.data", found=f"clips of {found}", needed=needed, fix=fix)


def require_same_data(config: Config, datasets: Sequence[Dataset]) -> None:
    """Refuse to go on with other data sets than those that the run in its folder began with.

    At the place where it began the data may have changed, which is reported; elsewhere they must be the same.

    Raises:
        InputError: They are others.
    """
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file() or (checkpoint := newest_checkpoint(folder / CHECKPOINTS)) is None:
        return
    keys, seen = ("data.path", "replay.data.path"), written_state(checkpoint).data
    began = read_run_config(folder).data_sets
    for key, dataset, old, now, before in zip(keys, datasets, began, config.data_sets, seen, strict=False):
        if old.path != now.path and before.fingerprint != fingerprint_of(dataset.table):
            found, needed = "other episodes or files than the run has seen", f"the data set that was at {old.path}"
            fix = f"Set {key} to where that is now; where the change is meant, add --allow-config-change"
            raise InputError(where=f"{key}: {now.path}", found=found, needed=needed, fix=fix)


def require_same_base(config: Config, model: WorldModel) -> None:
    """Refuse a base at another path than the run's if it is not the one that the run was trained on.

    Raises:
        InputError: It is another one.
    """
    folder = Path(config.run_dir)
    is_moved = (folder / CONFIG).is_file() and read_run_config(folder).model != config.model
    if is_moved and (checkpoint := newest_checkpoint(folder / CHECKPOINTS)) is not None:
        read_card(checkpoint / ADAPTER, model)


def _form(batch: Batch) -> str:
    if batch.latents is not None:
        values = batch.latents.values
        scaled = " with scales" if batch.latents.scales is not None else ""
        return f"{values.shape[-2]} latents of {values.shape[-1]} numbers as {str(values.dtype)[6:]}{scaled}"
    if batch.frames is None:
        raise ValueError("a batch with neither frames nor latents")
    height, width = batch.frames.shape[2:4]
    return f"frames of {height}x{width} after the crop"
