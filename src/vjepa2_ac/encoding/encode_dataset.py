"""Encoding of a whole data set before training, as a command or at the start of a run.

As a command, processes do not communicate: each encodes its share of the episodes and marks each finished one by a
file.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import ProcessShare
from vjepa2_ac.data.sources.latents.manifest import Manifest, is_whole, read_manifest
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.distributed.device import autocast, computing_device
from vjepa2_ac.encoding.batch import encoding_of
from vjepa2_ac.encoding.cache_lookup import folder_of, key_for
from vjepa2_ac.encoding.cache_writer import CacheWriter
from vjepa2_ac.encoding.disk_space import GIGABYTE, require_space
from vjepa2_ac.encoding.pipeline import EncoderOnDevice, build
from vjepa2_ac.encoding.repair import describe, missing_files, restart
from vjepa2_ac.encoding.workload import Workload, claim_folder
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.storage import free_bytes


@dataclass(frozen=True)
class EncodedSet:
    """The result of encoding a cache."""

    folder: Path
    manifest: Manifest | None  # None: other processes are still at work


def encode_config(config: Config, reporter: Reporter = SILENT, *, out: Path | None = None) -> EncodedSet:
    """Write the latents of every frame that the clips of a config need, or this process's share of them.

    Args:
        config: The data, the model whose encoder is used, device and precision.
        reporter: Receives messages, and the progress of indexing and encoding.
        out: The folder of the cache; None: the one of `data.cache`.

    Raises:
        InputError: Some input cannot be used, or the disk space is too small.
    """
    require_encodable(config)
    device = computing_device(config.training)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    model = load_base(config.model, seed=config.seed)
    writer = writer_for(config, dataset, model, out)
    if is_whole(writer.folder):
        claim_folder(writer)
        if not (missing := missing_files(dataset, writer)):
            reporter.note(f"Everything is encoded already, in {writer.folder}")
            return EncodedSet(writer.folder, read_manifest(writer.folder))
        reporter.note(f"{describe(missing)}. It is encoded again.")
        restart(writer, missing)
    share = ProcessShare(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
    at_work = encoder_on_device(config, model, device)
    return EncodedSet(writer.folder, encode_share(dataset, writer, at_work, share, reporter))


def require_encodable(config: Config) -> None:
    """Refuse a config that cannot have a cache, before anything is opened.

    Raises:
        InputError: The data are a cache, the stride is not known, or clips are augmented.
    """
    data = config.data
    if data.is_cache:
        raise InputError(where="data.source", found="latents: they are encoded already", needed="a data set of frames")
    fix = "`vjepa2-ac data calibrate CONFIG` finds one; or let the run encode by itself, with data.cache: auto"
    require_stride(data, to="know which frames are needed", fix=fix)
    if data.augment.is_on:
        raise InputError(
            where="data.augment",
            found="clips that look different every time",
            needed="none, for a cache: it holds one latent of each frame",
            fix="Leave data.augment out",
        )


def writer_for(config: Config, dataset: Dataset, model: WorldModel, out: Path | None = None) -> CacheWriter:
    """Return the cache writer of an open data set, for the encoder of this model."""
    encoding = encoding_of(model, config)
    key = key_for(dataset, encoding)
    return CacheWriter(folder_of(config.data, key) if out is None else out, key, encoding)


def encoder_on_device(config: Config, model: WorldModel, device: torch.device) -> EncoderOnDevice:
    """Move the encoder of a model, and only the encoder, to a device."""
    model.present_encoder.to(device)
    return EncoderOnDevice(model, device, partial(autocast, config.training, device), config.model.encode_chunk)


def encode_share(
    dataset: Dataset, writer: CacheWriter, encoder: EncoderOnDevice, share: ProcessShare, reporter: Reporter
) -> Manifest | None:
    """Report the work, check the disk space, and encode the share of one process.

    Raises:
        InputError: As `encode_config`.
    """
    work, config = Workload.of(dataset, writer, share), dataset.config
    free = free_bytes(writer.folder) / GIGABYTE
    reporter.note(f"Encoding {config.path}: {work.room} as {config.cache_dtype}")
    reporter.note(f"The latents go into {writer.folder}, with {free:.4g} GB free on its disk")
    if work.left_in_total < work.frames:
        reporter.note(f"{work.frames - work.left_in_total:,} frames are there already; {work.left_in_total:,} are left")
    require_space(work.room, writer.folder, config)
    claim_folder(writer)
    progress = reporter.task("encoding frames", "frames")
    return build(work, encoder, threads=max(1, config.workers), progress=progress)
