"""Source of cached latents: reads them by frame; the data set itself is not needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.idle import FoundRanges
from vjepa2_ac.data.index.episode_table import EpisodeProblem
from vjepa2_ac.data.sources.indexed_source import IndexedSource, Opened
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
from vjepa2_ac.episode import Episode, Progress, StepRanges, StoredLatents
from vjepa2_ac.errors import InputError

_ENCODE = "Run `vjepa2-ac encode` again, as the cache was made: it encodes what is lacking; or copy the file again"
_DELETE = "Delete this file, and then run `vjepa2-ac encode` again, as the cache was made; or copy the file again"


@dataclass(frozen=True)
class _Opened(Opened):
    manifest: Manifest
    kept: FoundRanges | None


class LatentSource(IndexedSource[DataConfig, _Opened]):
    """The episodes of the data set that a latent cache was made from, in that data set's order.

    An episode that could not be read while encoding is included, and raises an error here, too: so the clips are those
    of the data set, in their order.
    """

    def __init__(self, config: DataConfig) -> None:
        super().__init__(config)
        self._folder = Path(config.path)
        self._checked: dict[tuple[int, str], bytearray] = {}  # frames whose CRC this process has checked

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

    def kept_ranges(self) -> FoundRanges:
        """Return the ranges that `data.idle` keeps, from the cache; its rule is not none.

        Raises:
            InputError: No complete cache, or one of other clips than the config's.
        """
        kept = self._open().kept
        if kept is None:  # `_look` has compared the rules
            where, found = str(self._folder / MANIFEST), f"damaged: no checksum of {KEPT}"
            raise InputError(where=where, found=found, needed="one", fix=_ENCODE)
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
            found = f"no latents: it could not be read when they were encoded ({reason.rstrip('.')})"
            raise InputError(where=f"{self._folder}: episode {info.id}", found=found)
        record = EpisodeFile(path_of(self._folder, index, camera), opened.manifest.layout)
        name, its_camera, steps = record.id, record.camera, len(record["states"])
        if (name, its_camera, steps) != (info.id, camera, info.num_steps):
            text = f"episode {name} of {steps} steps, camera {its_camera}"
            wanted = f"{info.id} of {info.num_steps} steps, camera {camera}"
            raise InputError(where=record.path, found=text, needed=wanted, fix=_DELETE)
        checked = self._checked.setdefault((index, camera), bytearray(len(record.frame_steps)))
        return Episode(
            info=info,
            states=record["states"],
            read_frames=lambda steps: record.pictures(record.places_of(steps)),
            control_rate_hz=opened.manifest.control_rate_hz,
            extrinsics=record["extrinsics"],
            joint_velocities=record["joint_velocities"],
            metadata=record.metadata,
            commands=record["commands"],
            read_latents=partial(self._latents, record, checked),
            frame_steps=record.frame_steps,
        )

    def _latents(self, record: EpisodeFile, checked: bytearray, steps: Sequence[int]) -> StoredLatents:
        """Return the latents at these control steps, in this order; `checked` has a byte for each frame of the file.

        Raises:
            InputError: A step has none, or they are damaged.
        """
        places = record.places_of(steps)
        unchecked = [place for place in places if not checked[place]]
        check = {"never": [], "once": unchecked, "always": places}[self._config.check_crc]
        latents = record.latents(places, check=check)
        for place in check:
            checked[place] = 1
        return latents

    def wrong_files(self) -> list[EpisodeProblem]:
        """Return the episodes with a missing file, or a file of another size than written."""
        opened, problems = self._open(), []
        for place, camera in enumerate(opened.manifest.cameras):
            sizes = opened.table.locators[size_column(place)]
            for number in np.flatnonzero(sizes).tolist():
                path = path_of(self._folder, number, camera)
                there = size_of(path)
                if there != sizes[number]:
                    found = "no such file" if there is None else f"{there:,} bytes"
                    name, needed = opened.table.identity(number), f"{sizes[number]:,} bytes"
                    problems.append(EpisodeProblem(name, f"{path} ({name})", found, needed, _ENCODE))
        return problems

    def settle(self, episodes: Int[np.ndarray, " episodes"]) -> tuple[DataConfig, list[EpisodeProblem]]:
        """Return the config with the cameras of the cache, and the episodes whose files are not as written.

        Raises:
            InputError: One of these episodes, that clips come from, was skipped while encoding.
        """
        self.require_encoded(episodes)
        return self.settled_config, self.wrong_files()

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
            several = f"{len(lacking)} of {len(np.unique(episodes))} episodes, such as {table.identity(lacking[0])}"
            raise InputError(
                where=str(self._folder),
                found=f"no latents of {several}",
                needed="those of every episode that takes part",
                fix="Set data.outcome and data.exclude as they were when it was made, or run `vjepa2-ac encode` again",
            )

    def _look(self, progress: Progress) -> _Opened:  # noqa: ARG002 - at once
        manifest = read_manifest(self._folder)
        parts = clip_parts(self._config)
        differing = manifest.cache_key.differences(parts, parts)
        for camera in () if self._config.camera is None else self._config.cameras:
            if camera not in manifest.cameras:
                differing.append(f"data.camera: {', '.join(manifest.cameras)}, not {camera}")
        if differing:  # of other clips than the config's
            raise another_cache(self._folder, differing)
        table, kept = read_episodes(self._folder, manifest)
        return _Opened(table, manifest, kept)


def another_cache(folder: Path, differing: Sequence[str]) -> InputError:
    """Return the error of a cache with other settings than those in use."""
    return InputError(
        where=str(folder),
        found=f"a latent cache that was made otherwise: {'; '.join(differing)}",
        needed="one that was made with this model and these settings",
        fix="Change the settings to those, or encode the data set again",
    )
