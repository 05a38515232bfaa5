"""Setup of a run before the first step: device, data, model, adapter and optimizer, with checks."""

from __future__ import annotations

import math
import platform
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator

from vjepa2_ac.config import Config, ReplayConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.model import ModelSizes
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index import fingerprint_of
from vjepa2_ac.data.loader import require_shared_memory, validation_batches
from vjepa2_ac.data.selection import describe_splits, named
from vjepa2_ac.distributed import agreed, all_gather_object, first_of_machine, first_only, make_accelerator
from vjepa2_ac.encoding.batch import extrinsics_for
from vjepa2_ac.encoding.encode_dataset import with_latents
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.adapter_folder import read_card
from vjepa2_ac.model.checkpoints import base_sizes, load_base
from vjepa2_ac.model.compilation import require_compiler
from vjepa2_ac.model.lora import add_adapter, trainable_report
from vjepa2_ac.model.world_model import WorldModel, fit_heads, heads_to_replace, require_trained
from vjepa2_ac.registry import TRAINING_HOOKS
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import ADAPTER, CHECKPOINTS, RunState, newest_checkpoint, written_state
from vjepa2_ac.runs.folder import CONFIG, read_run_config
from vjepa2_ac.training.cost import batch_bytes
from vjepa2_ac.training.cuda_graph import GraphedMicroStep
from vjepa2_ac.training.optim import make_optimizer
from vjepa2_ac.training.step import Objective, Run, micro_step

_STEP_TOLERANCE = 0.01  # by which the time of a model step may differ
_CLIPS_TRIED = 8  # one is read; the others are for clips skipped by data.broken_episodes


def set_up(
    config: Config,
    reporter: Reporter = SILENT,
    accelerator: Accelerator | None = None,
    *,
    check_only: bool = False,
    allow_config_change: bool = False,
) -> Run:
    """Return a run before step 1: its data, and its model with an adapter; data are encoded if `data.cache` says so.

    The base chooses the stride where that is auto. A clip of each split is read before a model is loaded.

    Args:
        config: The run.
        reporter: Receives messages, and the progress of indexing and encoding.
        accelerator: The result of `make_accelerator` for this config; None: it is created here.
        check_only: Encode nothing, and report the amount of data to encode.
        allow_config_change: The run in the folder may have begun with other data sets.

    Raises:
        InputError: A part of the run cannot be used; says which.
    """
    accelerator = accelerator or make_accelerator(config)
    if config.training.compile == "blocks":
        require_compiler(accelerator.device.type, where="training.compile")
    strip = TRAINING_HOOKS.find("validation.decoder")(config) if config.validation.decoder is not None else None

    # The other processes of a machine wait for the first process, and then read the index that it has written.
    dataset, *others = first_of_machine(accelerator, lambda: open_data_sets(config, reporter))
    for warning in TRAINING_HOOKS.find("motion")(dataset):
        reporter.note(f"Warning: {warning.text}.")
    _check_heads(config, dataset)
    world_model, calibration = None, None
    if config.data.stride == "auto":
        world_model, calibration = TRAINING_HOOKS.find("data.stride")(config, dataset, accelerator, reporter)
        config, dataset = config.with_stride(calibration.stride), dataset.with_stride(calibration.stride)
    splits: tuple[Split, ...] = ("train", "validation", "test") if config.data.test_share else ("train", "validation")
    clip, *_ = [first_clip(dataset, split) for split in splits]  # fails early: an empty split, a broken clip
    require_fitting_clips(dataset, others)
    if not allow_config_change:
        first_only(accelerator, lambda: require_same_data(config, (dataset, *others)))

    reporter.task(LOADING)
    base = world_model or load_base(config.model, seed=config.seed)
    first_only(accelerator, lambda: require_same_base(config, base))
    extrinsics_for(base, clip)
    if strip is not None:
        strip.require_fit(base, config)
    _require_shared_memory(config, clip, base.sizes, accelerator)
    for replayed in others:
        extrinsics_for(base, first_clip(replayed))
    use = partial(with_latents, model=base, accelerator=accelerator, reporter=reporter, check_only=check_only)
    dataset = use(config, dataset)
    others = [use(config.for_replay(), replayed) for replayed in others]
    require_fitting_clips(dataset, others)
    _make_trainable(base, config, dataset, reporter)
    base.to(accelerator.device)
    return Run(
        config=config,
        accelerator=accelerator,
        world_model=base,
        objective=Objective(base, config.training),
        micro_step=GraphedMicroStep() if config.training.cuda_graph else micro_step,
        optimizer=make_optimizer(base, config.training),
        scaler=torch.amp.GradScaler(accelerator.device.type, enabled=config.training.precision == "fp16"),
        dataset=dataset,
        state=RunState(step=0),
        micro_batches=config.training.accumulation * accelerator.num_processes,
        calibration=None if calibration is None else calibration.as_dict(),
        replayed=others[0] if others else None,
        strip=strip,
    )


def _require_shared_memory(config: Config, clip: Batch, sizes: ModelSizes, accelerator: Accelerator) -> None:
    is_encoded_later = config.data.takes_latents and clip.latents is None
    size = batch_bytes(config, sizes) if is_encoded_later else clip.nbytes * config.training.batch_size
    nodes = all_gather_object(accelerator, platform.node())
    agreed(accelerator, lambda: require_shared_memory(config.data, size, nodes.count(platform.node())))


def _make_trainable(world_model: WorldModel, config: Config, dataset: Dataset, reporter: Reporter) -> None:
    """Fit the heads to the data, add an adapter, and apply the options of `training` for the computation."""
    _fit_heads(world_model, config, dataset, reporter)
    add_adapter(world_model, config.adapter, seed=config.seed)
    reporter.note(str(trainable_report(world_model)))
    if unusual := config.adapter.out_of_line:
        reporter.note(f"Warning: {unusual}.")
    copies = config.model.is_random
    if copies and (narrow := world_model.sizes.too_narrow_to_copy):
        reporter.note(f"Warning: {narrow}.")
    world_model.set_gradient_checkpointing(config.training.gradient_checkpointing)
    world_model.set_attention(config.training.attention)
    world_model.set_compiled("with gradients" if config.training.compile == "blocks" else "never")
    if dataset.config.is_cache:
        world_model.set_encoder_aside()


def _check_heads(config: Config, dataset: Dataset) -> None:
    """Refuse, before the model is loaded, data whose widths differ from the base's if no layer is trained on them.

    Raises:
        InputError: A new head would not be trained; or the stride is to be chosen by the base, which cannot predict
            from this data.
    """
    heads, widths = heads_to_replace(base_sizes(config.model), dataset.widths), dataset.widths
    if heads and config.data.stride == "auto":
        found = f"auto, for states of {widths.state} and actions of {widths.action} numbers"
        needed = "widths that the base was trained with: it is measured at each candidate stride"
        raise InputError(where="data.stride", found=found, needed=needed, fix="Set it to a number of control steps")
    require_trained(heads, config.adapter)


def _fit_heads(world_model: WorldModel, config: Config, dataset: Dataset, reporter: Reporter) -> None:
    """Replace the input heads of a base that do not fit the widths of the data, and report the new heads."""
    heads = heads_to_replace(world_model.sizes, dataset.widths)
    for line in fit_heads(world_model, dataset.widths, config.seed):
        reporter.note(line)
    if config.data.states != "vector" or config.adapter.kind == "none" or config.model.is_random:
        return
    for name in ("state_encoder", "action_encoder") if world_model.sizes.predictor.use_states else ("action_encoder",):
        if name not in {*heads, *config.adapter.modules_to_save}:
            reporter.note(
                f"{name.replace('_', ' ')}: the base's own, as wide as the data. If its numbers mean something else"
                f" than those the base was trained on, add {name} to adapter.modules_to_save"
            )


# ---- data sets: whether their clips can be in one batch, and whether they are those of earlier starts ----


def open_data_sets(config: Config, reporter: Reporter) -> list[Dataset]:
    """Open the data set of a run, and that of `replay` where there is one.

    Raises:
        InputError: A data set cannot be opened; or both differ in their spaces, or in the duration of a model step.
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
    """Return the first clip of a split that can be read."""
    return next(validation_batches(dataset, split, clips=_CLIPS_TRIED, batch_size=1))


def require_fitting_clips(first: Dataset, others: Sequence[Dataset]) -> None:
    """Refuse a second data set whose clips cannot be in one batch with those of the first.

    Data sets that are still to be encoded are accepted.

    Raises:
        InputError: Frames differ in size, or latents in type; says how they differ.
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
    """Refuse to resume a run with other data sets than it was started with.

    A data set at the same path may have changed, which is reported. A data set at another path must be the same.

    Raises:
        InputError: A data set at another path differs.
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
    """Refuse a base at another path than before if it is not the base that the run was trained on.

    Raises:
        InputError: The base is another one.
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
