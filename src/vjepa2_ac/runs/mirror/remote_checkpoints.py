"""Remote checkpoints of a run: list, send and fetch them.

The place looks like a run's folder: `config.yaml`, `metrics.jsonl` and so on, and `checkpoints/step-XXXXXXXX/`. There a
checkpoint exists when its `manifest.json` does, which is sent last and removed first. While a checkpoint is being sent,
its manifest is there under another name, which tells a resumed transfer whose files they are: those that have arrived
are not sent again.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, STATE, find_damage, step_of
from vjepa2_ac.runs.files import MANIFEST, named_files
from vjepa2_ac.storage import download, file_sizes, join, read_bounded, remove, remove_folder, upload
from vjepa2_ac.storage.structured import MOST_BYTES, read_json_object

SENDING = ".sending.json"

Listing = Mapping[str, Mapping[str, int]]
"""Sizes of files by name, by name of the checkpoint."""


def complete(listing: Listing) -> list[str]:
    """Return the names of the complete checkpoints, the newest first."""
    whole = [name for name, files in listing.items() if MANIFEST in files]
    return sorted(whole, key=lambda name: step_of(name) or 0, reverse=True)


@dataclass(frozen=True)
class RemoteCheckpoints:
    """The checkpoints at a place; every method raises UnreachableError if it cannot be reached.

    Attributes:
        place: What `storage.absolute` returned.
    """

    place: str

    def listing(self) -> Listing:
        """Return the checkpoints there, complete or not, from one listing."""
        found: dict[str, dict[str, int]] = {}
        for path, size in file_sizes(join(self.place, CHECKPOINTS)).items():
            name, _, file = path.partition("/")
            if step_of(name) is not None and file:
                found.setdefault(name, {})[file] = size
        return found

    def run_id(self, name: str) -> str | None:
        """Return the run of a checkpoint; None if unknown."""
        try:
            state = read_json_object(self._path(name, STATE))
        except (FileNotFoundError, InputError):
            return None
        return str(state.get("run_id", ""))

    def send(self, checkpoint: Path, files: Mapping[str, int], before_each: Callable[[], None]) -> None:
        """Upload the missing files of a complete local checkpoint.

        Args:
            checkpoint: Its folder; the name stays the same.
            files: Those that are there already.
            before_each: Called before each file; an exception ends the upload.
        """
        name, manifest = checkpoint.name, (checkpoint / MANIFEST).read_bytes()
        sizes = {path: (checkpoint / path).stat().st_size for path in named_files(manifest)}
        there = self._of_this(name, files, manifest)
        missing = [path for path, size in sizes.items() if there.get(path) != size]
        if missing and MANIFEST in there:  # another process removed a file
            remove(self._path(name, MANIFEST))
        if missing and SENDING not in there:
            upload(checkpoint / MANIFEST, self._path(name, SENDING))
        for path in sorted(missing, key=lambda path: path != STATE):  # first the owner
            before_each()
            upload(checkpoint / path, self._path(name, path))
        if missing or MANIFEST not in there:
            before_each()
            upload(checkpoint / MANIFEST, self._path(name, MANIFEST))
        if missing or SENDING in there:
            remove(self._path(name, SENDING))

    def remove(self, name: str) -> None:
        """Remove a checkpoint; its manifest goes first, so that it no longer counts."""
        remove_folder(self._path(name), first=MANIFEST)

    def fetch(self, name: str, folder: Path) -> str | None:
        """Download a checkpoint into a new folder; return its damage, if any."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            manifest = read_bounded(self._path(name, MANIFEST), MOST_BYTES)
            for path in named_files(manifest):
                download(self._path(name, path), folder / path)
        except FileNotFoundError as error:
            return f"a file is missing ({error})"
        except InputError as error:
            return f"no readable {MANIFEST} ({error.found})"
        (folder / MANIFEST).write_bytes(manifest)
        return find_damage(folder)

    def _of_this(self, name: str, files: Mapping[str, int], manifest: bytes) -> Mapping[str, int]:
        """Return the files of this checkpoint that are there; remove those of another one with the same name."""
        claim = next((claim for claim in (MANIFEST, SENDING) if claim in files), None)
        if claim is not None and read_bounded(self._path(name, claim), MOST_BYTES) == manifest:
            return files
        if files:
            self.remove(name)
        return {}

    def _path(self, *names: str) -> str:
        return join(self.place, "/".join((CHECKPOINTS, *names)))
