"""One upload pass that brings `checkpoint.remote` up to date.

First the owner is checked: where another run's checkpoints are, nothing is written. Then incomplete older checkpoints
are removed, which frees room for what follows: the run's small files, the newest complete checkpoint, the best one.
Last, checkpoints that are no longer kept are removed. Files being sent are held by hard links, so that training may
remove them meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Collection
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, listed, step_of, written_state
from vjepa2_ac.runs.files import MANIFEST, named_files
from vjepa2_ac.runs.folder import CALIBRATION, CHANGES, CONFIG, ENVIRONMENT, HELD, METRICS, RUN_ID
from vjepa2_ac.runs.mirror.remote_checkpoints import Listing, RemoteCheckpoints, complete
from vjepa2_ac.storage import join, read_bounded, upload
from vjepa2_ac.storage.structured import MOST_BYTES, json_list, shown

SMALL_FILES = (CONFIG, ENVIRONMENT, CALIBRATION, CHANGES, RUN_ID, METRICS)

GoOn = Callable[[], None]
"""Called before each file; raises to break off."""


class LostPlaceError(Exception):
    """The place is another run's, or a later start's of the same run; the argument says so, and what follows."""


class RemoteUpdate:
    """Brings a place up to date, and remembers its content. Not for concurrent calls.

    Args:
        remote: The place.
        folder: The run's folder.
        run_id: The run whose checkpoints may be there.
        keep: How many of the newest stay there, in addition to the best.
        damaged: Names of damaged checkpoints there; they are removed.
    """

    def __init__(
        self, remote: RemoteCheckpoints, folder: Path, run_id: str, keep: int, damaged: Collection[str] = ()
    ) -> None:
        self.place, self.folder = remote.place, folder
        self._remote, self._run_id, self._keep = remote, run_id, keep
        self._damaged = set(damaged)
        self._ours: set[str] = set()  # remote checkpoints that are known to be of this run
        self._small: dict[str, tuple[int, int]] = {}  # sizes and times of the uploaded small files
        self._starts: bytes | None = None  # the list of starts as uploaded: a different one there is a later start's
        self.release()  # links held by a killed process

    def __call__(self, go_on: GoOn) -> str | None:
        """Upload what is missing; return the newest checkpoint there, None if there is none to upload.

        Raises:
            LostPlaceError: The place is another run's, or another machine has resumed this run, and uses it.
            UnreachableError: It cannot be reached.
            OSError: The run's folder cannot be read, or written for the links.
        """
        listing = self._remote.listing()
        self._require_ours(listing)
        self._require_not_overtaken()
        for name in self._damaged & set(listing):
            self._remote.remove(name)
            listing = {other: files for other, files in listing.items() if other != name}
        self._damaged.clear()
        newest = next(filter(None, map(self._hold, self._names_here())), None)
        if newest is None:
            return None
        best_name = written_state(newest).best_name
        best = self._hold(best_name) if best_name not in {None, newest.name} else None
        # Older incomplete ones: else a full place would never have room again; newer ones stay.
        halves = set(listing) - {*complete(listing), newest.name, best_name}
        self._remove([name for name in halves if (step_of(name) or 0) < (step_of(newest.name) or 0)], go_on)
        self._send_small_files(go_on)
        for checkpoint in (newest, best):
            if checkpoint is not None:
                self._remote.send(checkpoint, listing.get(checkpoint.name, {}), before_each=go_on)
                self._ours.add(checkpoint.name)
        whole = complete(self._remote.listing())
        self._remove(set(whole) - {*whole[: self._keep], newest.name, best_name}, go_on)
        return newest.name

    def release(self) -> None:
        """Remove the links."""
        shutil.rmtree(self.folder / HELD, ignore_errors=True)

    def newest_here(self) -> str | None:
        """Return the newest local checkpoint."""
        return next(iter(self._names_here()), None)

    def _require_ours(self, listing: Listing) -> None:
        for name in sorted(set(listing) - self._ours):
            owner = self._remote.run_id(name)
            if owner is not None and owner != self._run_id:
                raise LostPlaceError(
                    f"{self.place} holds a checkpoint of another run, {name}. Nothing was written there, and nothing"
                    " will be: this run is on this machine alone. Name another place when you start it again"
                )
            if owner is not None:
                self._ours.add(name)

    def _require_not_overtaken(self) -> None:
        """Leave the place to the latest start: two uploaders would overwrite each other's files."""
        if self._starts is None:
            return
        path = join(self.place, ENVIRONMENT)
        try:
            there = read_bounded(path, MOST_BYTES)
        except FileNotFoundError:
            self._small.pop(ENVIRONMENT, None)
            return
        if there != self._starts:
            raise LostPlaceError(
                f"{self.place} is used by a later start of this run, {_last_start(there, path)}. This one continues"
                " without it; stop one of the two"
            )

    def _send_small_files(self, go_on: GoOn) -> None:
        """Upload the changed files of the run's folder in their current state: they may grow meanwhile."""
        for name in SMALL_FILES:
            source, copy = self.folder / name, self.folder / HELD / name
            if not source.is_file():
                continue
            version = (source.stat().st_size, source.stat().st_mtime_ns)
            if self._small.get(name) != version:
                go_on()
                shutil.copyfile(source, copy)
                upload(copy, join(self.place, name))
                if name == ENVIRONMENT:
                    self._starts = copy.read_bytes()
                self._small[name] = version

    def _hold(self, name: str | None) -> Path | None:
        """Link a checkpoint's files into an own folder; None if it is incomplete, or just being removed."""
        held = self.folder / HELD / str(name)
        shutil.rmtree(held, ignore_errors=True)
        try:
            shutil.copytree(self.folder / CHECKPOINTS / str(name), held, copy_function=_link)
            files = named_files((held / MANIFEST).read_bytes())
        except (FileNotFoundError, shutil.Error, InputError):
            return None
        return held if all((held / file).is_file() for file in files) else None

    def _remove(self, names: Collection[str], go_on: GoOn) -> None:
        for name in sorted(names):
            go_on()
            self._remote.remove(name)

    def _names_here(self) -> list[str]:
        """Return the local checkpoints, the newest first."""
        with contextlib.suppress(FileNotFoundError):
            return [path.name for path in reversed(listed(self.folder / CHECKPOINTS))]
        return []


def _last_start(starts: bytes, where: str) -> str:
    """Return where and when a run was started last, as text."""
    try:
        last = json_list(starts, where=where)[-1]
        return f"on {shown(last['host'])}, at {shown(last['time'])}"
    except (InputError, LookupError, TypeError):
        return "elsewhere"


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)
