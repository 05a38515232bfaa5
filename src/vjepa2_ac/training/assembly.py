"""What must stand before the first step? Device, data, model, adapter, optimizer and the newest checkpoint, checked."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader, validation_batches
from vjepa2_ac.data.windows import Split
from vjepa2_ac.episode import Batch, LatentBatch, Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.calibration import Calibration
from vjepa2_ac.latents import encode_batch, extrinsics_for
from vjepa2_ac.model.load import load_base
from vjepa2_ac.model.lora import add_adapter, load_trained, save_trained, trainable_report
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.checkpoint import RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.training.loss import Objective
from vjepa2_ac.training.optim import make_optimizer
from vjepa2_ac.training.run_folder import CHECKPOINTS
from vjepa2_ac.training.stride import choose_stride, require_learned, with_stride

ADAPTER = "adapter"
OPTIMIZER = "optimizer.pt"

_CLIPS_TRIED = 8  # one is read; the others are for where data.broken_episodes passes over it


@dataclass
class Run:
    """Everything the loop needs, assembled and checked."""

    config: Config  # its stride is a number
    accelerator: Accelerator
    world_model: WorldModel
    objective: torch.nn.Module
    optimizer: torch.optim.Optimizer
    dataset: Dataset
    state: RunState
    calibration: Calibration | None = None  # where data.stride was auto and is now chosen


def assemble(config: Config, note: Callable[[str], None], looked_through: Progress | None = None) -> Run:
    """Open the data, load the model, attach the adapter, and take up the newest checkpoint. Cheap failures first.

    Args:
        config: The run.
        note: Told what a person should know.
        looked_through: Told how far the data set is looked through, where that was not done before.

    Raises:
        InputError: Something cannot be used.
    """
    accelerator = make_accelerator(config)
    if config.data.stride == "auto":
        require_learned(config.model)
    dataset = open_dataset(config.data, progress=looked_through)
    world_model, calibration = None, None
    if config.data.stride == "auto":
        world_model = load_base(config.model, seed=config.seed).to(accelerator.device)
        calibration = choose_stride(world_model, dataset, config, accelerator, note)
        config, dataset = with_stride(config, calibration.best.stride), dataset.with_stride(calibration.best.stride)
    first_clip = _read_one_clip_of_each_split(dataset)
    world_model = world_model or load_base(config.model, seed=config.seed)
    extrinsics_for(world_model, first_clip)
    add_adapter(world_model, config.adapter, seed=config.seed)
    note(str(trainable_report(world_model)))
    world_model.set_gradient_checkpointing(config.training.gradient_checkpointing)
    world_model.to(accelerator.device)
    optimizer = make_optimizer(world_model, config.training)
    state = _take_up(config, world_model, optimizer, note)
    dataset.broken.recall(state.broken)
    if state.windows not in {None, len(dataset.windows("train"))}:
        note(
            f"The data has changed: {len(dataset.windows('train')):,} training clips instead of {state.windows:,}."
            " From here on their order is another, and some may be seen twice in this epoch or not at all."
        )
    objective, optimizer = accelerator.prepare(Objective(world_model, config.training), optimizer)
    return Run(config, accelerator, world_model, objective, optimizer, dataset, state, calibration)


def make_accelerator(config: Config) -> Accelerator:
    """Return the device and precision of a run.

    Raises:
        InputError: CUDA was asked for and there is none.
    """
    if config.training.device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            where="training.device",
            found="cuda, but this PyTorch sees no CUDA device",
            fix="Set training.device=cpu, or install a CUDA build of PyTorch and a driver",
        )
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError(
            where="WORLD_SIZE",
            found=f"{os.environ['WORLD_SIZE']} processes",
            needed="one: training on several GPUs is not supported yet",
            fix="Start without torchrun or accelerate launch",
        )
    precision = "bf16" if config.training.precision == "bf16" else "no"
    AcceleratorState._reset_state(reset_partial_state=False)  # or a second run keeps the first's precision
    return Accelerator(mixed_precision=precision, cpu=config.training.device == "cpu")


def batches_from(run: Run, step: int) -> Generator[Batch, None, None]:
    """Yield the micro-batches of this process that come after `step` optimizer steps."""
    training = run.config.training
    micro_batches_done = step * training.accumulation
    return training_loader(
        run.dataset,
        seed=run.config.seed,
        batch_size=training.batch_size,
        start_position=micro_batches_done * run.accelerator.num_processes * training.batch_size,
        rank=run.accelerator.process_index,
        world_size=run.accelerator.num_processes,
    )


def encode(run: Run, batch: Batch) -> LatentBatch:
    """Return the latents of a batch on the run's device, in its precision."""
    with run.accelerator.autocast():
        return encode_batch(run.world_model, batch, device=run.accelerator.device, chunk=run.config.model.encode_chunk)


def save_checkpoint(run: Run, folder: Path) -> Path:
    """Write where the run stands into its folder; see `training.checkpoint`."""

    def write(inner: Path) -> None:
        save_trained(run.world_model, inner / ADAPTER)
        torch.save(run.optimizer.state_dict(), inner / OPTIMIZER)

    return write_checkpoint(folder / CHECKPOINTS, run.state, write, keep=run.config.checkpoint.keep)


def _read_one_clip_of_each_split(dataset: Dataset) -> Batch:
    """Fail early: an empty split, a broken clip. A test split of share 0 is nobody's mistake."""
    splits: tuple[Split, ...] = ("train", "validation", "test")
    splits = splits if dataset.config.test_share else splits[:2]
    firsts = [next(validation_batches(dataset, split, clips=_CLIPS_TRIED, batch_size=1)) for split in splits]
    return firsts[0]


def _take_up(
    config: Config, world_model: WorldModel, optimizer: torch.optim.Optimizer, note: Callable[[str], None]
) -> RunState:
    checkpoint = newest_checkpoint(Path(config.run_dir) / CHECKPOINTS)
    if checkpoint is None:
        return RunState(step=0)
    load_trained(world_model, checkpoint / ADAPTER, trainable=True)
    try:
        optimizer.load_state_dict(torch.load(checkpoint / OPTIMIZER, weights_only=True, map_location="cpu"))
        state = read_state(checkpoint)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, pickle.UnpicklingError) as error:
        raise InputError(
            where=str(checkpoint), found=f"not the state of this run ({error})", fix="Delete it to use an older one"
        ) from None
    note(f"Going on from {checkpoint} ({state.step} of {config.training.steps} steps are done).")
    return state
