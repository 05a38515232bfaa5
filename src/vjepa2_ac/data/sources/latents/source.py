"""Source of cached latents: reads them by frame; the data set itself is not needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.filters.idle_ranges import FoundRanges
from vjepa2_ac.data.index.episode_table import EpisodeProblem
from vjepa2_ac.data.sources.indexed_source import IndexedSource, Opened
from vjepa2_ac.data.sources.latents.cache_files import CacheDescription, LatentFiles, read_description, read_tables
from vjepa2_ac.data.sources.latents.cache_key import clip_parts
from vjepa2_ac.episode import Episode, Progress, StepRanges
from vjepa2_ac.errors import InputError

_ENCODE = "Run `vjepa2-ac encode` again, as the cache was made: it encodes what is lacking; or copy the file again"


@dataclass(frozen=True)
class _Opened(Opened):
    about: CacheDescription
    files: LatentFiles
    kept: FoundRanges | None


class LatentSource(IndexedSource[DataConfig, _Opened]):
    """The episodes of the data set that a latent cache was made from, in that data set's order.

    An episode that could not be read while encoding is included, and raises an error here, too: so the clips are those
    of the data set, in their order.
    """

    @property
    def about(self) -> CacheDescription:
        """What the cache is."""
        return self._open().about

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that clips are drawn from: the config's, or all of the cache."""
        return self.about.cameras if self._config.camera is None else self._config.cameras

    @property
    def settled_config(self) -> DataConfig:
        """The config with the names of the cameras."""
        return self._config.model_copy(update={"camera": self.cameras})

    def kept_ranges(self) -> FoundRanges:
        """Return the ranges that `data.idle` keeps, from the cache; its rule is not none.

        Raises:
            InputError: No cache, or one of other clips than the config's.
        """
        kept = self._open().kept
        if kept is None:  # `_look` has compared the rules
            raise InputError(where=self._config.path, found="no kept.npz", needed="that of its idle rule", fix=_ENCODE)
        return kept

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - nothing is fetched
        """Return one episode; only requested latents are read.

        Raises:
            InputError: The file is missing or damaged, or the episode could not be read while encoding.
            ValueError: A camera that the cache does not have.
        """
        opened, camera = self._open(), camera or self.cameras[0]
        info = opened.table[index]
        if camera not in opened.about.cameras:
            raise ValueError(f"camera {camera!r} is not one of {', '.join(opened.about.cameras)}")
        record = opened.files.open(index, camera)
        states = record.states
        if (record.id, record.camera, len(states)) != (info.id, camera, info.num_steps):
            found = f"episode {record.id} of {len(states)} steps, camera {record.camera}"
            needed_text = f"{info.id} of {info.num_steps} steps, camera {camera}"
            raise InputError(where=record.path, found=found, needed=needed_text, fix=_ENCODE)
        return Episode(
            info=info,
            states=states,
            read_frames=lambda steps: record.pictures(record.places_of(steps)),
            control_rate_hz=opened.about.control_rate_hz,
            extrinsics=record.by_step("extrinsics"),
            joint_velocities=record.by_step("joint_velocities"),
            metadata=record.metadata,
            commands=record.by_step("commands"),
            read_latents=lambda steps: record.latents(record.places_of(steps)),
            frame_steps=record.frame_steps,
        )

    def require_encoded(self, episodes: Int[np.ndarray, " episodes"]) -> None:
        """Refuse a cache without the latents of these episodes: it is unfinished, or was made of others.

        Raises:
            InputError: Some are missing.
        """
        opened, wanted = self._open(), np.unique(episodes).tolist()
        lacking = [one for one in wanted if any(self._is_absent(one, camera) for camera in self.cameras)]
        if lacking:
            several = f"{len(lacking)} of {len(wanted)} episodes, such as {opened.table.identity(lacking[0])}"
            raise InputError(
                where=self._config.path,
                found=f"no latents of {several}",
                needed="those of every episode that takes part",
                fix="Run `vjepa2-ac encode` again, which goes on where it was stopped; or set data.outcome and"
                " data.exclude as they were when it was made",
            )

    def wrong_files(self) -> list[EpisodeProblem]:
        """Return the episodes with a file that is truncated, or of another cache."""
        opened, problems = self._open(), []
        for number in range(len(opened.table)):
            for camera in self.cameras:
                path = opened.files.path(number, camera)
                if path.is_file() and not opened.files.has(number, camera):
                    name, found = opened.table.identity(number), "a file that is damaged, or of another cache"
                    problems.append(EpisodeProblem(name, f"{path} ({name})", found, "", _ENCODE))
        return problems

    def _is_absent(self, number: int, camera: str) -> bool:
        files = self._open().files
        return not files.path(number, camera).is_file() and not files.is_done(number, camera)

    def _look(self, progress: Progress) -> _Opened:  # noqa: ARG002 - at once
        folder = Path(self._config.path)
        about = read_description(folder)
        parts = clip_parts(self._config)
        differing = about.cache_key.differences(parts, parts)
        for camera in () if self._config.camera is None else self._config.cameras:
            if camera not in about.cameras:
                differing.append(f"data.camera: {', '.join(about.cameras)}, not {camera}")
        if differing:  # of other clips than the config's
            raise another_cache(folder, differing)
        table, kept = read_tables(folder)
        texts = {"control_rate_hz": str(about.control_rate_hz), "widths": " ".join(map(str, about.widths))}
        table = replace(table, texts={**table.texts, **texts}, locators={})
        return _Opened(table, about, LatentFiles(folder, about.layout), kept)


def another_cache(folder: Path, differing: Sequence[str]) -> InputError:
    """Return the error of a cache with other settings than those in use."""
    return InputError(
        where=str(folder),
        found=f"a latent cache that was made otherwise: {'; '.join(differing)}",
        needed="one that was made with this model and these settings",
        fix="Change the settings to those, or encode the data set again",
    )
