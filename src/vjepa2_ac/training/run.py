"""The parts of a run that training steps, validation and checkpoints share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import Batches, Mixed, ProcessShare, training_loader
from vjepa2_ac.distributed import PRECISIONS
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.low_rank import CastMatrices
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.training.optim import trained_parameters


@dataclass
class Run:
    """All parts of a run, assembled and checked by `setup.set_up`."""

    config: Config  # its stride is a number
    accelerator: Accelerator  # device, precision, and the rank of this process
    world_model: WorldModel
    objective: Callable[[LatentBatch], tuple[Tensor, Tensor]]  # (teacher forcing, rollout)
    micro_step: Callable[[Run, LatentBatch, float], Tensor]  # `step.micro_step`, or a graph of it
    optimizer: torch.optim.Optimizer
    scaler: torch.amp.GradScaler  # has no effect except with fp16
    dataset: Dataset
    state: RunState
    micro_batches: int  # of an optimizer step, of all processes together
    calibration: Mapping[str, Any] | None = None  # if data.stride was auto and was chosen in this start
    replayed: Dataset | None = None  # the second data set, if there is one
    strip: Any = None  # the hook `validation.decoder`: decoding.imagine.ImaginedStrip

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return Path(self.config.run_dir)

    @property
    def datasets(self) -> list[Dataset]:
        """The data set, and the replayed one."""
        return [one for one in (self.dataset, self.replayed) if one is not None]

    @cached_property
    def trained(self) -> list[nn.Parameter]:
        """The parameters of the optimizer."""
        return list(trained_parameters(self.world_model))

    @cached_property
    def cast_matrices(self) -> CastMatrices:
        """The adapter in the type of the computation."""
        return CastMatrices(self.world_model.predictor, PRECISIONS[self.config.training.precision])

    @property
    def clips_per_step(self) -> int:
        """Clips of an optimizer step, of all processes together."""
        return self.micro_batches * self.config.training.batch_size

    @property
    def share(self) -> ProcessShare:
        """The rank of this process among those that share the clips."""
        return ProcessShare(self.accelerator.process_index, self.accelerator.num_processes, self.micro_batches)


def batches_from(run: Run) -> Batches:
    """Yield the micro-batches of this process from the current step on."""
    replay = run.config.replay
    return training_loader(
        Mixed(run.dataset, run.replayed, replay.share if replay else 0.0),
        seed=run.config.seed,
        batch_size=run.config.training.batch_size,
        start_position=run.state.clips_done,
        share=run.share,
        pinned=run.accelerator.device.type == "cuda",
    )
