"""Set up a run before the first step: device, data, model, adapter and optimizer, with checks."""

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
from vjepa2_ac.data.index import compute_fingerprint
from vjepa2_ac.data.loader import require_shared_memory, validation_batches
from vjepa2_ac.data.selection import describe_splits, format_identities
from vjepa2_ac.distributed import all_gather_object, make_accelerator, run_first_per_machine, run_on_all, run_on_first
from vjepa2_ac.encoding.batch import get_extrinsics
from vjepa2_ac.encoding.encode_dataset import use_latent_cache
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.adapter_folder import read_card
from vjepa2_ac.model.checkpoints import base_sizes, load_base
from vjepa2_ac.model.compilation import require_compiler
from vjepa2_ac.model.lora import add_adapter, trainable_report
from vjepa2_ac.model.world_model import (
    WorldModel,
    find_projections_to_replace,
    replace_input_projections,
    require_trained_projections,
)
from vjepa2_ac.registry import TRAINING_HOOKS
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import ADAPTER, CHECKPOINTS, RunState, newest_checkpoint, read_state_file
from vjepa2_ac.runs.folder import CONFIG, read_run_config
from vjepa2_ac.training.config_warnings import list_config_warnings
from vjepa2_ac.training.cost import batch_bytes
from vjepa2_ac.training.cuda_graph import GraphedMicroStep
from vjepa2_ac.training.optim import make_optimizer
from vjepa2_ac.training.step import Objective, Run, micro_step

_STEP_TOLERANCE = 0.01  # relative difference allowed between the model steps (in seconds) of data and replay
_CLIPS_TRIED = 8  # more than one, because data.broken_episodes=skip may skip some of them


def set_up(
    config: Config,
    reporter: Reporter = SILENT,
    accelerator: Accelerator | None = None,
    *,
    check_only: bool = False,
    allow_config_change: bool = False,
) -> Run:
    """Return a run before step 1, with data and adapted model; encode the data if `data.cache` requests it.

    With `data.stride=auto` the base model chooses the stride. A clip of each split is read before a model is loaded.

    Args:
        config: The config of the run.
        reporter: Receives messages, and the progress of indexing and encoding.
        accelerator: The result of `make_accelerator` for this config; created here if None.
        check_only: Encode nothing, and report the amount of data to encode.
        allow_config_change: Accept other data sets than those with which the run in the folder was started.

    Raises:
        InputError: A part of the run cannot be used; names that part.
    """
    accelerator = accelerator or make_accelerator(config)
    if config.data.stride == "auto" and config.model.is_random:  # before the data set is indexed
        needed, fix = "a trained base model, which is evaluated at each candidate stride", "Set data.stride to a number"
        raise InputError(where="data.stride", found="auto, with model.base random", needed=needed, fix=fix)
    if config.training.compile == "blocks":
        require_compiler(accelerator.device.type, where="training.compile")
    image_strip = TRAINING_HOOKS.find("validation.decoder")(config) if config.validation.decoder is not None else None

    # The other processes of a machine wait for the first process, and then read the index that the first one wrote.
    dataset, *replay_datasets = run_first_per_machine(accelerator, lambda: open_data_sets(config, reporter))
    for warning in TRAINING_HOOKS.find("motion")(dataset):
        reporter.note(f"Warning: {warning.text}.")
    _check_input_projections(config, dataset)
    world_model, calibration = None, None
    if config.data.stride == "auto":
        world_model, calibration = TRAINING_HOOKS.find("data.stride")(config, dataset, accelerator, reporter)
        config, dataset = config.with_stride(calibration.stride), dataset.with_stride(calibration.stride)
    for text in list_config_warnings(config, dataset.control_rate_hz):
        reporter.note(f"Warning: {text}.")
    splits: tuple[Split, ...] = ("train", "validation", "test") if config.data.test_share else ("train", "validation")
    clip, *_ = [first_clip(dataset, split) for split in splits]  # an empty split or a broken clip raises here
    require_fitting_clips(dataset, replay_datasets)
    if not allow_config_change:
        run_on_first(accelerator, lambda: require_same_data(config, (dataset, *replay_datasets)))

    reporter.task(LOADING)
    base = world_model or load_base(config.model, seed=config.seed)
    run_on_first(accelerator, lambda: require_same_base(config, base))
    get_extrinsics(base, clip)
    if image_strip is not None:
        image_strip.require_compatible(base, config)
    _require_shared_memory(config, clip, base.sizes, accelerator)
    for replayed in replay_datasets:
        get_extrinsics(base, first_clip(replayed))
    cache_latents = partial(
        use_latent_cache, model=base, accelerator=accelerator, reporter=reporter, check_only=check_only
    )
    dataset = cache_latents(config, dataset)
    replay_datasets = [cache_latents(config.for_replay(), replayed) for replayed in replay_datasets]
    require_fitting_clips(dataset, replay_datasets)
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
        replay_dataset=replay_datasets[0] if replay_datasets else None,
        image_strip=image_strip,
    )


def _require_shared_memory(config: Config, clip: Batch, sizes: ModelSizes, accelerator: Accelerator) -> None:
    is_encoded_later = config.data.uses_cached_latents and clip.latents is None
    clips = config.training.batch_size
    size = batch_bytes(config, sizes, clips) if is_encoded_later else clip.nbytes * clips
    nodes = all_gather_object(accelerator, platform.node())
    run_on_all(accelerator, lambda: require_shared_memory(config.data, size, nodes.count(platform.node())))


def _make_trainable(world_model: WorldModel, config: Config, dataset: Dataset, reporter: Reporter) -> None:
    """Fit the input projections to the data, add an adapter, and apply the `training` options of the computation."""
    _replace_input_projections(world_model, config, dataset, reporter)
    add_adapter(world_model, config.adapter, seed=config.seed)
    reporter.note(str(trainable_report(world_model)))
    if problem := config.adapter.alpha_warning:
        reporter.note(f"Warning: {problem}.")
    if config.model.is_random and (reason := world_model.sizes.narrow_predictor_warning):
        reporter.note(f"Warning: {reason}.")
    world_model.set_gradient_checkpointing(config.training.gradient_checkpointing)
    world_model.set_attention(config.training.attention)
    world_model.set_compiled("with gradients" if config.training.compile == "blocks" else "never")
    if dataset.config.is_cache:
        world_model.remove_encoder()


def _check_input_projections(config: Config, dataset: Dataset) -> None:
    """Refuse data that needs new input projections which the config does not train; called before loading the model.

    Raises:
        InputError: A new input projection would not be trained; or `data.stride` is auto, but the base model cannot
            predict from this data.
    """
    replaced, widths = find_projections_to_replace(base_sizes(config.model), dataset.widths), dataset.widths
    if replaced and config.data.stride == "auto":
        problem = f"auto, for states of {widths.state} and actions of {widths.action} numbers"
        needed = "the widths with which the base model was trained, because it is evaluated at each candidate stride"
        raise InputError(where="data.stride", found=problem, needed=needed, fix="Set it to a number of control steps")
    require_trained_projections(replaced, config.adapter)


def _replace_input_projections(world_model: WorldModel, config: Config, dataset: Dataset, reporter: Reporter) -> None:
    """Replace the base model's input projections that do not fit the widths of the data; report the new projections."""
    replaced = find_projections_to_replace(world_model.sizes, dataset.widths)
    for line in replace_input_projections(world_model, dataset.widths, config.seed):
        reporter.note(line)
    if config.data.states != "vector" or config.adapter.kind == "none" or config.model.is_random:
        return
    for name in ("state_encoder", "action_encoder") if world_model.sizes.predictor.use_states else ("action_encoder",):
        if name not in {*replaced, *config.adapter.modules_to_save}:
            reporter.note(
                f"The {name.replace('_', ' ')} of the base model is kept, because its width fits the data. If the"
                f" numbers have another meaning than in the base model's training data, add {name} to"
                " adapter.modules_to_save."
            )


# ---- data sets: check that their clips fit into one batch, and that a resumed run uses the same data ----


def open_data_sets(config: Config, reporter: Reporter) -> list[Dataset]:
    """Open the data set of a run and, if `replay` is configured, the replay data set.

    Raises:
        InputError: A data set cannot be opened; or the two differ in action space, or in the duration of a model step.
    """
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    if splits := describe_splits(dataset.table, config.data):
        reporter.note(f"Splits: {splits}.")
    return [dataset] if config.replay is None else [dataset, _open_replay(config.replay, dataset, reporter)]


def _open_replay(replay: ReplayConfig, dataset: Dataset, reporter: Reporter) -> Dataset:
    replayed = open_dataset(replay.data, progress=reporter.task(INDEXING))
    if replayed.widths != dataset.widths or replayed.spaces != dataset.spaces:
        problem, needed = (
            f"states of {opened.widths.state} and actions of {opened.widths.action} numbers ({opened.config.states})"
            for opened in (replayed, dataset)
        )
        where = f"replay.data.path: {replayed.config.path}"
        fix = "Use a replay data set with the same format of states and actions"
        raise InputError(where=where, found=problem, needed=f"{needed}, as in data", fix=fix)
    replay_step_s, step_s = (opened.config.model_stride / opened.control_rate_hz for opened in (replayed, dataset))
    if not math.isclose(replay_step_s, step_s, rel_tol=_STEP_TOLERANCE):  # data sets have different control rates
        problem = f"{replayed.config.stride}: model steps of {replay_step_s:.3g} s"
        needed = f"model steps of {step_s:.3g} s, as in data (stride {dataset.config.stride})"
        fix = f"Set replay.data.stride={step_s * replayed.control_rate_hz:.3g}, or change data.stride"
        raise InputError(where="replay.data.stride", found=problem, needed=needed, fix=fix)
    windows = replayed.windows("train")
    available = counted(len(windows), "clip")
    reporter.note(f"Replay: {replay.share:.0%} of the training clips are drawn from {replay.data.path} ({available}).")
    hashes = dataset.table.id_hash[dataset.is_selected & ~dataset.split_mask("train")]
    indices = np.flatnonzero(replayed.split_mask("train") & np.isin(replayed.table.id_hash, hashes))
    if held_out := sorted(replayed.table.identity(int(index)) for index in indices):
        reporter.note(
            f"Warning: the replay data set would train on {counted(len(held_out), 'held-out episode')} of the first"
            f" data set: {format_identities(held_out)}. Add them to replay.data.exclude."
        )
    return replayed


def first_clip(dataset: Dataset, split: Split = "train") -> Batch:
    """Return the first clip of a split that can be read."""
    return next(validation_batches(dataset, split, clips=_CLIPS_TRIED, batch_size=1))


def require_fitting_clips(first: Dataset, replay_datasets: Sequence[Dataset]) -> None:
    """Refuse a replay data set whose clips cannot be in one batch with those of the first data set.

    Data sets that are not encoded yet are accepted.

    Raises:
        InputError: Frames differ in size, or latents in type; the message describes both.
    """
    for replayed in replay_datasets:
        configs = (first.config, replayed.config)
        if any(config.uses_cached_latents and not config.is_cache for config in configs):
            continue  # not encoded yet
        clips, needed = (_describe_clip(first_clip(dataset)) for dataset in (replayed, first))
        if clips != needed:
            needed = f"{needed}, as in data, because a micro-batch has clips of both data sets"
            fix = "Set data.cache and replay.data.cache to auto, with the same cache_dtype"
            raise InputError(where="replay.data", found=f"clips of {clips}", needed=needed, fix=fix)


def require_same_data(config: Config, datasets: Sequence[Dataset]) -> None:
    """Refuse to resume a run with other data sets than those it was started with.

    A data set that changed at the same path is accepted; `resume.restore` reports a changed number of clips. A data set
    at another path must have the same content.

    Raises:
        InputError: A data set at another path has other content.
    """
    folder = Path(config.run_dir)
    if not (folder / CONFIG).is_file() or (checkpoint := newest_checkpoint(folder / CHECKPOINTS)) is None:
        return
    keys, states = ("data.path", "replay.data.path"), read_state_file(checkpoint).data
    earlier_configs = read_run_config(folder).data_sets
    for key, dataset, old_config, new_config, state in zip(
        keys, datasets, earlier_configs, config.data_sets, states, strict=False
    ):
        if old_config.path != new_config.path and state.fingerprint != compute_fingerprint(dataset.table):
            raise InputError(
                where=f"{key}: {new_config.path}",
                found="episodes or files that differ from those of the run",
                needed=f"the data set that was at {old_config.path}",
                fix=f"Set {key} to its new path. To resume with the other data, add --allow-config-change",
            )


def require_same_base(config: Config, model: WorldModel) -> None:
    """Refuse to resume with another base model than the one that the run was started with; its path may change.

    Raises:
        InputError: The base model differs.
    """
    folder = Path(config.run_dir)
    is_moved = (folder / CONFIG).is_file() and read_run_config(folder).model != config.model
    if is_moved and (checkpoint := newest_checkpoint(folder / CHECKPOINTS)) is not None:
        read_card(checkpoint / ADAPTER, model)


def _describe_clip(batch: Batch) -> str:
    if batch.latents is not None:
        values = batch.latents.values
        scaled = " with scales" if batch.latents.scales is not None else ""
        return f"{values.shape[-2]} latents of {values.shape[-1]} numbers as {str(values.dtype)[6:]}{scaled}"
    if batch.frames is None:
        raise ValueError("a batch with neither frames nor latents")
    height, width = batch.frames.shape[2:4]
    return f"frames of {height}x{width} after the crop"
