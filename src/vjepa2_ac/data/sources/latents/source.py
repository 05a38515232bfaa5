"""Source of cached latents: reads them by frame; the data set itself is not needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.files import fetched_data
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.selection import StepSelection
from vjepa2_ac.data.sources.indexed_source import IndexedSource, measured_space
from vjepa2_ac.data.sources.latents.cache_files import FIX, OPTIONAL, LatentFiles, read_key, read_tables
from vjepa2_ac.data.sources.latents.cache_key import CacheKey, clip_parts
from vjepa2_ac.episode import STATE_DIM, Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.spaces import vector_states


@dataclass(frozen=True)
class _Cache:
    key: CacheKey
    files: LatentFiles
    kept: StepSelection | None


class LatentSource(IndexedSource[DataConfig, _Cache]):
    """The episodes of the data set that a latent cache was made from, in that data set's order.

    An episode that could not be read while encoding is included, and raises an error here, too: so the clips are those
    of the data set, in their order.
    """

    @property
    def key(self) -> CacheKey:
        """What the cache is."""
        return self._open()[1].key

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that clips are drawn from: the config's, or all of the cache."""
        return self.key.cameras if self._config.camera is None else self._config.cameras

    def kept_ranges(self) -> StepSelection | None:
        """Return the ranges that `data.idle` keeps, from the cache; None: the rule is none.

        Raises:
            InputError: No cache, or one of other clips than the config's.
        """
        return self._open()[1].kept

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - nothing is fetched
        """Return one episode; only requested latents are read.

        Raises:
            InputError: The file is missing or damaged, or the episode could not be read while encoding.
            UnreachableError: It cannot be read now.
        """
        table, opened = self._open()
        camera = camera or self.cameras[0]
        record, info = opened.files.open(index, camera), table[index]
        arrays = {name: record.array(name) for name in OPTIONAL if name in record.names}
        arrays["states"] = record.array("states")
        self._require_plausible(arrays, info, f"{record.path}: {info.id}")
        return Episode(
            info=info,
            read_frames=lambda steps: record.pictures(record.places_of(steps)),
            control_rate_hz=float(table.texts["control_rate_hz"]),
            metadata=record.metadata,
            read_latents=lambda steps: record.latents(record.places_of(steps)),
            frame_steps=record.frame_steps,
            **arrays,
        )

    def _require_plausible(self, arrays: Mapping[str, np.ndarray], info: EpisodeInfo, where: str) -> None:
        """Refuse an episode that no source gives.

        Raises:
            InputError: It has another number of steps, or numbers that are not finite or that no robot has.
        """
        for name, values in arrays.items():
            width = STATE_DIM if name == "states" and self._config.states == "pose" else np.atleast_2d(values).shape[1]
            if values.shape != (info.num_steps, width):
                needed = f"{info.num_steps} x {width}, as the other files of the cache say"
                raise InputError(where=f"{where}: {name}", found=f"shape {values.shape}", needed=needed, fix=FIX)
            space = measured_space(self._config, width) if name == "states" else vector_states(width)
            if name != "joint_velocities":  # only the idle filter reads them, and checks them
                space.require_plausible(values, f"{where}: {name}", fix=FIX)

    def settle(self, episodes: Int[np.ndarray, " episodes"]) -> DataConfig:
        """Return the config with the names of the cameras.

        Raises:
            InputError: Some of these episodes have no files: the cache is unfinished, or was made of others.
            UnreachableError: The folder cannot be listed now.
        """
        table, opened = self._open()
        numbers = np.unique(episodes).tolist()
        if missing := opened.files.episodes_without_file(numbers, self.cameras):
            such = f"{len(missing)} of {counted(len(numbers), 'episode')}, such as {table.identity(missing[0])}"
            fix = "Run `vjepa2-ac encode` again, as the cache was made: it encodes what is missing; or leave these"
            fix += " episodes out (data.outcome, data.exclude)"
            raise InputError(where=self._config.path, found=f"no latents of {such}", fix=fix)
        return self._config.model_copy(update={"camera": self.cameras})

    def _look(self, progress: Progress) -> tuple[EpisodeTable, _Cache]:  # noqa: ARG002 - at once
        folder = storage.folder_at(self._config.path)
        key = read_key(folder)
        parts = clip_parts(self._config)
        differing = key.differences(parts, parts)
        for camera in () if self._config.camera is None else self._config.cameras:
            if camera not in key.cameras:
                differing.append(f"data.camera: {', '.join(key.cameras)}, not {camera}")
        if differing:  # of other clips than the config's
            raise another_cache(folder, differing)
        table, kept = read_tables(folder, has_idle_rule=self._config.idle.rule != "none")
        cache = fetched_data(self._config.disk_cache) if storage.is_url(folder) else None
        return table, _Cache(key, LatentFiles(folder, key.digest, cache), kept)


def another_cache(folder: Path | str, differing: Sequence[str]) -> InputError:
    """Return the error of a cache with other settings than those in use."""
    found = f"a latent cache that was made otherwise: {'; '.join(differing)}"
    needed = "one that was made with this model and these settings"
    fix = "Change the settings to those, or encode the data set again"
    return InputError(where=str(folder), found=found, needed=needed, fix=fix)
