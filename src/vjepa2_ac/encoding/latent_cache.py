"""The latent cache of an open data set: the frames that clips need, its key and folder, and what it lacks."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset, through_latents
from vjepa2_ac.data.files import CONNECTIONS, fetched_data, in_parallel
from vjepa2_ac.data.idle import find_ranges
from vjepa2_ac.data.index import cache_folder, fingerprint_of
from vjepa2_ac.data.sources.latent_files import LatentFiles, bytes_per_frame
from vjepa2_ac.data.sources.latents import (
    CACHE,
    EPISODES,
    KEPT,
    CacheKey,
    Encoding,
    key_of_cache,
    read_key,
    require_own_folder,
)
from vjepa2_ac.encoding.pipeline import FramesToEncode
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.storage import free_bytes

_GIGABYTE = 10**9


def needed_frames(dataset: Dataset) -> Iterator[FramesToEncode]:
    """Yield, in the data set's order, the frames that clips of any split use, of every episode with clips and camera.

    Episodes that are shorter than a clip, left out or wholly idle are not included.
    """
    starts, config = dataset.starts, dataset.config
    within = np.arange(config.frames) * config.model_stride
    order = np.argsort(starts.episode, kind="stable")
    for runs in np.split(order, np.flatnonzero(np.diff(starts.episode[order])) + 1):
        if not len(runs):
            return  # a data set without clips
        first = np.concatenate([starts.steps_of(int(run)) for run in runs])
        steps = np.unique(first[:, None] + within).astype(np.int32)
        for camera in config.cameras:
            yield FramesToEncode(int(starts.episode[runs[0]]), camera, steps)


@dataclass(frozen=True, eq=False)
class LatentCache:
    """The cache of an open data set, finished or not. Several processes may write into its folder.

    It is finished when nothing is missing. So a kill, a deleted file or a further episode needs no repair: the next
    encoding writes what is missing.
    """

    dataset: Dataset
    encoding: Encoding
    key: CacheKey
    folder: Path | str  # here, or a URL

    @classmethod
    def of(cls, dataset: Dataset, encoding: Encoding, folder: Path | str | None = None) -> LatentCache:
        """Return the cache of a data set and an encoder.

        Args:
            dataset: Frames, not itself a cache.
            encoding: How they become latents.
            folder: Its folder; None: in `data.cache_dir`, or with the other caches of this machine.
        """
        config = dataset.config
        key = key_of_cache(config, fingerprint_of(dataset.table), encoding)
        parent = config.cache_dir or cache_folder(config.disk_cache) / "latents"
        place = storage.join(parent, key.digest) if folder is None else str(folder)
        return cls(dataset, encoding, key, storage.folder_at(place))

    @property
    def files(self) -> LatentFiles:
        """Its files; behind a URL they are listed anew."""
        cache = fetched_data(self.dataset.config.disk_cache) if storage.is_url(self.folder) else None
        return LatentFiles(self.folder, self.key.digest, cache)

    @cached_property
    def wanted(self) -> tuple[FramesToEncode, ...]:
        """The frames of the whole cache."""
        return tuple(needed_frames(self.dataset))

    def missing(self, *, retry: bool = False) -> list[FramesToEncode]:
        """Return what is not there; with `retry`, also what could not be read, or is damaged behind a URL.

        The header of each local file is read, so that a damaged one counts as missing and is encoded again.
        """
        if not self.is_begun:
            return list(self.wanted)
        files = self.files
        is_there = files.has if retry else files.is_done
        there = in_parallel(lambda one: is_there(one.episode, one.camera), self.wanted, CONNECTIONS)
        return [one for one, is_whole in zip(self.wanted, there, strict=True) if not is_whole]

    @property
    def is_begun(self) -> bool:
        """Whether its folder says what it is."""
        return all(storage.exists(storage.join(self.folder, name)) for name in (CACHE, EPISODES))

    @property
    def broken(self) -> dict[int, str]:
        """The episodes that could not be read, by their index, and why; found by any process."""
        found, wanted = self.files.broken, {one.episode for one in self.wanted}
        return {number: reason for number, reason in found.items() if number in wanted}

    @property
    def bytes_per_frame(self) -> int:
        """The approximate size of a frame, with its picture."""
        encoding = self.encoding
        latents = bytes_per_frame(encoding.tokens, encoding.dim, self.dataset.config.cache_dtype)
        return latents + picture_bytes(encoding.image_size)

    def summary(self, left: Sequence[FramesToEncode]) -> str:
        """Return as text how large the whole is, and how much of it is left."""
        frames, num_left = frames_in(self.wanted), frames_in(left)
        size = f"{counted(frames, 'frame')} ({frames * self.bytes_per_frame / _GIGABYTE:.3g} GB)"
        return size if num_left == frames else f"{size}; {frames - num_left:,} cached, {num_left:,} to encode"

    def require_own(self) -> None:
        """Refuse a folder of another cache, or of other things.

        Raises:
            InputError: Says how the other cache differs.
        """
        require_own_folder(self.folder, CACHE, self.key, where=f"latent cache {self.folder}")

    def begin(self) -> None:
        """Write what the cache is, if the folder does not say so yet.

        Raises:
            InputError: The folder has another cache or other things, or cannot be written.
            UnreachableError: It cannot be written at the URL.
        """
        self.require_own()
        if self.is_begun:
            return
        dataset = self.dataset
        texts = {"control_rate_hz": str(dataset.control_rate_hz), "widths": " ".join(map(str, dataset.widths))}
        table = replace(dataset.table, texts={**dataset.table.texts, **texts}, locators={})
        content: dict[str, bytes | str] = {CACHE: json.dumps({"key": dict(self.key.parts)}, indent=1) + "\n"}
        if dataset.config.idle.rule != "none":
            content[KEPT] = find_ranges(dataset.source, dataset.table, dataset.config, None).to_bytes()
        for name, data in {**content, EPISODES: table.to_bytes()}.items():
            storage.write(storage.join(self.folder, name), data)

    def require_space(self, left: Sequence[FramesToEncode]) -> None:
        """Refuse to start if the disk has too little space for what is left; what is behind a URL has no end.

        Raises:
            InputError: Says how much is free, how much is needed, and what to do.
        """
        if not isinstance(self.folder, Path):
            return
        fix = (
            f"Set data.cache_dtype: int8, or data.start_every: {self.dataset.config.model_stride}; take fewer episodes"
            " (data.outcome, data.idle, data.exclude); or name a folder on a larger disk (data.cache_dir)"
        )
        require_space(self.folder, frames_in(left), self.bytes_per_frame, fix=fix)

    def opened(self) -> Dataset:
        """Return the same data set, with the same clips in the same order, read as latents from this cache.

        Raises:
            InputError: It is not finished; if it was not even begun, says how the others there differ.
        """
        if self.is_begun:
            return through_latents(self.dataset, self.folder)
        parent, others = str(self.folder).rpartition("/")[0], []
        for name in storage.list_names(parent):
            if storage.exists(storage.join(other := storage.join(parent, name), CACHE)):
                differing = read_key(other).differences(self.key.parts)
                others.append((len(differing), f"{name} was made otherwise: {'; '.join(differing)}"))
        nearest = f". Other caches there: {len(others)}; {min(others)[1]}" if others else ""
        where = f"data.cache: {self.dataset.config.cache}: {self.folder}"
        found = f"no latent cache of this model and these settings{nearest}"
        fix = "Run `vjepa2-ac encode` with this config, or set data.cache: auto"
        raise InputError(where=where, found=found, fix=fix)


def frames_in(wanted: Sequence[FramesToEncode]) -> int:
    """Return how many frames these are."""
    return sum(len(one.steps) for one in wanted)


def picture_bytes(image_size: int) -> int:
    """Return the approximate size of a frame's picture as JPEG, with a share of the states."""
    return 1000 + image_size**2 // 3


def require_space(folder: Path, frames: int, per_frame: int, *, fix: str) -> None:
    """Refuse to encode frames for which the disk has too little space.

    Raises:
        InputError: Says how much is free, and how much is needed.
    """
    needed, free = frames * per_frame, free_bytes(folder)
    if needed > free:
        size = f"{needed / _GIGABYTE:.4g} GB for the latents of {frames:,} frames ({per_frame / 1e6:.3g} MB each)"
        found = f"{free / _GIGABYTE:.4g} GB free on its disk"
        raise InputError(where=str(folder), found=found, needed=size, fix=fix)
