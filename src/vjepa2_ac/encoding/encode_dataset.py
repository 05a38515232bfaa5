"""Encoding of a whole data set, as a command or at the start of a run.

As a command, processes do not communicate: each encodes its share of the episodes and marks each finished one by a
file. Those of a run wait for one another.
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
from vjepa2_ac.distributed import agreed, computing_device, first_only
from vjepa2_ac.encoding.batch import encoding_of, require_same_encoder
from vjepa2_ac.encoding.latent_cache import EncoderOnDevice, FramesToEncode, LatentCache, encode_files, frames_in
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.storage import free_bytes

Engine = Callable[[Config, LatentCache, Sequence[FramesToEncode], Reporter], None]  # encodes what is left

_LOOKS_EVERY_S = 1.0  # for the files of other processes
_LONGEST_UNSEEN_S = 60.0  # of a new file in a folder of the network


@dataclass(frozen=True)
class EncodedSet:
    """The result of encoding a cache."""

    folder: Path | str
    episodes: int  # of the data set
    encoded: int  # episodes, of all cameras
    frames: int  # of all cameras
    bytes: int
    broken: Mapping[str, str]  # episodes that could not be read, and why
    is_finished: bool  # else other processes are still at work


def encode_config(
    config: Config, reporter: Reporter = SILENT, *, out: Path | str | None = None, engine: Engine | None = None
) -> EncodedSet:
    """Write the latents of every frame that the clips of a config need, or this process's share of them.

    Episodes that could not be read are tried again.

    Args:
        config: The data, the model whose encoder is used, device and precision.
        reporter: Receives messages, and the progress of indexing and encoding.
        out: The folder of the cache; None: the one of `data.cache`.
        engine: What encodes; None: this process, on its device.

    Raises:
        InputError: Some input cannot be used, or the disk space is too small.
    """
    require_encodable(config)
    device = computing_device(config.training) if engine is None else torch.device("cpu")
    cache, model = open_cache(config, out, reporter)
    left = cache.missing(retry=True)
    if left and engine is not None:
        engine(config, cache, left, reporter)
    elif left:
        share = ProcessShare(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
        encode_share(cache, left, EncoderOnDevice.of(config, model, device), share, reporter)
    else:
        cache.begin()
        reporter.note(f"Everything is encoded already, in {cache.folder}")
    table, broken, files = cache.dataset.table, cache.broken, cache.files
    sizes = [(one, files.size(one.episode, one.camera)) for one in cache.wanted]
    absent = {one.episode for one, size in sizes if not size}
    return EncodedSet(
        folder=cache.folder,
        episodes=len(table),
        encoded=len({one.episode for one in cache.wanted} - absent),
        frames=sum(len(one.steps) for one, size in sizes if size),
        bytes=sum(size for _, size in sizes),
        broken={table.identity(number): reason for number, reason in broken.items()},
        is_finished=absent <= broken.keys(),
    )


def open_cache(
    config: Config, folder: Path | str | None = None, reporter: Reporter = SILENT
) -> tuple[LatentCache, WorldModel]:
    """Open the data set of a config and its latent cache, finished or not, and load the model whose encoder is used.

    Raises:
        InputError: The folder is another cache's.
    """
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
    model = load_base(config.model, seed=config.seed)
    cache = LatentCache.of(dataset, encoding_of(model, config), folder)
    cache.require_own()
    return cache, model


def require_encodable(config: Config) -> None:
    """Refuse a config that cannot have a cache, before anything is opened.

    Raises:
        InputError: The data are a cache, the stride is not known, or training clips are changed.
    """
    data = config.data
    if data.is_cache:
        raise InputError(where="data.source", found="latents: they are encoded already", needed="a data set of frames")
    fix = "`vjepa2-ac data calibrate CONFIG` finds one; or let the run encode by itself, with data.cache: auto"
    require_stride(data, to="know which frames are needed", fix=fix)
    if data.transforms:
        found = "clips that look different every time, and a cache holds one latent of each frame"
        raise InputError(where="data.transforms", found=found, fix="Leave data.transforms out")


def begin_encoding(cache: LatentCache, left: Sequence[FramesToEncode], reporter: Reporter) -> None:
    """Report the work, check the disk space or the URL, and write what the cache is.

    Raises:
        InputError: The space is too small, or the folder cannot be used.
        UnreachableError: The URL cannot be written.
    """
    config = cache.dataset.config
    reporter.note(f"Encoding {config.path} as {config.cache_dtype}: {cache.summary(left)}")
    if isinstance(cache.folder, Path):
        free = f", with {free_bytes(cache.folder) / 1e9:.4g} GB free on its disk"
    else:
        free = ""
        storage.try_writing(cache.folder)
    reporter.note(f"The latents go into {cache.folder}{free}")
    cache.require_space(left)
    cache.begin()


def encode_share(
    cache: LatentCache,
    left: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    share: ProcessShare,
    reporter: Reporter,
) -> None:
    """Begin, and encode the share of one process: every n-th episode of n processes.

    Raises:
        InputError: As of `begin_encoding` and `encode_files`; or too many are broken, by all processes together.
    """
    dataset = cache.dataset
    begin_encoding(cache, left, reporter)
    mine = [one for one in left if one.episode % share.processes == share.rank]
    encode_files(dataset, mine, encoder, cache.files, reporter.task("encoding frames", "frames"))
    for number, reason in cache.broken.items():
        dataset.broken.met(dataset.table.identity(number), reason)


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
    if (cache := _cache_of(config, dataset, model)) is None:
        return dataset
    if config.data.cache == "auto":
        if not check_only:
            _encode_together(
                cache, partial(EncoderOnDevice.of, config, model, accelerator.device), accelerator, reporter
            )
        elif left := cache.missing():
            cache.require_own()
            cache.require_space(left)
            frames = counted(frames_in(left), "frame")
            reporter.note(f"A run would first encode {frames} of {cache.summary(left)}. The cache is {cache.folder}")
            return dataset
    found = cache.opened()
    reporter.note(f"Latents come from {cache.folder}: the encoder is not needed")
    return found


def with_latents_if_there(config: Config, dataset: Dataset, model: WorldModel) -> Dataset:
    """Return a data set with its clips from a finished latent cache of this encoder if there is one, else unchanged.

    Raises:
        InputError: The data set is itself a cache, of another encoder.
    """
    cache = _cache_of(config, dataset, model)
    return dataset if cache is None or cache.missing() else cache.opened()


def _cache_of(config: Config, dataset: Dataset, model: WorldModel) -> LatentCache | None:
    """Return the latent cache that a config has for its data; None: it has none, or the data are one themselves."""
    if config.data.is_cache or config.data.cache == "off":
        require_same_encoder(model, dataset, config)
        return None
    return LatentCache.of(dataset, encoding_of(model, config))


def _encode_together(
    cache: LatentCache, make_encoder: partial[EncoderOnDevice], accelerator: Accelerator, reporter: Reporter
) -> None:
    """Encode what is missing, each process of a run its share; what stops one of them stops all."""
    share = ProcessShare(accelerator.process_index, accelerator.num_processes)
    if share.processes > 1:
        first_only(accelerator, cache.begin)
        agreed(accelerator, lambda: require_shared(cache, lambda: cache.is_begun))

    def encode() -> None:
        if left := cache.missing():
            encode_share(cache, left, make_encoder(), share, reporter)

    agreed(accelerator, encode)
    if share.processes > 1:
        agreed(accelerator, lambda: require_shared(cache, lambda: not cache.missing()))


def require_shared(cache: LatentCache, sees: Callable[[], bool]) -> None:
    """Wait until this process sees what another one has written, and refuse a folder in which it does not.

    Raises:
        InputError: It does not within a minute: longer than a folder of the network takes.
    """
    end = time.monotonic() + _LONGEST_UNSEEN_S
    while not sees():
        if time.monotonic() > end:
            found = "a folder in which a process of the run does not see what another one wrote"
            fix = "Set it to one that all machines of the run share; or run `vjepa2-ac encode` once on every machine"
            raise InputError(where=f"data.cache_dir: {cache.folder}", found=found, fix=fix)
        time.sleep(_LOOKS_EVERY_S)
