"""The folder of a latent cache: cache.json, the episodes, the ranges of steps, and a file for each episode.

cache.json     what the cache is: its key in full, the shape of its latents, cameras, counts; written last, so that a
               cache that has it is complete
episodes.npz   every episode of the data set that it was made from, in its order, as `EpisodeTable.to_bytes` writes
               them; with, for each camera, the size of an episode's file (0: not encoded)
kept.npz       the steps that `data.idle` leaves, as `FoundRanges.to_bytes` writes them; absent without an idle rule
episodes/000/000123-CAMERA.safetensors   see `episode_file`
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import quote

from pydantic import Field

from vjepa2_ac.data.idle import FoundRanges
from vjepa2_ac.data.index.episode_table import EpisodeTable, NotATableError
from vjepa2_ac.data.sources.latents.cache_key import CacheKey
from vjepa2_ac.data.sources.latents.episode_file import EpisodeLayout
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import read_bounded
from vjepa2_ac.storage.structured import read_json_object, record_of

T = TypeVar("T")

FORMAT = "vjepa2-ac latent cache 1"
MANIFEST, EPISODES, KEPT = "cache.json", "episodes.npz", "kept.npz"

_MOST_BYTES = 1 << 30
_AGAIN = (
    "Delete cache.json and run `vjepa2-ac encode` again, with the config that it was made with; or copy the cache again"
)


@dataclass(frozen=True)
class Manifest:
    """The description of a cache."""

    key: Mapping[str, Any]  # the parts of its `CacheKey`
    digest: str
    tokens: Annotated[int, Field(ge=1, le=65_536)]  # of a frame
    dim: Annotated[int, Field(ge=1, le=16_384)]
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)]
    episodes: int  # of the data set
    encoded: int  # at least one of them per camera
    frames: int  # of all cameras
    bytes: int
    broken: Mapping[str, str]  # episodes that could not be read while encoding, and why
    checksums: Mapping[str, int]  # CRC-32 of the other files in the folder
    about: Mapping[str, Any]  # other information; never interpreted

    @property
    def layout(self) -> EpisodeLayout:
        """The layout of all files of the cache."""
        return EpisodeLayout(self.digest, self.cache_key.kind, self.tokens, self.dim)

    @property
    def cache_key(self) -> CacheKey:
        """Everything that determined the content of the cache."""
        return CacheKey(self.key)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras of the latents."""
        return tuple(self.key["data.camera"])

    def to_text(self) -> str:
        """Return it as cache.json."""
        return json.dumps({"format": FORMAT, **asdict(self)}, indent=1) + "\n"


def path_of(folder: Path, number: int, camera: str) -> Path:
    """Return the file of an episode, by its index in the data set, and a camera."""
    return folder / "episodes" / f"{number // 1000:03d}" / f"{number:06d}-{quote(camera, safe='')}.safetensors"


def size_column(place: int) -> str:
    """Return the name of the column with the sizes of the files of the n-th camera."""
    return f"bytes{place}"


def size_of(path: Path) -> int | None:
    """Return the size of a file, or None if there is none."""
    try:
        return os.stat(path).st_size  # noqa: PTH116 - a third of the time, for as many files as there are episodes
    except OSError:
        return None


def is_whole(folder: Path) -> bool:
    """Return whether a folder has a complete cache."""
    return (folder / MANIFEST).is_file()


def read_manifest(folder: Path) -> Manifest:
    """Read cache.json.

    Raises:
        InputError: It is missing, or invalid.
    """
    where = str(folder / MANIFEST)
    try:
        content = read_json_object(folder / MANIFEST, most_bytes=_MOST_BYTES, fix=_AGAIN)
    except (FileNotFoundError, NotADirectoryError):
        found = "an unfinished latent cache" if (folder / "episodes").is_dir() else "no latent cache"
        found = found if folder.is_dir() else f"no such folder, seen from {Path.cwd()}"
        fix = "Run `vjepa2-ac encode`, which goes on where it was stopped"
        raise InputError(where=str(folder), found=found, needed=f"a folder with {MANIFEST}", fix=fix) from None
    except OSError as error:
        raise InputError(where=where, found=f"cannot be read ({error})", fix=_AGAIN) from None
    if content.pop("format", None) != FORMAT:
        raise InputError(where=where, found="another format", needed=FORMAT, fix=_AGAIN)
    manifest = record_of(Manifest, content, where=where, needed="what a latent cache says of itself", fix=_AGAIN)
    manifest.cache_key.require_whole(where=where, fix=_AGAIN)
    if manifest.cache_key.digest != manifest.digest:
        raise InputError(where=where, found="damaged: its key is not what its digest says", fix=_AGAIN)
    return manifest


def read_episodes(folder: Path, manifest: Manifest) -> tuple[EpisodeTable, FoundRanges | None]:
    """Read the episodes of a cache and, if it has an idle rule, the ranges that the rule keeps.

    Raises:
        InputError: One of the files is missing or damaged.
    """
    table = _read(folder, manifest, EPISODES, EpisodeTable.from_bytes)
    for place, camera in enumerate(manifest.cameras):
        if size_column(place) not in table.locators:
            raise InputError(where=str(folder / EPISODES), found=f"no sizes of the files of {camera}", fix=_AGAIN)
    if KEPT not in manifest.checksums:
        return table, None
    kept = _read(folder, manifest, KEPT, FoundRanges.from_bytes)
    try:
        kept.require_of(table)
    except NotATableError as error:
        raise InputError(where=str(folder / KEPT), found=str(error), fix=_AGAIN) from None
    return table, kept


def _read(folder: Path, manifest: Manifest, name: str, from_bytes: Callable[[bytes], T]) -> T:
    path = folder / name
    try:
        data = read_bounded(path, _MOST_BYTES)
        found = from_bytes(data)
    except (OSError, NotATableError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", fix=_AGAIN) from None
    if zlib.crc32(data) != manifest.checksums.get(name):
        raise InputError(where=str(path), found="damaged: its CRC is not the one in cache.json", fix=_AGAIN)
    return found
