"""Encode a whole data set into a latent cache, with the command `encode` or at the start of a training run.

Several processes of the command do not communicate: each process encodes its share of the episodes and writes one file
per episode and camera. The processes of a training run wait for each other.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from accelerate import Accelerator

from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import ProcessShare
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.distributed import run_on_all, run_on_first, select_device
from vjepa2_ac.encoding.batch import get_encoding, require_same_encoder
from vjepa2_ac.encoding.latent_cache import EncoderOnDevice, FramesToEncode, LatentCache, count_frames, encode_files
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.storage import free_bytes

Engine = Callable[[Config, LatentCache, Sequence[FramesToEncode], Reporter], None]  # encodes the missing frames

_POLL_S = 1.0  # interval between checks for the files of other processes
_VISIBILITY_TIMEOUT_S = 60.0  # longer than a network folder needs to show a new file to other machines


@dataclass(frozen=True)
class EncodingResult:
    """The result of encoding a cache."""

    folder: Path | str
    episodes: int  # number of episodes of the data set
    encoded: int  # number of episodes encoded for all cameras
    frames: int  # number of encoded frames of all cameras
    bytes: int
    broken: Mapping[str, str]  # reason of each episode that could not be read, by identity
    is_finished: bool  # False while other processes are still encoding


def encode_config(
    config: Config, reporter: Reporter = SILENT, *, out: Path | str | None = None, engine: Engine | None = None
) -> EncodingResult:
    """Encode all frames that the clips of a config need, or this process's share of them, into a latent cache.

    Episodes that could not be read in an earlier call are tried again.

    Args:
        config: The config of data, model, device and precision.
        reporter: Receives messages, and the progress of indexing and encoding.
        out: The folder of the cache; None: the folder that `data.cache_dir` determines.
        engine: Encodes the missing frames; None: this process encodes them on its device.

    Raises:
        InputError: An input cannot be used, or the disk has too little space.
    """
    require_encodable(config)
    device = select_device(config.training) if engine is None else torch.device("cpu")
    cache, model = open_cache(config, out, reporter)
    missing = cache.missing(retry=True)
    if missing and engine is not None:
        engine(config, cache, missing, reporter)
    elif missing:
        share = ProcessShare(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
        encode_share(cache, missing, EncoderOnDevice.from_model(config, model, device), share, reporter)
    else:
        cache.begin()
        reporter.note(
            f"All {counted(count_frames(cache.requests), 'frame')} are cached in {cache.folder}; nothing to encode."
        )
    table, broken, files = cache.dataset.table, cache.broken, cache.files
    sizes = [(request, files.get_file_size(request.episode, request.camera)) for request in cache.requests]
    incomplete = {request.episode for request, size in sizes if not size}
    return EncodingResult(
        folder=cache.folder,
        episodes=len(table),
        encoded=len({request.episode for request in cache.requests} - incomplete),
        frames=sum(len(request.steps) for request, size in sizes if size),
        bytes=sum(size for _, size in sizes),
        broken={table.identity(number): reason for number, reason in broken.items()},
        is_finished=incomplete <= broken.keys(),
    )


def open_cache(
    config: Config, folder: Path | str | None = None, reporter: Reporter = SILENT
) -> tuple[LatentCache, WorldModel]:
    """Open the data set of a config and its latent cache, finished or not, and load the model whose encoder is used.

    Raises:
        InputError: The folder contains another cache.
    """
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
    model = load_base(config.model, seed=config.seed)
    cache = LatentCache.for_dataset(dataset, get_encoding(model, config), folder)
    cache.require_same_key()
    return cache, model


def require_encodable(config: Config) -> None:
    """Refuse a config that cannot use a latent cache, before anything is opened.

    Raises:
        InputError: The data are a cache already, the stride is unknown, or `data.transforms` changes training clips.
    """
    data = config.data
    if data.is_cache:
        raise InputError(where="data.source", found="latents, which are already encoded", needed="a data set of frames")
    fix = "Run `vjepa2-ac data calibrate CONFIG`, or set data.cache: auto to encode at the start of the training run"
    require_stride(data, to="know which frames are needed", fix=fix)
    if data.transforms:
        problem = "transforms that differ between clips, but a latent cache stores each frame once"
        raise InputError(
            where="data.transforms", found=problem, fix="Remove data.transforms, or train with data.cache: off"
        )


def begin_encoding(cache: LatentCache, missing: Sequence[FramesToEncode], reporter: Reporter) -> None:
    """Report the work, check the disk space or the URL, and create the files that describe the cache.

    Raises:
        InputError: The disk space is too small, or the folder cannot be used.
        UnreachableError: The URL cannot be written.
    """
    config = cache.dataset.config
    reporter.note(f"Encoding {config.path} as {config.cache_dtype}: {cache.summary(missing)}")
    if isinstance(cache.folder, Path):
        free = f" ({free_bytes(cache.folder) / 1e9:.4g} GB free)"
    else:
        free = ""
        storage.check_writable(cache.folder)
    reporter.note(f"Writing the latents to {cache.folder}{free}")
    cache.require_space(missing)
    cache.begin()


def encode_share(
    cache: LatentCache,
    missing: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    share: ProcessShare,
    reporter: Reporter,
) -> None:
    """Create the cache and encode the share of one process: every n-th episode for n processes.

    Raises:
        InputError: As in `begin_encoding` and `encode_files`; or all processes together found too many broken episodes.
    """
    dataset = cache.dataset
    begin_encoding(cache, missing, reporter)
    requests = [request for request in missing if request.episode % share.processes == share.rank]
    encode_files(dataset, requests, encoder, cache.files, reporter.task("encoding frames", "frames"))
    for number, reason in cache.broken.items():
        dataset.broken.record(dataset.table.identity(number), reason)


def use_latent_cache(
    config: Config,
    dataset: Dataset,
    model: WorldModel,
    accelerator: Accelerator,
    reporter: Reporter,
    *,
    check_only: bool = False,
) -> Dataset:
    """Return the data set of a run with clips from the latent cache, or unchanged if the config uses no cache.

    With `data.cache: auto` missing latents are encoded first.

    Args:
        config: The config of the run.
        dataset: The open data set, at its stride.
        model: The model whose encoder is used.
        accelerator: The processes of the run, which share the encoding.
        reporter: Receives messages for the user.
        check_only: Only report how many frames would be encoded; the result may then have clips of frames.

    Raises:
        InputError: The cache is from another encoder, is required and missing, or cannot be written.
    """
    if (cache := _find_cache(config, dataset, model)) is None:
        return dataset
    if config.data.cache == "auto":
        if not check_only:
            _encode_together(
                cache, partial(EncoderOnDevice.from_model, config, model, accelerator.device), accelerator, reporter
            )
        elif missing := cache.missing():
            cache.require_same_key()
            cache.require_space(missing)
            frames = counted(count_frames(missing), "frame")
            reporter.note(
                f"Training will first encode {frames} into {cache.folder}. Complete cache: {cache.summary(missing)}"
            )
            return dataset
    cached_dataset = cache.open_dataset()
    reporter.note(f"Reading latents from {cache.folder}; the encoder is not needed.")
    return cached_dataset


def use_finished_cache(config: Config, dataset: Dataset, model: WorldModel) -> Dataset:
    """Return a data set with clips from a finished latent cache of this encoder, or unchanged if there is none.

    Raises:
        InputError: The data set is itself a latent cache, but from another encoder.
    """
    cache = _find_cache(config, dataset, model)
    return dataset if cache is None or cache.missing() else cache.open_dataset()


def _find_cache(config: Config, dataset: Dataset, model: WorldModel) -> LatentCache | None:
    """Return the latent cache of a config's data; None if caching is off or the data are a cache themselves."""
    if config.data.is_cache or config.data.cache == "off":
        require_same_encoder(model, dataset, config)
        return None
    return LatentCache.for_dataset(dataset, get_encoding(model, config))


def _encode_together(
    cache: LatentCache, make_encoder: partial[EncoderOnDevice], accelerator: Accelerator, reporter: Reporter
) -> None:
    """Encode the missing frames, split between the processes of a run; an error in one process stops all."""
    share = ProcessShare(accelerator.process_index, accelerator.num_processes)
    if share.processes > 1:
        run_on_first(accelerator, cache.begin)
        run_on_all(accelerator, lambda: require_shared(cache, lambda: cache.is_begun))

    def encode() -> None:
        if missing := cache.missing():
            encode_share(cache, missing, make_encoder(), share, reporter)

    run_on_all(accelerator, encode)
    if share.processes > 1:
        run_on_all(accelerator, lambda: require_shared(cache, lambda: not cache.missing()))


def require_shared(cache: LatentCache, is_visible: Callable[[], bool]) -> None:
    """Wait until files written by other processes are visible here; refuse a folder that is not shared.

    Args:
        cache: The cache, for messages.
        is_visible: Returns whether the files are visible.

    Raises:
        InputError: The files are not visible after 60 s, which is longer than a network folder takes.
    """
    end = time.monotonic() + _VISIBILITY_TIMEOUT_S
    while not is_visible():
        if time.monotonic() > end:
            problem = "files from one process of the run are not visible to another process"
            fix = "Choose a folder that all machines of the run share, or run `vjepa2-ac encode` once on every machine"
            raise InputError(where=f"data.cache_dir: {cache.folder}", found=problem, fix=fix)
        time.sleep(_POLL_S)
