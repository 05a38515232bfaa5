"""The mirror of a run in another place, and how the run resumes from it: `checkpoint.remote`.

The place looks like a run's folder: `config.yaml`, `metrics.jsonl` and so on, and `checkpoints/step-XXXXXXXX/`. There a
checkpoint exists when its `manifest.json` does, which is sent last and removed first. While a checkpoint is being sent,
its manifest is there under another name, which tells a resumed transfer whose files they are: those that have arrived
are not sent again.

`open_remote` is called before the first step: it tests the place, and fetches what is newer there. A place that cannot
be reached is a warning; one that can never be written, or is another run's, is an error. During the run a thread brings
the place up to date (`Mirror`); the training loop only marks the time. Nothing that happens there stops the run.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError, UserError, counted
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import (
    CHECKPOINTS,
    FETCHING,
    MANIFEST,
    STATE,
    find_damage,
    listed,
    named_files,
    newest_checkpoint,
    remove_leavings,
    step_of,
    written_state,
)
from vjepa2_ac.runs.folder import (
    CONFIG,
    ENVIRONMENT,
    HELD,
    SMALL_FILES,
    RunLock,
    check_run_folder,
    last_start,
    with_settled_values,
)
from vjepa2_ac.storage.retries import quietly
from vjepa2_ac.storage.structured import MOST_BYTES, read_json_object

logger = logging.getLogger(__name__)

SENDING = ".sending.json"
LONGEST_WAIT_S = 3600.0  # for the mirror at the end of a run
_LOOK_EVERY_S = 0.1  # whether the machine is about to stop
_KNOB = "checkpoint.remote"

Listing = Mapping[str, Mapping[str, int]]
"""Sizes of files by name, by name of the checkpoint."""


class LostPlaceError(InputError):
    """The place is another run's, or a later start's of the same run."""


def complete(listing: Listing) -> list[str]:
    """Return the names of the complete checkpoints, the newest first."""
    return sorted((name for name, files in listing.items() if MANIFEST in files), key=_step, reverse=True)


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
        for path, size in storage.file_sizes(storage.join(self.place, CHECKPOINTS)).items():
            name, _, file = path.partition("/")
            if step_of(name) is not None and file:
                found.setdefault(name, {})[file] = size
        return found

    def owner(self, listing: Listing, run_id: str | None) -> str | None:
        """Return the run of all checkpoints there, also incomplete ones; None if it is not known.

        Args:
            listing: They.
            run_id: The run that it should be; None: any.

        Raises:
            LostPlaceError: One is of another run.
        """
        for name in sorted(listing, reverse=True):
            try:
                owner = str(read_json_object(self._path(name, STATE)).get("run_id", ""))
            except InputError:
                continue
            run_id = owner if run_id is None else run_id
            if owner != run_id:
                found = f"{self.place} holds a checkpoint of another run, {name}"
                fix = "Set another checkpoint.remote; nothing was written there"
                raise LostPlaceError(where=_KNOB, found=found, needed="an empty place, or the one of this run", fix=fix)
        return run_id

    def send(self, checkpoint: Path, files: Mapping[str, int], before_each: Callable[[], None]) -> None:
        """Upload the missing files of a complete local checkpoint.

        Args:
            checkpoint: Its folder; the name stays the same.
            files: Those that are there already.
            before_each: Called before each file; an exception ends the upload.
        """
        name, manifest = checkpoint.name, (checkpoint / MANIFEST).read_bytes()
        claim = next((claim for claim in (MANIFEST, SENDING) if claim in files), None)
        if files and (claim is None or storage.read_bounded(self._path(name, claim), MOST_BYTES) != manifest):
            self.remove(name)  # another checkpoint of this name
            files = {}
        sizes = {path: (checkpoint / path).stat().st_size for path in named_files(manifest)}
        missing = [path for path, size in sizes.items() if files.get(path) != size]
        if missing and MANIFEST in files:  # another process removed a file
            storage.remove(self._path(name, MANIFEST))
        if missing and SENDING not in files:
            storage.upload(checkpoint / MANIFEST, self._path(name, SENDING))
        for path in sorted(missing, key=lambda path: path != STATE):  # first the owner
            before_each()
            storage.upload(checkpoint / path, self._path(name, path))
        if missing or MANIFEST not in files:
            before_each()
            storage.upload(checkpoint / MANIFEST, self._path(name, MANIFEST))
        if missing or SENDING in files:
            storage.remove(self._path(name, SENDING))

    def remove(self, name: str) -> None:
        """Remove a checkpoint; its manifest goes first, so that it no longer counts."""
        storage.remove_folder(self._path(name), first=MANIFEST)

    def fetch(self, name: str, folder: Path) -> str | None:
        """Download a checkpoint into a new folder; return its damage, if any."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            with storage.user_can_read(source := self._path(name, MANIFEST)):
                manifest = storage.read_bounded(source, MOST_BYTES)
            for path in named_files(manifest):
                storage.download(self._path(name, path), folder / path)
        except FileNotFoundError as error:
            return f"a file is missing ({error})"
        except InputError as error:
            return f"{MANIFEST} is damaged ({error.found})"
        (folder / MANIFEST).write_bytes(manifest)
        return find_damage(folder)

    def _path(self, *names: str) -> str:
        return storage.join(self.place, "/".join((CHECKPOINTS, *names)))


# ---- before the first step ----


def open_remote(
    config: Config,
    reporter: Reporter,
    *,
    lock: RunLock | None = None,
    allow_config_change: bool = False,
    into: Path | None = None,
) -> Config:
    """Test `checkpoint.remote` if it is set, and fetch a newer checkpoint from there; return the config to go on with.

    A small file is written there and removed again. Fetched is the newest checkpoint there whose every file matches
    its manifest, the best one, and the run's small files; damaged ones are named and skipped, and removed there once a
    whole one is here.

    Args:
        config: The run.
        reporter: Receives messages for the user.
        lock: Taken before the first file is fetched.
        allow_config_change: The run there may have another config.
        into: The folder to fetch into, new or empty, if not the run's own: for a trial, which removes nothing there.

    Returns:
        The config, whose run_dir has the run to resume.

    Raises:
        InputError: It can never be written, it has another run's checkpoints or another config, its checkpoints are
            damaged or cannot be fetched and this machine has none to resume from, or another process has the lock.
    """
    if config.checkpoint.remote is None:
        return config
    place, run_dir = storage.absolute(config.checkpoint.remote), Path(config.run_dir).resolve()
    if not storage.is_url(place) and Path(place).is_relative_to(run_dir):
        found, needed = f"{place}, and run_dir is {run_dir}", "a place outside the run's folder"
        fix = "Set checkpoint.remote to a folder on another disk, or a URL such as gs://bucket/run"
        raise InputError(where=_KNOB, found=found, needed=needed, fix=fix)
    remote, (step, run_id) = RemoteCheckpoints(place), _where_this_machine_stands(run_dir)
    try:
        listing, owner = _tried(remote, run_id)
    except UnreachableError as error:
        stand = "without a checkpoint" if step is None else f"after step {step}"
        text = "%s: %s. Training begins with what is on this machine, %s, and tries again later"
        logger.warning(text, _KNOB, _reason_of(error), stand)
        return config
    minutes = config.checkpoint.remote_every_minutes
    reporter.note(f"{place} can be written: it is brought up to date every {minutes:g} minutes, and in the end.")
    further = [name for name in complete(listing) if step is None or _step(name) > step]
    is_begun_there = step is None and owner is not None  # a machine was killed during its first upload or before
    if not further and not is_begun_there:
        return config
    target = config if into is None else config.model_copy(update={"run_dir": str(into)})
    try:
        _require_this_config(target, place, allow_config_change=allow_config_change)
        if lock is not None:
            lock.take()
        is_fetched = _fetch_newest(remote, further, target, reporter, removes_damaged=into is None)
    except UnreachableError as error:
        if step is None or isinstance(error, RefusedError):
            raise
        text = "%s: %s. Training goes on after step %d, though %s is there"
        logger.warning(text, _KNOB, _reason_of(error), step, further[0])
        return config
    if is_fetched or not further:
        return target
    if step is not None:
        return config
    found = f"{place}: none of {counted(len(further), 'checkpoint')} is whole"
    fix = "To start the run anew, remove them, or set another checkpoint.remote"
    raise InputError(where=_KNOB, found=found, fix=fix)


def _tried(remote: RemoteCheckpoints, run_id: str | None) -> tuple[Listing, str | None]:
    """Return the checkpoints at a place where a file can be written and removed, and their run.

    Raises:
        InputError: It never can, they are of another run, or this user may not read them.
        UnreachableError: It cannot now.
    """
    try:
        with quietly():
            storage.try_writing(remote.place)
            listing = remote.listing()
            return listing, remote.owner(listing, run_id)
    except RefusedError as error:
        fix = f"{error.fix.rstrip('.')}. Or name another place, or leave checkpoint.remote out"
        raise InputError(where=_KNOB, found=f"{error.where}: {error.found}", fix=fix) from error


def _where_this_machine_stands(run_dir: Path) -> tuple[int | None, str | None]:
    """Return step and run of the newest complete local checkpoint."""
    with suppress(InputError):  # none is complete: a remote one may be
        if (checkpoint := newest_checkpoint(run_dir / CHECKPOINTS)) is not None:
            state = written_state(checkpoint)
            return state.step, state.run_id
    return None, None


def _require_this_config(config: Config, place: str, *, allow_config_change: bool) -> None:
    """Check that the run there is the requested one, as for a local folder."""
    with tempfile.TemporaryDirectory() as folder:
        with suppress(FileNotFoundError):
            storage.download(storage.join(place, CONFIG), Path(folder, CONFIG))
        try:
            there = with_settled_values(config.model_copy(update={"run_dir": folder}))
            check_run_folder(there, allow_config_change=allow_config_change)
        except InputError as error:
            fix = "Set another checkpoint.remote for a new run; where the change is meant, add --allow-config-change"
            raise InputError(where=f"{_KNOB} {place}", found=error.found, needed=error.needed, fix=fix) from None


def _fetch_newest(
    remote: RemoteCheckpoints, names: Sequence[str], config: Config, reporter: Reporter, *, removes_damaged: bool
) -> bool:
    """Download a run into its folder, with the first of these checkpoints (the newest first) that is whole, if any.

    Of all it fetches, the checkpoint comes last, so that an interrupted download starts again.
    """
    folder = Path(config.run_dir)
    for name in SMALL_FILES:  # config.yaml first: without it the folder would be no run's
        with suppress(FileNotFoundError):
            storage.download(storage.join(remote.place, name), folder / name)
    remove_leavings(folder / CHECKPOINTS)
    for number, name in enumerate(names):
        if _fetch(remote, name, folder / CHECKPOINTS):
            reporter.note(f"Fetched {name} from {remote.place}.")
            with suppress(UnreachableError):
                for damaged in names[:number] if removes_damaged else ():
                    remote.remove(damaged)
            return True
    return False


def _fetch(remote: RemoteCheckpoints, name: str, checkpoints: Path) -> bool:
    """Download a checkpoint, after the best one that it names; return False, with a warning, if it is damaged."""
    fetched, final = checkpoints / f"{FETCHING}{name}", checkpoints / name
    if problem := remote.fetch(name, fetched):
        shutil.rmtree(fetched)
        logger.warning("%s: %s: %s; passed over", remote.place, name, problem)
        return False
    best = written_state(fetched).best_name
    if best is not None and best != name and not (checkpoints / best).is_dir():
        _fetch(remote, best, checkpoints)
    if final.is_dir():  # a damaged local one
        shutil.rmtree(final)
    fetched.rename(final)
    storage.sync(checkpoints)
    return True


# ---- during the run ----


class Mirror:
    """Keeps another place in sync with a run's folder: in the background, one pass at a time.

    An outage is reported by one warning, however long it lasts. Files that are only on this machine at the end are
    reported by another one.

    Args:
        place: `checkpoint.remote`.
        config: The run.
        run_id: The run whose checkpoints may be there.
    """

    def __init__(self, place: str, config: Config, run_id: str) -> None:
        self._remote, self._run_id = RemoteCheckpoints(storage.absolute(place)), run_id
        self._folder, self._config = Path(config.run_dir), config.checkpoint
        self._thread: threading.Thread | None = None
        self._begun_s = -float("inf")
        self._aim: str | None = None  # the newest local checkpoint when the thread started
        self._sent: str | None = None  # the newest remote one
        self._starts: bytes | None = None  # the list of starts as uploaded: a different one there is a later start's
        self._outage_reported = self._is_lost = self._is_ending = self._has_ended = False
        self._release()  # links of a killed process

    def tick(self) -> None:
        """Start a pass if it is due and there is a new checkpoint; returns at once.

        The first checkpoint of a start is sent without waiting.
        """
        is_due = time.monotonic() - self._begun_s >= 60.0 * self._config.remote_every_minutes
        if is_due and not self.is_sending and self._newest_here() != self._sent:
            self._begin()

    @property
    def is_sending(self) -> bool:
        """Whether a pass is in progress."""
        return self._thread is not None and self._thread.is_alive()

    def finish(self, is_asked_to_stop: Callable[[], bool]) -> None:
        """Upload the newest files and wait for them; warn if the place is not up to date then.

        Args:
            is_asked_to_stop: Whether the machine is about to stop: then the wait is `checkpoint.remote_wait_seconds`,
                else an hour.
        """
        if self._has_ended:
            return
        self._is_ending = True
        begun_s, limit_s = time.monotonic(), LONGEST_WAIT_S
        for is_last in (False, True):  # the current pass ends, or breaks off if there is a newer checkpoint
            if is_last and not self.is_sending:
                self._begin()
            while self._thread and self.is_sending and time.monotonic() < begun_s + limit_s:
                if limit_s == LONGEST_WAIT_S and is_asked_to_stop():
                    limit_s = time.monotonic() - begun_s + self._config.remote_wait_seconds
                self._thread.join(_LOOK_EVERY_S)
        in_time = not self.is_sending
        self._has_ended = True
        if not self._is_lost and not (in_time and self._sent == self._newest_here()):
            logger.warning(
                "%s has checkpoints up to %s; what %s has after that is on this machine only%s. A next start sends it",
                self._remote.place, self._sent or "those of earlier starts", self._folder / CHECKPOINTS,
                "" if in_time else ": there was no more time",
            )  # fmt: skip

    def __enter__(self) -> Mirror:
        """Return the mirror."""
        return self

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        """Stop uploading; if the run ends with an error, upload what exists first."""
        if isinstance(error, Exception):
            self.finish(lambda: True)
        self._has_ended = True

    def _begin(self) -> None:
        self._begun_s, self._aim = time.monotonic(), self._newest_here()
        if not self._is_lost:
            self._thread = threading.Thread(target=self._send, name="mirror", daemon=True)
            self._thread.start()

    def _send(self) -> None:
        try:
            with quietly():
                self._bring_up_to_date()
            self._outage_reported = False
        except _BrokenOffError:
            pass
        except LostPlaceError as error:
            self._is_lost = True
            logger.warning("%s", error)
        except (UserError, OSError) as error:
            log = logger.info if self._outage_reported else logger.warning
            text = "%s is not up to date: %s. Training continues; next attempt in %g minutes"
            log(text, _KNOB, _reason_of(error), self._config.remote_every_minutes)
            self._outage_reported = True
        except Exception:  # no error here may stop the run
            logger.exception("%s: %s is not up to date; training continues", _KNOB, self._remote.place)
        finally:
            self._release()

    def _go_on(self) -> None:
        """Cancel the pass if the run has ended, or is ending and has a newer checkpoint."""
        if self._has_ended or (self._is_ending and self._newest_here() != self._aim):
            raise _BrokenOffError

    def _bring_up_to_date(self) -> None:
        """Upload what is missing: the run's small files, the newest complete checkpoint, and the best one.

        Before that, incomplete older checkpoints are removed, so that a full place has room again; after it, those that
        are no longer kept.

        Raises:
            LostPlaceError: The place is another run's, or another machine has resumed this run, and uses it.
            UnreachableError: It cannot be reached.
            OSError: The run's folder cannot be read, or written for the links.
        """
        listing = self._remote.listing()
        self._remote.owner(listing, self._run_id)
        self._require_not_overtaken()
        names = [path.name for path in reversed(listed(self._folder / CHECKPOINTS))]
        newest = next(filter(None, map(self._hold, names)), None)
        if newest is None:
            return
        best = written_state(newest).best_name
        kept = {newest.name, best}
        halves = listing.keys() - {*complete(listing), *kept}
        self._remove(name for name in halves if _step(name) < _step(newest.name))
        self._send_small_files()
        for checkpoint in (newest, self._hold(best) if best and best != newest.name else None):
            if checkpoint is not None:
                self._remote.send(checkpoint, listing.get(checkpoint.name, {}), self._go_on)
        whole = complete(self._remote.listing())
        self._remove({*whole[self._config.keep :]} - kept)
        self._sent = newest.name

    def _require_not_overtaken(self) -> None:
        """Leave the place to the latest start: two uploaders would overwrite each other's files."""
        path = storage.join(self._remote.place, ENVIRONMENT)
        with suppress(FileNotFoundError):
            if self._starts is not None and storage.read_bounded(path, MOST_BYTES) != self._starts:
                found = f"{self._remote.place} is used by a later start of this run, {last_start(path)}"
                fix = "This one continues without it; stop one of the two"
                raise LostPlaceError(where=_KNOB, found=found, fix=fix)

    def _send_small_files(self) -> None:
        """Upload the files of the run's folder in their current state: they may grow meanwhile."""
        for name in SMALL_FILES:
            source, copy = self._folder / name, self._folder / HELD / name
            if source.is_file():
                self._go_on()
                shutil.copyfile(source, copy)
                storage.upload(copy, storage.join(self._remote.place, name))
                if name == ENVIRONMENT:
                    self._starts = copy.read_bytes()

    def _hold(self, name: str) -> Path | None:
        """Link a checkpoint's files into an own folder, so that training may remove them while they are sent.

        None is returned of one that is incomplete, or just being removed.

        Raises:
            OSError: One that is complete cannot be read.
        """
        source, held = self._folder / CHECKPOINTS / name, self._folder / HELD / name
        shutil.rmtree(held, ignore_errors=True)
        try:
            for file in (MANIFEST, *named_files(storage.read_bounded(source / MANIFEST, MOST_BYTES))):
                (held / file).parent.mkdir(parents=True, exist_ok=True)
                _link(source / file, held / file)
        except (FileNotFoundError, InputError):
            return None
        return held

    def _release(self) -> None:
        shutil.rmtree(self._folder / HELD, ignore_errors=True)

    def _remove(self, names: Iterable[str]) -> None:
        for name in sorted(names):
            self._go_on()
            self._remote.remove(name)

    def _newest_here(self) -> str | None:
        return next((path.name for path in reversed(listed(self._folder / CHECKPOINTS))), None)


def _reason_of(error: Exception) -> str:
    """Return why a place is not up to date; with a fix only if the reason is permanent."""
    if isinstance(error, UnreachableError) and not isinstance(error, RefusedError):
        return f"{error.where}: {error.found}"
    return str(error).rstrip(".")


class _BrokenOffError(Exception):
    """The current pass is no longer needed."""


def _step(name: str) -> int:
    return step_of(name) or 0


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)
