"""Shared memory check: room in /dev/shm for the batches of the loader's workers. Containers often have little."""

from __future__ import annotations

import platform
import shutil

from accelerate import Accelerator

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import CLIPS_WORTH_WORKERS, validation_batches
from vjepa2_ac.distributed.collectives import all_gather_object
from vjepa2_ac.episode import Batch
from vjepa2_ac.reporter import Reporter

SHARED_MEMORY = "/dev/shm"  # noqa: S108  # where PyTorch puts them on Linux
_MOST_CLIPS_READ = 8  # one is needed; the others replace clips that data.broken_episodes skips
_GIGABYTE, _MEGABYTE = 10**9, 10**6


def warn_if_shared_memory_is_small(
    config: Config, dataset: Dataset, batch_of_frames: Batch, accelerator: Accelerator, reporter: Reporter
) -> None:
    """Warn before the first step if batches of this run may not fit. All processes have to call.

    Args:
        config: The run.
        dataset: Its clips.
        batch_of_frames: A batch of them as frames, also where they come from a latent cache now.
        accelerator: Used to count the processes on this machine.
        reporter: Receives the warning.
    """
    here = platform.node()
    processes = all_gather_object(accelerator, here).count(here)
    if not config.data.workers:
        return
    clip = batch_of_frames
    if batch_of_frames.latents is None and dataset.config.is_cache:
        clip = next(validation_batches(dataset, "train", clips=_MOST_CLIPS_READ, batch_size=1))
    if text := small_shared_memory(config, clip.nbytes, processes):
        reporter.note(text)


def small_shared_memory(config: Config, clip_bytes: int, processes: int = 1) -> str | None:
    """Return a warning if shared memory may not hold the prefetched batches; None if it does.

    Validation batches are loaded by workers, too, while those of training wait.

    Args:
        config: The run.
        clip_bytes: Of one clip from the loader.
        processes: Of the run, on this machine.
    """
    data, validation = config.data, config.validation
    clips = config.training.batch_size + validation.batch_size * (validation.clips >= CLIPS_WORTH_WORKERS)
    needed = processes * data.workers * (data.prefetch + 1) * clips * clip_bytes
    try:
        free = shutil.disk_usage(SHARED_MEMORY).free
    except OSError:  # other systems have none
        return None
    if needed <= free:
        return None
    times = f"{processes} processes x " if processes > 1 else ""
    return (
        f"{SHARED_MEMORY} has {free / _GIGABYTE:.3g} GB free, and batches on their way from the loader's workers may"
        f" take {needed / _GIGABYTE:.3g} GB: {times}{data.workers} workers x ({data.prefetch} prefetched + 1) x {clips}"
        f" clips of {clip_bytes / _MEGABYTE:.3g} MB. Where it is full, workers die of a bus error. Give a container"
        f" more (docker run --shm-size={-(-needed // _GIGABYTE)}g), or lower data.workers or data.prefetch"
    )
