"""Setup of a run before the first step: device, data, model, adapter and optimizer, with checks.

What only some runs use is imported where they use it: a stride chosen by the model, strips.
"""

from __future__ import annotations

import platform
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from accelerate import Accelerator
from torch import nn

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.model import ModelSizes
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import Batches, Mixed, ProcessShare, training_loader
from vjepa2_ac.data.streams import copies_for, require_shared_memory
from vjepa2_ac.distributed import (
    PRECISIONS,
    agreed,
    all_gather_object,
    broadcast_object,
    first_of_machine,
    first_only,
    make_accelerator,
)
from vjepa2_ac.encoding.batch import encode_batch, extrinsics_for
from vjepa2_ac.encoding.encode_dataset import with_latents
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.lora import add_adapter, trainable_report
from vjepa2_ac.model.adapter.low_rank import CastMatrices
from vjepa2_ac.model.checkpoints import base_sizes, load_base
from vjepa2_ac.model.network.compilation import require_compiler
from vjepa2_ac.model.network.world_model import WorldModel, fit_heads, heads_to_replace, require_trained
from vjepa2_ac.reporter import LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.training.cost.memory import batch_bytes
from vjepa2_ac.training.data_sets import (
    first_clip,
    open_data_sets,
    require_fitting_clips,
    require_same_base,
    require_same_data,
)
from vjepa2_ac.training.loss import Objective
from vjepa2_ac.training.micro_step import GraphedMicroStep, MicroStep, captured, plain_micro_step
from vjepa2_ac.training.optim import make_optimizer, trained_parameters

if TYPE_CHECKING:
    from vjepa2_ac.evaluation.calibration.variants import Calibration
    from vjepa2_ac.training.imagined_strip import ImaginedStrip


@dataclass
class Run:
    """All parts of a run, assembled and checked."""

    config: Config  # its stride is a number
    accelerator: Accelerator  # device, precision, and the place among processes
    world_model: WorldModel
    objective: Objective
    optimizer: torch.optim.Optimizer
    scaler: torch.amp.GradScaler  # has no effect except with fp16
    dataset: Dataset
    state: RunState
    micro_batches: int  # of an optimizer step, of all processes together
    calibration: Calibration | None = None  # if data.stride was auto and is now chosen
    replayed: Dataset | None = None  # the second data set, if there is one
    strip: ImaginedStrip | None = None  # of `validation.decoder`

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return Path(self.config.run_dir)

    @property
    def datasets(self) -> list[Dataset]:
        """Its data set, and the replayed one."""
        return [one for one in (self.dataset, self.replayed) if one is not None]

    @cached_property
    def trained(self) -> list[nn.Parameter]:
        """The parameters of the optimizer."""
        return list(trained_parameters(self.objective))

    @cached_property
    def cast_matrices(self) -> CastMatrices:
        """The adapter in the type of the computation."""
        return CastMatrices(self.world_model.predictor, PRECISIONS[self.config.training.precision])

    @cached_property
    def micro_step(self) -> MicroStep:
        """Adds the gradients of some clips; where `training.cuda_graph` says so, as a graph."""
        plain = partial(plain_micro_step, self.objective, self.accelerator, self.scaler)
        return GraphedMicroStep(plain, self.trained, captured) if self.config.training.cuda_graph else plain

    @property
    def clips_per_step(self) -> int:
        """Clips of an optimizer step, of all processes together."""
        return self.micro_batches * self.config.training.batch_size

    @property
    def share(self) -> ProcessShare:
        """The place of this process among those that share the clips."""
        return ProcessShare(self.accelerator.process_index, self.accelerator.num_processes, self.micro_batches)


def set_up(
    config: Config,
    reporter: Reporter = SILENT,
    accelerator: Accelerator | None = None,
    *,
    check_only: bool = False,
    allow_config_change: bool = False,
) -> Run:
    """Return a run before step 1: its data, and its model with an adapter; data are encoded if `data.cache` says so.

    A model chooses the stride where that is auto; and a clip of each split is read before one is loaded.

    Args:
        config: The run.
        reporter: Receives messages, and the progress of indexing and encoding.
        accelerator: The result of `make_accelerator` for this config; None: it is created here.
        check_only: Encode nothing, and report how much that would be.
        allow_config_change: The run in the folder may have begun with other data sets.

    Raises:
        InputError: Something cannot be used.
    """
    accelerator, is_auto = accelerator or make_accelerator(config), config.data.stride == "auto"
    if config.training.compile == "blocks":
        require_compiler(accelerator.device.type, where="training.compile")
    if is_auto:
        from vjepa2_ac.evaluation.calibration.variants import require_learned

        require_learned(config.model)
    decoder = None
    if config.validation.decoder is not None:
        from vjepa2_ac.decoding.decoder_folder import load_decoder

        decoder = load_decoder(config.validation.decoder, where="validation.decoder:")
    # The others find the index of the first one on this machine, however long it takes.
    dataset, *others = first_of_machine(accelerator, lambda: open_data_sets(config, reporter))
    from vjepa2_ac.inspection.motion import warnings_from_index

    for warning in warnings_from_index(dataset):
        reporter.note(f"Warning: {warning.text}.")
    _check_heads(config, dataset)
    chooser, calibration = None, None
    if is_auto:
        chooser = load_base(config.model, seed=config.seed).to(accelerator.device)
        calibration = broadcast_object(accelerator, choose_stride(chooser, dataset, config, accelerator, reporter))
        config, dataset = config.with_stride(calibration.stride), dataset.with_stride(calibration.stride)
    splits: tuple[Split, ...] = ("train", "validation", "test") if config.data.test_share else ("train", "validation")
    clip, *_ = [first_clip(dataset, split) for split in splits]  # fails early: an empty split, a broken clip
    require_fitting_clips(dataset, others)
    if not allow_config_change:
        first_only(accelerator, lambda: require_same_data(config, (dataset, *others)))

    reporter.task(LOADING)
    world_model = chooser or load_base(config.model, seed=config.seed)
    first_only(accelerator, lambda: require_same_base(config, world_model))
    extrinsics_for(world_model, clip)
    if decoder is not None:
        decoder.require_fit(world_model, config.data, subject=config.model.base)

    _require_shared_memory(config, clip, world_model.sizes, accelerator)
    for replayed in others:
        extrinsics_for(world_model, first_clip(replayed))
    use = partial(with_latents, model=world_model, accelerator=accelerator, reporter=reporter, check_only=check_only)
    dataset = use(config, dataset)
    others = [use(config.for_replay(), replayed) for replayed in others]
    require_fitting_clips(dataset, others)
    _make_trainable(world_model, config, dataset, reporter)
    strip = None
    if decoder is not None:
        from vjepa2_ac.training.imagined_strip import ImaginedStrip

        strip = ImaginedStrip(decoder, dataset, world_model.image_size)
    world_model.to(accelerator.device)
    return Run(
        config=config,
        accelerator=accelerator,
        world_model=world_model,
        objective=Objective(world_model, config.training),
        optimizer=make_optimizer(world_model, config.training),
        scaler=torch.amp.GradScaler(accelerator.device.type, enabled=config.training.precision == "fp16"),
        dataset=dataset,
        state=RunState(step=0),
        micro_batches=config.training.accumulation * accelerator.num_processes,
        calibration=calibration,
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


def batches_from(run: Run) -> Batches:
    """Yield the micro-batches of this process from the current step on."""
    replay = run.config.replay
    return training_loader(
        Mixed(run.dataset, run.replayed, replay.share if replay else 0.0),
        seed=run.config.seed,
        batch_size=run.config.training.batch_size,
        start_position=run.state.clips_done,
        share=run.share,
        copies=copies_for(run.accelerator.device),
    )


def encode(run: Run, batch: Batch) -> LatentBatch:
    """Return the latents of a batch on the run's device, in its precision."""
    with run.accelerator.autocast():
        return encode_batch(run.world_model, batch, device=run.accelerator.device, chunk=run.config.model.encode_chunk)


def _check_heads(config: Config, dataset: Dataset) -> None:
    """Refuse, before the model is loaded, data of other widths than the base's if no layer would learn them.

    Raises:
        InputError: A new head would not be trained; or the stride is to be chosen by the base, which cannot predict
            from this data.
    """
    heads, widths = heads_to_replace(base_sizes(config.model), dataset.widths), dataset.widths
    if heads and config.data.stride == "auto":
        found = f"auto, for states of {widths.state} and actions of {widths.action} numbers"
        needed = "widths that the base knows: it is asked at which stride it predicts best"
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


def choose_stride(
    world_model: WorldModel, dataset: Dataset, config: Config, accelerator: Accelerator, reporter: Reporter
) -> Calibration:
    """Let the model of a run, before training, choose among the candidates at which the run's clips fit into episodes.

    Raises:
        InputError: There is none, or as `calibrate_model`.
    """
    from vjepa2_ac.evaluation.calibration.variants import calibrate_model
    from vjepa2_ac.evaluation.measure import ClipSample

    reporter.note("data.stride is auto: measuring the model at each candidate stride")
    fitting, errors = [], []
    for stride in dataset.config.strides_to_try(dataset.control_rate_hz):
        view = dataset.with_stride(stride)
        try:
            view.windows("train"), view.windows("validation")
        except InputError as error:
            errors.append(error)
            reporter.note(f"  stride {stride}: not possible: no clip of {dataset.config.frames} frames fits")
        else:
            fitting.append(stride)
    if not fitting:
        raise errors[0]
    candidates = replace(dataset, config=dataset.config.model_copy(update={"stride_candidates": tuple(fitting)}))
    calibration = calibrate_model(
        world_model, candidates, config, accelerator, ClipSample(clips=config.validation.clips)
    )
    for row in calibration.rows(""):
        reporter.note(f"  {row.name}: error/persistence {row}")
    reporter.note(calibration.verdict())
    return calibration
