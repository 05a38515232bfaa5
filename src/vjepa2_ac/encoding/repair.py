"""Latent cache repair: finds missing or damaged files of a finished cache and encodes them again, one file at a time.

A file that is missing, truncated or newly needed is found by its size, without reading it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latents.manifest import (
    MANIFEST,
    path_of,
    read_episodes,
    read_manifest,
    size_column,
    size_of,
)
from vjepa2_ac.encoding.cache_writer import CacheWriter


@dataclass(frozen=True)
class MissingFiles:
    """A file that a finished cache should have."""

    path: Path
    episode: str  # its identity
    instead: str  # what is at its place
    size: int  # written size; 0: it was not needed when the cache was made

    def __str__(self) -> str:
        return f"{self.episode} ({self.path.name}: {self.instead})"


def missing_files(dataset: Dataset, writer: CacheWriter) -> list[MissingFiles]:
    """Return damaged files, and missing files that clips need.

    Episodes that could not be read when the cache was made are not included.

    Raises:
        InputError: The manifest of the cache cannot be read.
    """
    manifest = read_manifest(writer.folder)
    table, _ = read_episodes(writer.folder, manifest)
    needed, found = set(dataset.starts.episodes.tolist()), []
    for place, camera in enumerate(manifest.cameras):
        for number, size in enumerate(table.locators[size_column(place)].tolist()):
            name, path = table.identity(number), path_of(writer.folder, number, camera)
            if size and (there := size_of(path)) != size:
                instead = "no such file" if there is None else f"{there:,} bytes instead of {size:,}"
                found.append(MissingFiles(path, name, instead, size))
            elif not size and number in needed and name not in manifest.broken:
                found.append(MissingFiles(path, name, "not encoded yet", 0))
    return found


def restart(writer: CacheWriter, missing: Sequence[MissingFiles]) -> None:
    """Turn a finished cache into an unfinished one that lacks these files, so that the next encoding writes them.

    Damaged files are deleted first, and cache.json, which marks a finished cache, last: a kill changes nothing.

    Raises:
        InputError: The folder cannot be written.
    """
    with storage.user_can_write(writer.folder):
        for one in missing:
            if size_of(one.path) != one.size:  # or another process has written it meanwhile
                one.path.unlink(missing_ok=True)
        (writer.folder / MANIFEST).unlink(missing_ok=True)


def describe(missing: Sequence[MissingFiles]) -> str:
    """Return as text which episodes are encoded again."""
    more = f" and {len(missing) - 1:,} more" if len(missing) > 1 else ""
    return f"Missing in the latent cache or damaged: {missing[0]}{more}"
