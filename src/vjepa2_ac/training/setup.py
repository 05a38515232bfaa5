"""Setup of a run before the first step: device, data, model, adapter, optimizer and newest checkpoint, with checks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from accelerate import Accelerator
from torch import nn

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.duplicates import find_duplicates
from vjepa2_ac.data.index import fingerprint_of
from vjepa2_ac.data.loader import Batches, Mixed, ProcessShare, training_loader, validation_batches
from vjepa2_ac.data.streams import Copies, copies_for
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.distributed.collectives import all_gather_object, broadcast_object
from vjepa2_ac.distributed.device import PRECISIONS
from vjepa2_ac.distributed.launch import make_accelerator
from vjepa2_ac.distributed.shared_memory import warn_if_shared_memory_is_small
from vjepa2_ac.encoding.batch import encode_batch, extrinsics_for
from vjepa2_ac.encoding.encode_dataset import with_latents
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.model.adapter.lora import add_adapter, save_trained, trainable_report
from vjepa2_ac.model.adapter.low_rank import CastMatrices
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import (
    ADAPTER,
    OPTIMIZER,
    RunState,
    checkpoint_name,
    write_checkpoint,
)
from vjepa2_ac.runs.folder import CHECKPOINTS, with_stride
from vjepa2_ac.runs.slow_disk import warn_if_stalled
from vjepa2_ac.runs.torch_file import write_torch
from vjepa2_ac.training.fsdp import full_optimizer_state_dict, full_state_dict
from vjepa2_ac.training.loss import Objective
from vjepa2_ac.training.micro_step import CapturedMicroStep, MicroStep, captured_on_cuda
from vjepa2_ac.training.monitoring.imagined_strip import ImaginedStrip
from vjepa2_ac.training.new_embodiment import check_heads, fit_to_data
from vjepa2_ac.training.optim import make_optimizer, trained_parameters
from vjepa2_ac.training.replay import open_replay, require_same_form

if TYPE_CHECKING:
    from vjepa2_ac.calibration.strides import Calibration


_CLIPS_TRIED = 8  # one is read; the others are for clips skipped by data.broken_episodes


@dataclass(frozen=True)
class RunData:
    """The data of a run, open and checked."""

    config: Config  # of the run; its stride is a number
    accelerator: Accelerator
    dataset: Dataset
    first_clip: Batch  # of training, as it is read from the data set
    calibration: Calibration | None  # if data.stride was auto and is now chosen
    world_model: WorldModel | None  # the base, if it has chosen the stride
    replayed: Dataset | None = None  # the second data set, if there is one
    decoder: TrainedDecoder | None = None  # of `validation.decoder`


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
    micro_batches: int  # of this process, per optimizer step
    calibration: Calibration | None = None  # if data.stride was auto and is now chosen
    replayed: Dataset | None = None  # the second data set, if there is one
    strip: ImaginedStrip | None = None  # of `validation.decoder`

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return Path(self.config.run_dir)

    @property
    def encodes(self) -> bool:
        """Whether clips are frames that go through the encoder, not latents of a cache."""
        return not self.dataset.config.is_cache

    @cached_property
    def trained(self) -> list[nn.Parameter]:
        """The parameters of the optimizer."""
        return list(trained_parameters(self.objective))

    @cached_property
    def cast_matrices(self) -> CastMatrices:
        """The adapter in the type of the computation."""
        return CastMatrices(self.world_model.predictor, PRECISIONS[self.config.training.precision])

    @property
    def micro_step(self) -> MicroStep | CapturedMicroStep:
        """The micro-step."""
        return self.captured or self._plain_micro_step

    @cached_property
    def captured(self) -> CapturedMicroStep | None:
        """The micro-step as a graph, if requested."""
        if not self.config.training.cuda_graph:
            return None
        return CapturedMicroStep(self._plain_micro_step, self.trained, captured_on_cuda)

    @property
    def _plain_micro_step(self) -> MicroStep:
        return MicroStep(self.objective, self.accelerator, self.scaler)

    @property
    def copies(self) -> Copies:
        """The copies of batches to the run's device."""
        return copies_for(self.accelerator.device)

    @property
    def clips_per_step(self) -> int:
        """Clips of an optimizer step, of all processes together."""
        return self.micro_batches * self.config.training.batch_size * int(self.accelerator.num_processes)


def open_data(config: Config, reporter: Reporter = SILENT, accelerator: Accelerator | None = None) -> RunData:
    """Open the data of a run, let its model choose the stride where that is auto, and read a clip of each split.

    Args:
        config: The run.
        reporter: Receives messages, and the progress of indexing.
        accelerator: The result of `make_accelerator` for this config; None: it is created here.

    Raises:
        InputError: Something cannot be used.
    """
    accelerator, is_auto = accelerator or make_accelerator(config), config.data.stride == "auto"
    if is_auto:
        from vjepa2_ac.calibration.variants import require_learned

        require_learned(config.model)
    decoder = _decoder_of(config)
    with accelerator.local_main_process_first():  # the others find the index of the first one on this machine
        dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
        replayed = open_replay(config, dataset, reporter)
    if (duplicates := find_duplicates(dataset)).episodes:
        reporter.note(f"Warning: {duplicates}.")
    check_heads(config, dataset)
    world_model, calibration = None, None
    if is_auto:
        from vjepa2_ac.training.stride_choice import choose_stride

        world_model = load_base(config.model, seed=config.seed).to(accelerator.device)
        calibration = broadcast_object(accelerator, choose_stride(world_model, dataset, config, accelerator, reporter))
        config, dataset = with_stride(config, calibration.best.stride), dataset.with_stride(calibration.best.stride)
    first_clip = _read_one_clip_of_each_split(dataset)
    if replayed is not None:
        _require_fitting_clips(dataset, replayed, first_clip)
    return RunData(config, accelerator, dataset, first_clip, calibration, world_model, replayed, decoder)


def open_model(data: RunData, reporter: Reporter = SILENT, *, check_only: bool = False) -> Run:
    """Load the model of a run, attach its adapter, and encode its data if `data.cache` says so: a run before step 1.

    Args:
        data: The open data of the run.
        reporter: Receives messages, and the progress of encoding.
        check_only: Encode nothing, and report how much that would be.

    Raises:
        InputError: Something cannot be used.
    """
    config, accelerator, training = data.config, data.accelerator, data.config.training
    world_model = data.world_model or load_base(config.model, seed=config.seed)
    extrinsics_for(world_model, data.first_clip)
    if data.decoder is not None:
        data.decoder.require_fit(world_model, config.data.crop, subject=str(config.model.base or "the random model"))
    dataset = with_latents(config, data.dataset, world_model, accelerator, reporter, check_only=check_only)
    replayed = data.replayed
    if replayed is not None:
        extrinsics_for(world_model, _first_of(replayed, "train"))
        alone = config.for_replay()
        replayed = with_latents(alone, replayed, world_model, accelerator, reporter, check_only=check_only)
        _require_fitting_clips(dataset, replayed, _first_of(dataset, "train"))
    warn_if_shared_memory_is_small(config, dataset, data.first_clip, accelerator, reporter)
    fit_to_data(world_model, config, dataset, reporter)
    add_adapter(world_model, config.adapter, seed=config.seed)
    reporter.note(str(trainable_report(world_model)))
    if unusual := config.adapter.out_of_line:
        reporter.note(f"Warning: {unusual}.")
    copies = config.model.random is not None and config.model.random_start == "persistence"
    if copies and (narrow := world_model.sizes.too_narrow_to_copy):
        reporter.note(f"Warning: {narrow}.")
    world_model.set_gradient_checkpointing(training.gradient_checkpointing)
    world_model.set_attention(training.attention)
    world_model.set_compiled("with gradients" if training.compile == "blocks" else "never")
    if dataset.config.is_cache:
        world_model.set_encoder_aside()
    world_model.to(accelerator.device)
    return Run(
        config=config,
        accelerator=accelerator,
        world_model=world_model,
        objective=Objective(world_model, training),
        optimizer=make_optimizer(world_model, training),
        scaler=torch.amp.GradScaler(accelerator.device.type, enabled=training.precision == "fp16"),
        dataset=dataset,
        state=RunState(step=0),
        micro_batches=training.accumulation,
        calibration=data.calibration,
        replayed=replayed,
        strip=None if data.decoder is None else ImaginedStrip(data.decoder, dataset, world_model.image_size),
    )


def batches_from(run: Run) -> Batches:
    """Yield the micro-batches of this process from the current step on."""
    replay = run.config.replay
    return training_loader(
        run.dataset if run.replayed is None or replay is None else Mixed(run.dataset, run.replayed, replay.share),
        seed=run.config.seed,
        batch_size=run.config.training.batch_size,
        start_position=run.state.clips_done,
        share=ProcessShare(run.accelerator.process_index, run.accelerator.num_processes),
        copies=run.copies,
    )


def encode(run: Run, batch: Batch) -> LatentBatch:
    """Return the latents of a batch on the run's device, in its precision."""
    with run.accelerator.autocast():
        return encode_batch(run.world_model, batch, device=run.accelerator.device, chunk=run.config.model.encode_chunk)


def save_checkpoint(run: Run, folder: Path) -> None:
    """Write the state of the run into its folder (see `runs.checkpoint`): all processes call, the first writes."""
    writes = run.accelerator.is_main_process
    weights, moments = (
        full_state_dict(run.world_model, keep=writes),
        full_optimizer_state_dict(run.optimizer, keep=writes),
    )

    def write(inner: Path) -> None:
        save_trained(run.world_model, inner / ADAPTER, weights)
        with (inner / OPTIMIZER).open("wb") as file:
            write_torch(moments, file)

    broken, broken_replayed = (
        {
            name: why
            for reasons in all_gather_object(run.accelerator, one.broken.reasons if one else {})
            for name, why in reasons.items()
        }
        for one in (run.dataset, run.replayed)
    )
    run.state = replace(
        run.state,
        broken=broken,
        windows=len(run.dataset.windows("train")),
        data=fingerprint_of(run.dataset.table),
        replayed_broken=broken_replayed,
        replayed_windows=len(run.replayed.windows("train")) if run.replayed else None,
        replayed_data=fingerprint_of(run.replayed.table) if run.replayed else None,
        clips_per_step=run.clips_per_step,
        clips_asked=run.config.training.batch_size * run.config.training.accumulation,
        processes=run.accelerator.num_processes,
        loss_scale=run.scaler.state_dict() if run.scaler.is_enabled() else None,
    )
    if writes:
        with warn_if_stalled(folder / CHECKPOINTS / checkpoint_name(run.state.step)):
            write_checkpoint(folder / CHECKPOINTS, run.state, write, keep=run.config.checkpoint.keep)


def _decoder_of(config: Config) -> TrainedDecoder | None:
    name = config.validation.decoder
    return None if name is None else load_decoder(name, where="validation.decoder:")


def _read_one_clip_of_each_split(dataset: Dataset) -> Batch:
    """Fail early: an empty split, a broken clip. A test split of share 0 is no error."""
    splits: tuple[Split, ...] = ("train", "validation", "test")
    splits = splits if dataset.config.test_share else splits[:2]
    firsts = [_first_of(dataset, split) for split in splits]
    return firsts[0]


def _first_of(dataset: Dataset, split: Split) -> Batch:
    return next(validation_batches(dataset, split, clips=_CLIPS_TRIED, batch_size=1))


def _require_fitting_clips(dataset: Dataset, replayed: Dataset, first_clip: Batch) -> None:
    """Refuse a second data set whose clips differ in form; frames that are still to be encoded may."""
    if all(one.config.is_cache or not one.config.takes_latents for one in (dataset, replayed)):
        require_same_form(first_clip, _first_of(replayed, "train"))
