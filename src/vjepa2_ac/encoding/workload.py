"""The work left in a latent cache, and its division among processes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import WHOLE, ProcessShare
from vjepa2_ac.data.sources.latents.cache_key import CacheKey
from vjepa2_ac.data.sources.latents.dtypes import bytes_per_frame
from vjepa2_ac.data.sources.latents.manifest import is_whole, read_manifest
from vjepa2_ac.encoding.cache_lookup import needed_frames
from vjepa2_ac.encoding.cache_writer import CacheWriter
from vjepa2_ac.encoding.disk_space import CacheSize, small_frame_bytes
from vjepa2_ac.encoding.prefetch import FramesToEncode
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import read_json_object, record_of

_BROKEN, _KEY = "broken", "key.json"


@dataclass(frozen=True, eq=False)
class Workload:
    """A cache to write, and the share of this process: every episode belongs to one process."""

    dataset: Dataset
    writer: CacheWriter
    frames: int  # of the whole cache, of all cameras
    left: tuple[FramesToEncode, ...]  # of this process
    left_in_total: int  # frames, of all processes

    @classmethod
    def of(cls, dataset: Dataset, writer: CacheWriter, share: ProcessShare) -> Workload:
        """Compare with the existing files: written episodes are not encoded again; broken ones are retried."""
        frames, left_in_total, left = 0, 0, []
        for place, needed in enumerate(needed_frames(dataset)):
            for camera in dataset.config.cameras:
                frames += len(needed.steps)
                if writer.has(needed.episode, camera):
                    continue
                left_in_total += len(needed.steps)
                if place % share.processes == share.rank:
                    left.append(FramesToEncode(needed.episode, camera, needed.steps))
        return cls(dataset, writer, frames, tuple(left), left_in_total)

    @property
    def frames_left(self) -> int:
        """Frames that this process still has to encode."""
        return sum(len(one.steps) for one in self.left)

    @property
    def room(self) -> CacheSize:
        """The size of the cache on disk."""
        writer, table = self.writer, self.dataset.table
        steps = int(table.num_steps[np.unique(self.dataset.starts.episode)].sum())
        per_frame = bytes_per_frame(writer.encoding.tokens, writer.encoding.dim, writer.key.kind)
        per_frame += small_frame_bytes(writer.encoding.image_size)
        return CacheSize(self.frames, self.left_in_total, per_frame, steps / self.dataset.control_rate_hz / 3600)

    @property
    def is_incomplete(self) -> bool:
        """Whether an episode is currently neither written nor recorded as broken, by any process."""
        left, broken = Workload.of(self.dataset, self.writer, WHOLE).left, broken_in(self.writer.folder)
        return any(self.dataset.table.identity(one.episode) not in broken for one in left)


def claim_folder(writer: CacheWriter) -> None:
    """Check that a folder belongs to this cache, finished or not, or is new.

    Raises:
        InputError: It holds another cache, and how it differs; or it cannot be written.
    """
    path = writer.folder / _KEY
    there = read_manifest(writer.folder).cache_key if is_whole(writer.folder) else _begun(path)
    if there is not None and there.digest != writer.key.digest:
        raise InputError(
            where=str(writer.folder),
            found=f"a latent cache that was made otherwise: {'; '.join(there.differences(writer.key.parts))}",
            needed="a new or empty folder, or the same cache",
            fix="Name another folder, or delete this one",
        )
    if there is None:
        _require_empty(writer.folder)
        with storage.user_can_write(writer.folder):
            storage.write_atomically(path, json.dumps(dict(writer.key.parts), indent=1) + "\n")


def _require_empty(folder: Path) -> None:
    """Refuse a folder with other contents, such as that of a run; hidden files and this cache's own files pass."""
    others = sorted(path.name for path in folder.iterdir() if path.name[0] != ".") if folder.is_dir() else []
    ours = (_KEY, _BROKEN, "episodes")
    strange = [name for name in others if not name.startswith(ours)]
    if strange:
        raise InputError(
            where=str(folder),
            found=f"a folder with other things in it, such as {strange[0]}",
            needed="a new or empty one for a latent cache",
            fix="Name another folder",
        )


def _begun(path: Path) -> CacheKey | None:
    """Return the key of an unfinished cache."""
    try:
        return CacheKey(read_json_object(path, fix="Delete this folder"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", fix="Delete this folder") from None


def note_broken(folder: Path, episode: int, name: str, reason: str) -> None:
    """Record, for the process that finalizes the cache, that an episode cannot be read."""
    with storage.user_can_write(folder):
        storage.write_atomically(_note_of(folder, episode), json.dumps({"name": name, "reason": reason}) + "\n")


def forget_broken(folder: Path, episode: int) -> None:
    """Delete the record of a broken episode, so that it is retried."""
    with storage.user_can_write(folder):
        _note_of(folder, episode).unlink(missing_ok=True)


def broken_in(folder: Path) -> Mapping[str, str]:
    """Return the recorded episodes of all processes, and the reasons."""
    paths = sorted((folder / _BROKEN).glob("*.json"))
    notes = [record_of(_Note, read_json_object(path), where=str(path), fix="Delete this file") for path in paths]
    return {note.name: note.reason for note in notes}


@dataclass(frozen=True)
class _Note:
    """An episode that cannot be read, and why."""

    name: str
    reason: str


def _note_of(folder: Path, episode: int) -> Path:
    return folder / _BROKEN / f"{episode:06d}.json"
