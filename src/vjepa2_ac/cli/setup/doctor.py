"""The doctor command: will the run fit on the GPU of this machine?"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import Commands, add_config, command

if TYPE_CHECKING:
    from vjepa2_ac.config import Config


def add_to(commands: Commands) -> None:
    """Add `doctor` to a parser."""
    text = (
        "Estimate the GPU memory of a run, part by part, by a step on tensors without numbers: nothing is loaded."
        " Exit status 0: it fits, 1: it does not, 2: something cannot be used."
    )
    add_config(command(commands, "doctor", _doctor, text), such_as="training.batch_size=4")


def _doctor(options: argparse.Namespace) -> int:
    from vjepa2_ac.config.loading import load_config

    config = load_config(options.config, options.overrides)
    with _no_garbage_collection():
        return _report(options, config)


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Do not search what is imported for garbage: a quarter of the command's time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _report(options: argparse.Namespace, config: Config) -> int:
    import torch

    from vjepa2_ac.console.memory import memory_lines, verdict
    from vjepa2_ac.console.progress import console
    from vjepa2_ac.distributed.device import slow_bf16
    from vjepa2_ac.model.checkpoints.loading import base_sizes
    from vjepa2_ac.training.cost.memory import USUAL_GPU, estimate_memory, ways_to_fit

    sizes = base_sizes(config.model)
    console.print(f"PyTorch {torch.__version__}, CUDA {torch.version.cuda or 'not in this build'}")
    gpu, available = "a GPU of 24 GB (there is none here)", USUAL_GPU
    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(torch.cuda.current_device())
        gpu, available = device.name, device.total_memory
    estimate = estimate_memory(config, sizes)
    for line in memory_lines(config, estimate):
        console.print(line)
    needed = estimate.total(checkpointing=estimate.checkpointing)
    knobs = ways_to_fit(config, sizes, available)
    console.print(verdict(needed, available, gpu, knobs))
    if unusual := config.adapter.out_of_line:
        console.print(f"Warning: {unusual}.")
    if not torch.cuda.is_available() and config.training.precision == "bf16" and (slow := slow_bf16()):
        console.print(f"Without a GPU set training.precision=fp32 model.dtype=float32: in bfloat16 {slow}.")
    console.print(f"The data are looked at by: vjepa2-ac data check {options.config}")
    return 0 if needed <= available else 1
