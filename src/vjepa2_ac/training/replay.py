"""The second data set of a run (`replay`): opened, and refused where its clips cannot be beside those of the first."""

from __future__ import annotations

import math

import numpy as np

from vjepa2_ac.config.run import ReplayConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.selection import named
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import INDEXING, Reporter

_STEP_TOLERANCE = 0.01  # by which the time of a model step may differ


def open_replay(replay: ReplayConfig, dataset: Dataset, reporter: Reporter) -> Dataset:
    """Open the second data set of a run.

    Args:
        replay: Which one.
        dataset: The first data set, at its stride.
        reporter: Receives messages, and the progress of indexing.

    Raises:
        InputError: It cannot be opened; or its spaces or the time of its steps are others than the first one's.
    """
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
    if held_out := _held_out(dataset, replayed):
        reporter.note(
            f"Warning: {len(held_out):,} episodes that the first data set holds out are replayed in training:"
            f" {named(held_out)}. Add them to replay.data.exclude."
        )
    return replayed


def require_same_form(first: Batch, replayed: Batch) -> None:
    """Refuse clips that cannot be in one batch: of other pictures, or latents of another type.

    Args:
        first: A clip of the first data set.
        replayed: One of the second.

    Raises:
        InputError: Says how they differ.
    """
    found, needed = (_form(batch) for batch in (replayed, first))
    if found != needed:
        needed = f"{needed}, as data have them: clips of both are in one micro-batch"
        fix = "Take latents instead of frames: set data.cache and replay.data.cache to auto, with the same cache_dtype"
        raise InputError(where="replay.data", found=f"clips of {found}", needed=needed, fix=fix)


def _held_out(dataset: Dataset, replayed: Dataset) -> list[str]:
    """Return the replayed training episodes that the first data set, by their identity, validates or tests on."""
    held_out = dataset.table.id_hash[dataset.taking_part & ~dataset.members("train")]
    places = np.flatnonzero(replayed.members("train") & np.isin(replayed.table.id_hash, held_out))
    return sorted(replayed.table.identity(int(place)) for place in places)


def _form(batch: Batch) -> str:
    if batch.latents is not None:
        values = batch.latents.values
        scaled = " with scales" if batch.latents.scales is not None else ""
        return f"{values.shape[-2]} latents of {values.shape[-1]} numbers as {str(values.dtype)[6:]}{scaled}"
    if batch.frames is None:
        raise ValueError("a batch with neither frames nor latents")
    height, width = batch.frames.shape[2:4]
    return f"frames of {height}x{width} after the crop"
