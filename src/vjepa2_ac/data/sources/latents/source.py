"""Source of cached latents: reads them by frame; the data set itself is not needed."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.filters.idle_ranges import FoundRanges
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.sources.latents.cache_key import clip_parts
from vjepa2_ac.data.sources.latents.episode_file import EpisodeFile
from vjepa2_ac.data.sources.latents.manifest import (
    KEPT,
    MANIFEST,
    Manifest,
    path_of,
    read_episodes,
    read_manifest,
    size_column,
    size_of,
)
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges, StoredLatents
from vjepa2_ac.errors import InputError

_ENCODE = "Run `vjepa2-ac encode` again, as the cache was made: it encodes what is lacking; or copy the file again"
_DELETE = "Delete this file, and then run `vjepa2-ac encode` again, as the cache was made; or copy the file again"


@dataclass(frozen=True)
class _Opened:
    manifest: Manifest
    table: EpisodeTable
    kept: FoundRanges | None


class LatentSource:
    """The episodes of the data set that a latent cache was made from, in that data set's order.

    Nothing is read before the first call. An episode that could not be read while encoding is included, and raises an
    error here, too: so the clips are those of the data set, in their order.
    """

    def __init__(self, config: DataConfig) -> None:
        self._config, self._folder = config, Path(config.path)
        self._known: _Opened | None = None
        self._opening = threading.Lock()
        self._checked: dict[tuple[int, str], bytearray] = {}  # frames whose CRC this process has checked

    def __getstate__(self) -> dict[str, Any]:
        """Pickle for a loader worker, with the index."""
        return {"_config": self._config, "_folder": self._folder, "_known": self._known}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickle in a loader worker."""
        self.__dict__ |= state | {"_opening": threading.Lock(), "_checked": {}}

    @property
    def manifest(self) -> Manifest:
        """The manifest of the cache."""
        return self._open().manifest

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that clips are drawn from: the config's, or all of the cache."""
        return self.manifest.cameras if self._config.camera is None else self._config.cameras

    @property
    def settled_config(self) -> DataConfig:
        """The config with the names of the cameras."""
        return self._config.model_copy(update={"camera": self.cameras})

    def infos(self, progress: Progress | None = None) -> EpisodeTable:  # noqa: ARG002 - at once
        """Return identity, length and outcome of every episode.

        Raises:
            InputError: No complete cache, or one of other clips than the config's.
        """
        return self._open().table

    def kept_ranges(self) -> FoundRanges:
        """Return the ranges that `data.idle` keeps, from the cache; its rule is not none.

        Raises:
            InputError: No complete cache, or one of other clips than the config's.
        """
        kept = self._open().kept
        if kept is None:  # `_require_fit` has compared the rules
            raise InputError(
                where=str(self._folder / MANIFEST), found=f"damaged: no checksum of {KEPT}", needed="one", fix=_ENCODE
            )
        return kept

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - nothing is fetched
        """Return one episode; only requested latents are read.

        Raises:
            InputError: The file is missing or damaged, or the episode could not be read while encoding.
            ValueError: A camera that the cache does not have.
        """
        opened, camera = self._open(), camera or self.cameras[0]
        info = opened.table[index]
        if camera not in opened.manifest.cameras:
            raise ValueError(f"camera {camera!r} is not one of {', '.join(opened.manifest.cameras)}")
        if reason := opened.manifest.broken.get(info.id):
            raise InputError(
                where=f"{self._folder}: episode {info.id}",
                found=f"no latents: it could not be read when they were encoded ({reason.rstrip('.')})",
            )
        record = EpisodeFile(path_of(self._folder, index, camera), opened.manifest.layout)
        _require_as_indexed(record, info, camera)
        checked = self._checked.setdefault((index, camera), bytearray(len(record.frame_steps)))
        return Episode(
            info=info,
            states=record["states"],
            read_frames=_FrameReader(record),
            control_rate_hz=opened.manifest.control_rate_hz,
            extrinsics=record["extrinsics"],
            joint_velocities=record["joint_velocities"],
            metadata=record.metadata,
            commands=record["commands"],
            read_latents=_LatentReader(record, checked, self._config.check_crc),
            frame_steps=record.frame_steps,
        )

    def wrong_files(self) -> list[EpisodeProblem]:
        """Return the episodes with a missing file, or a file of another size than written."""
        opened, problems = self._open(), []
        for place, camera in enumerate(opened.manifest.cameras):
            sizes = opened.table.locators[size_column(place)]
            for number in np.flatnonzero(sizes).tolist():
                path = path_of(self._folder, number, camera)
                found = size_of(path)
                if found != sizes[number]:
                    state = "no such file" if found is None else f"{found:,} bytes"
                    name = opened.table.identity(number)
                    problems.append(
                        EpisodeProblem(name, f"{path} ({name})", state, f"{sizes[number]:,} bytes", _ENCODE)
                    )
        return problems

    def require_encoded(self, episodes: Int[np.ndarray, " episodes"]) -> None:
        """Refuse to make clips of episodes that were skipped while encoding.

        Raises:
            InputError: There are some.
        """
        opened = self._open()
        table, broken = opened.table, opened.manifest.broken
        absent = np.zeros(len(table), bool)
        for camera in self.cameras:
            absent |= table.locators[size_column(opened.manifest.cameras.index(camera))] == 0
        unread = np.unique(episodes[absent[episodes]]).tolist()
        lacking = [number for number in unread if table.identity(number) not in broken]
        if lacking:
            raise InputError(
                where=str(self._folder),
                found=f"no latents of {len(lacking)} of {len(np.unique(episodes))} episodes, such as"
                f" {table.identity(lacking[0])}",
                needed="those of every episode that takes part",
                fix="Set data.outcome and data.exclude as they were when it was made, or run `vjepa2-ac encode` again",
            )

    def _open(self) -> _Opened:
        with self._opening:
            if self._known is None:
                manifest = read_manifest(self._folder)
                self._require_fit(manifest)
                self._known = _Opened(manifest, *read_episodes(self._folder, manifest))
            return self._known

    def _require_fit(self, manifest: Manifest) -> None:
        """Refuse a cache of other clips than the config's; name the differences."""
        parts = clip_parts(self._config)
        differing = manifest.cache_key.differences(parts, parts)
        for camera in () if self._config.camera is None else self._config.cameras:
            if camera not in manifest.cameras:
                differing.append(f"data.camera: {', '.join(manifest.cameras)}, not {camera}")
        if differing:
            raise another_cache(self._folder, differing)


def another_cache(folder: Path, differing: Sequence[str]) -> InputError:
    """Return the error of a cache with other settings than those in use."""
    return InputError(
        where=str(folder),
        found=f"a latent cache that was made otherwise: {'; '.join(differing)}",
        needed="one that was made with this model and these settings",
        fix="Change the settings to those, or encode the data set again",
    )


@dataclass(frozen=True)
class _LatentReader:
    record: EpisodeFile
    checked: bytearray  # one for each frame
    check_crc: str

    def __call__(self, steps: Sequence[int]) -> StoredLatents:
        """Return the latents at these control steps, in this order.

        Raises:
            InputError: A step has none, or they are damaged.
        """
        places = self.record.places_of(steps)
        check = {"never": [], "always": places}.get(self.check_crc)
        if check is None:
            check = [place for place in places if not self.checked[place]]
        latents = self.record.latents(places, check=check)
        for place in check:
            self.checked[place] = 1
        return latents


@dataclass(frozen=True)
class _FrameReader:
    record: EpisodeFile

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return small frames at these control steps, in this order: square, as the encoder saw them.

        Raises:
            InputError: A step has none, or it is damaged.
        """
        return self.record.pictures(self.record.places_of(steps))


def _require_as_indexed(record: EpisodeFile, info: EpisodeInfo, camera: str) -> None:
    found = record.id, record.camera, len(record["states"])
    if found != (info.id, camera, info.num_steps):
        raise InputError(
            where=record.path,
            found=f"episode {found[0]} of {found[2]} steps, camera {found[1]}",
            needed=f"{info.id} of {info.num_steps} steps, camera {camera}",
            fix=_DELETE,
        )
