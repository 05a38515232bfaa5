"""The latent cache of a run: encoded on first use, required, or used if present, as the config requests."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from accelerate import Accelerator

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import WHOLE, ProcessShare
from vjepa2_ac.data.sources.latents.manifest import is_whole
from vjepa2_ac.distributed.processes import broadcast_object
from vjepa2_ac.encoding.batch import require_same_encoder
from vjepa2_ac.encoding.cache_lookup import through_cache
from vjepa2_ac.encoding.cache_writer import CacheWriter
from vjepa2_ac.encoding.disk_space import require_space
from vjepa2_ac.encoding.encode_dataset import encode_share, encoder_on_device, writer_for
from vjepa2_ac.encoding.pipeline import EncoderOnDevice, frames_per_second
from vjepa2_ac.encoding.repair import MissingFiles, describe, missing_files, restart
from vjepa2_ac.encoding.workload import Workload
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter


def with_latents(
    config: Config,
    dataset: Dataset,
    model: WorldModel,
    accelerator: Accelerator,
    reporter: Reporter,
    *,
    check_only: bool = False,
) -> Dataset:
    """Return the data set of a run, with its clips from the latent cache if the config has one.

    Args:
        config: The config of the run.
        dataset: The open data set, at its stride.
        model: The model whose encoder is used.
        accelerator: Its processes share the encoding.
        reporter: Receives messages for the user.
        check_only: Encode nothing: report what would be encoded, and leave the clips as frames.

    Raises:
        InputError: The cache is another encoder's, is required and missing, or cannot be made.
    """
    if config.data.is_cache or config.data.cache == "off":
        require_same_encoder(model, dataset, config)
        return dataset
    writer = writer_for(config, dataset, model)
    if missing := _missing(config, dataset, accelerator, writer):
        again = "A run would encode it again" if check_only else "It is encoded again"
        reporter.note(f"{describe(missing)}. {again}.")
        if check_only:
            return dataset
        if accelerator.is_main_process:
            restart(writer, missing)
    if not broadcast_object(accelerator, is_whole(writer.folder)):
        if config.data.cache == "require":
            return through_cache(dataset, writer.encoding)  # which reports what was found instead
        encoder = encoder_on_device(config, model, accelerator.device)
        if check_only:
            reporter.note(_forecast(Workload.of(dataset, writer, WHOLE), encoder, accelerator.num_processes))
            return dataset
        share = ProcessShare(accelerator.process_index, accelerator.num_processes)
        encode_share(dataset, writer, encoder, share, reporter)
        accelerator.wait_for_everyone()
        _require_whole(writer.folder, share)
    reporter.note(f"Latents come from {writer.folder}: the encoder is not needed")
    return through_cache(dataset, writer.encoding)


def with_latents_if_there(config: Config, dataset: Dataset, model: WorldModel) -> Dataset:
    """Return a data set with its clips from a finished latent cache of this encoder if there is one, else unchanged.

    Raises:
        InputError: The data set is itself a cache, of another encoder.
    """
    if config.data.is_cache or config.data.cache == "off":
        require_same_encoder(model, dataset, config)
        return dataset
    writer = writer_for(config, dataset, model)
    return through_cache(dataset, writer.encoding) if is_whole(writer.folder) else dataset


def _missing(config: Config, dataset: Dataset, accelerator: Accelerator, writer: CacheWriter) -> list[MissingFiles]:
    """Return what a finished cache lacks: the first process checks, for all of them."""
    looks = accelerator.is_main_process and config.data.cache == "auto" and is_whole(writer.folder)
    return broadcast_object(accelerator, missing_files(dataset, writer) if looks else [])


def _require_whole(folder: Path, share: ProcessShare) -> None:
    """Refuse a folder that the processes do not share: its cache is unfinished when all are done."""
    if not is_whole(folder):
        raise InputError(
            where=f"data.cache_dir: {folder.parent}",
            found=f"a folder in which process {share.rank} does not see what the others of {share.processes} wrote",
            needed="one that all machines of the run share",
            fix="Set data.cache_dir to a shared folder; or run `vjepa2-ac encode` once on every machine",
        )


def _forecast(work: Workload, encoder: EncoderOnDevice, processes: int) -> str:
    """Return as text what a run would encode first, after a check that there is space for it."""
    config = work.dataset.config
    require_space(work.room, work.writer.folder, config)
    speed = frames_per_second(encoder) * processes
    return (
        f"A run would first encode {work.left_in_total:,} of {work.room} as {config.cache_dtype}, into"
        f" {work.writer.folder}. At the {speed:.3g} frames/s of one chunk just timed that takes"
        f" {timedelta(seconds=round(work.left_in_total / speed))}"
    )
