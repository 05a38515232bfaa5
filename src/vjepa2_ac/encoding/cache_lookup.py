"""Latent cache lookup: the frames that need latents, the cache folder, and a data set read through it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, through_latents
from vjepa2_ac.data.index.index_cache import cache_folder, fingerprints_of
from vjepa2_ac.data.sources.latents.cache_key import OF_ENCODING, CacheKey, Encoding, key_of_cache
from vjepa2_ac.data.sources.latents.manifest import is_whole, read_manifest
from vjepa2_ac.data.sources.latents.source import LatentSource, another_cache
from vjepa2_ac.errors import InputError


@dataclass(frozen=True, eq=False)
class NeededFrames:
    """The frames of an episode that clips of any split use; of every camera."""

    episode: int  # index in the data set
    steps: Int32[np.ndarray, " frames"]  # control steps, ascending


def needed_frames(dataset: Dataset) -> Iterator[NeededFrames]:
    """Yield, in the data set's order, every episode with clips, and the frames that they need.

    All splits are included: clips of train, validation and test. Episodes that are shorter than a clip, left out or
    wholly idle are not.
    """
    starts, config = dataset.starts, dataset.config
    within = np.arange(config.frames) * config.model_stride
    order = np.argsort(starts.episode, kind="stable")
    for runs in np.split(order, np.flatnonzero(np.diff(starts.episode[order])) + 1):
        if not len(runs):
            return  # a data set without clips
        first = np.concatenate([starts.steps_of(int(run)) for run in runs])
        steps = np.unique(first[:, None] + within).astype(np.int32)
        yield NeededFrames(int(starts.episode[runs[0]]), steps)


def key_for(dataset: Dataset, encoding: Encoding) -> CacheKey:
    """Return the cache key of an open data set that is not itself a cache: of one that is there, if there is one.

    A cache that an earlier version made has the fingerprint that the episodes had then.
    """
    keys = [key_of_cache(dataset.config, one, encoding) for one in fingerprints_of(dataset.table)]
    return next((key for key in keys if folder_of(dataset.config, key).is_dir()), keys[0])


def folder_of(config: DataConfig, key: CacheKey) -> Path:
    """Return the folder of a cache: in `data.cache_dir`, or with the other caches of this machine."""
    parent = cache_folder(config.disk_cache) / "latents" if config.cache_dir is None else Path(config.cache_dir)
    return parent / key.digest


def through_cache(dataset: Dataset, encoding: Encoding) -> Dataset:
    """Return the same data set, with the same clips in the same order, read as latents from its cache.

    Raises:
        InputError: There is no cache of this encoder and these settings; says how the others differ.
    """
    key = key_for(dataset, encoding)
    folder = folder_of(dataset.config, key)
    if not is_whole(folder):
        raise _no_cache(folder, key)
    return through_latents(dataset, folder)


def require_encoding(dataset: Dataset, encoding: Encoding) -> None:
    """Refuse cached latents of another encoder, image size or precision; other data sets pass.

    Raises:
        InputError: Names what differs.
    """
    if isinstance(dataset.source, LatentSource):
        differing = dataset.source.manifest.cache_key.differences(encoding.parts, OF_ENCODING)
        if differing:
            raise another_cache(Path(dataset.config.path), differing)


def _no_cache(folder: Path, key: CacheKey) -> InputError:
    others = []
    for other in sorted(folder.parent.iterdir()) if folder.parent.is_dir() else ():
        if is_whole(other):
            differing = read_manifest(other).cache_key.differences(key.parts)
            others.append((len(differing), f"{other.name} was made otherwise: {'; '.join(differing)}"))
    unfinished = ": it is unfinished" if folder.is_dir() else ""
    nearest = f". Other caches there: {len(others)}; {min(others)[1]}" if others else ""
    return InputError(
        where=f"data.cache: require: {folder}",
        found=f"no whole latent cache of this model and these settings{unfinished}{nearest}",
        fix="Run `vjepa2-ac encode` with this config, or set data.cache: auto",
    )
