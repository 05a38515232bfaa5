"""Setup of a run before the first step: device, data, model, adapter and optimizer, with checks."""

from __future__ import annotations

import platform
from functools import partial

import torch
from accelerate import Accelerator

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.model import ModelSizes
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.streams import require_shared_memory
from vjepa2_ac.distributed import agreed, all_gather_object, first_of_machine, first_only, make_accelerator
from vjepa2_ac.encoding.batch import extrinsics_for
from vjepa2_ac.encoding.encode_dataset import with_latents
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.lora import add_adapter, trainable_report
from vjepa2_ac.model.checkpoints import base_sizes, load_base
from vjepa2_ac.model.network.compilation import require_compiler
from vjepa2_ac.model.network.world_model import WorldModel, fit_heads, heads_to_replace, require_trained
from vjepa2_ac.registry import TRAINING_HOOKS
from vjepa2_ac.reporter import LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.training.cost import batch_bytes
from vjepa2_ac.training.cuda_graph import GraphedMicroStep
from vjepa2_ac.training.data_sets import (
    first_clip,
    open_data_sets,
    require_fitting_clips,
    require_same_base,
    require_same_data,
)
from vjepa2_ac.training.optim import make_optimizer
from vjepa2_ac.training.run import Run
from vjepa2_ac.training.step import Objective, micro_step


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
        check_only: Encode nothing, and report how much that would be.
        allow_config_change: The run in the folder may have begun with other data sets.

    Raises:
        InputError: Something cannot be used.
    """
    accelerator = accelerator or make_accelerator(config)
    if config.training.compile == "blocks":
        require_compiler(accelerator.device.type, where="training.compile")
    choose_stride = TRAINING_HOOKS.find("data.stride")(config) if config.data.stride == "auto" else None
    strip = TRAINING_HOOKS.find("validation.decoder")(config) if config.validation.decoder is not None else None

    # The other processes of a machine find the index of the first one, however long that takes.
    dataset, *others = first_of_machine(accelerator, lambda: open_data_sets(config, reporter))
    for warning in TRAINING_HOOKS.find("motion")(dataset):
        reporter.note(f"Warning: {warning.text}.")
    _check_heads(config, dataset)
    world_model, calibration = None, None
    if choose_stride is not None:
        world_model = load_base(config.model, seed=config.seed).to(accelerator.device)
        calibration = choose_stride(world_model, dataset, accelerator, reporter)
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
    """Put heads of the data's widths and an adapter on a base, and let it compute as `training` says."""
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
    """Refuse, before the model is loaded, data of other widths than the base's if no layer would learn them.

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
    """Give a base new input heads if the data's states or actions have other widths, and report them."""
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
