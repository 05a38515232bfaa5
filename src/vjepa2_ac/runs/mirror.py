"""The mirror of a run on remote storage (`checkpoint.remote`): a thread uploads the run folder.

The remote copy has the layout of a run folder: `config.yaml`, `metrics.jsonl` and so on, and
`checkpoints/step-XXXXXXXX/`. A remote checkpoint is complete when its `manifest.json` exists, which is uploaded last
and removed first. During an upload the manifest has another name, so that a resumed upload recognises the files of the
same checkpoint and does not upload them again. No error on the remote storage stops the run.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError, UserError
from vjepa2_ac.runs.checkpoint import (
    CHECKPOINTS,
    MANIFEST,
    STATE,
    find_damage,
    list_checkpoints,
    parse_manifest,
    parse_step,
    read_state_file,
)
from vjepa2_ac.runs.folder import ENVIRONMENT, SMALL_FILES, UPLOAD_LINKS, describe_last_start
from vjepa2_ac.storage.retries import suppress_retry_warnings
from vjepa2_ac.storage.structured import MAX_BYTES, read_json_object

logger = logging.getLogger(__name__)

UPLOADING = ".sending.json"  # name of the manifest during an upload
REMOTE_KEY = "checkpoint.remote"
LONGEST_WAIT_S = 3600.0  # for the uploads at the end of a run
_POLL_INTERVAL_S = 0.1  # interval of checks whether the machine is about to stop

Listing = Mapping[str, Mapping[str, int]]
"""Name of the checkpoint -> file name -> size in bytes."""


class RemoteFolderTakenError(InputError):
    """The remote folder belongs to another run, or to a later start of the same run."""


class _CancelledError(Exception):
    """The current upload pass is no longer needed."""


def list_complete(listing: Listing) -> list[str]:
    """Return the names of the complete checkpoints, newest first."""
    return sorted((name for name, files in listing.items() if MANIFEST in files), key=step_number, reverse=True)


def step_number(name: str) -> int:
    """Return the step of a checkpoint from its name; 0 for other names."""
    return parse_step(name) or 0


@dataclass(frozen=True)
class RemoteCheckpoints:
    """The checkpoints in a remote folder; every method raises UnreachableError if it cannot be reached.

    Attributes:
        location: The URL or path of the remote folder, from `storage.canonical_path`.
    """

    location: str

    def list_files(self) -> Listing:
        """List all remote checkpoints, complete or not, with one request."""
        checkpoints: dict[str, dict[str, int]] = {}
        for path, size in storage.file_sizes(storage.join(self.location, CHECKPOINTS)).items():
            name, _, file = path.partition("/")
            if parse_step(name) is not None and file:
                checkpoints.setdefault(name, {})[file] = size
        return checkpoints

    def find_owner(self, listing: Listing, run_id: str | None) -> str | None:
        """Return the id of the run to which all checkpoints in a listing belong; None if it is not known.

        Args:
            listing: The result of `list_files`; incomplete checkpoints also count.
            run_id: The expected run; None for any run.

        Raises:
            RemoteFolderTakenError: A checkpoint belongs to another run.
        """
        for name in sorted(listing, reverse=True):
            try:
                owner = str(read_json_object(self._path(name, STATE)).get("run_id", ""))
            except InputError:
                continue
            run_id = owner if run_id is None else run_id
            if owner != run_id:
                problem = f"{self.location} contains a checkpoint of another run, {name}"
                fix = "Set another checkpoint.remote; nothing was written to this folder"
                raise RemoteFolderTakenError(
                    where=REMOTE_KEY, found=problem, needed="an empty folder, or that of this run", fix=fix
                )
        return run_id

    def upload(self, checkpoint: Path, files: Mapping[str, int], before_each: Callable[[], None]) -> None:
        """Upload the missing files of a complete local checkpoint.

        Args:
            checkpoint: The local folder; the remote one gets the same name.
            files: The remote files that exist already, with sizes.
            before_each: Called before each file; an exception ends the upload.
        """
        name, manifest = checkpoint.name, (checkpoint / MANIFEST).read_bytes()
        remote_name = next((file for file in (MANIFEST, UPLOADING) if file in files), None)
        if files and (
            remote_name is None or storage.read_small_file(self._path(name, remote_name), MAX_BYTES) != manifest
        ):
            self.remove(name)  # a different checkpoint with the same name
            files = {}
        sizes = {path: (checkpoint / path).stat().st_size for path in parse_manifest(manifest)}
        missing = [path for path, size in sizes.items() if files.get(path) != size]
        if missing and MANIFEST in files:  # another process removed a file
            storage.remove(self._path(name, MANIFEST))
        if missing and UPLOADING not in files:
            storage.upload(checkpoint / MANIFEST, self._path(name, UPLOADING))
        manifest_last = [MANIFEST] if missing or MANIFEST not in files else []
        state_first = sorted(missing, key=lambda path: path != STATE)  # it contains the run id
        for path in (*state_first, *manifest_last):
            before_each()
            storage.upload(checkpoint / path, self._path(name, path))
        if missing or UPLOADING in files:
            storage.remove(self._path(name, UPLOADING))

    def remove(self, name: str) -> None:
        """Remove a checkpoint, its manifest first, so that the checkpoint is incomplete from then on."""
        storage.remove_folder(self._path(name), first=MANIFEST)

    def download(self, name: str, folder: Path) -> str | None:
        """Download a checkpoint into a new folder; return a description of its damage, or None."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            with storage.translate_read_errors(source := self._path(name, MANIFEST)):
                manifest = storage.read_small_file(source, MAX_BYTES)
            for path in parse_manifest(manifest):
                storage.download(self._path(name, path), folder / path)
        except FileNotFoundError as error:
            return f"a file is missing ({error})"
        except InputError as error:
            return f"{MANIFEST} is damaged ({error.found})"
        (folder / MANIFEST).write_bytes(manifest)
        return find_damage(folder)

    def _path(self, *names: str) -> str:
        return storage.join(self.location, "/".join((CHECKPOINTS, *names)))


class Mirror:
    """A mirror that keeps a remote folder in sync with a run folder, in a thread, one upload pass at a time.

    An outage causes one warning. Files that are only on this machine at the end cause another. As a context manager it
    stops uploading at the end; if the run ends with an error, it first uploads the existing files.

    Args:
        location: The value of `checkpoint.remote`.
        config: The config of the run.
        run_id: The id of the run. Checkpoints of other runs are an error.
    """

    def __init__(self, location: str, config: Config, run_id: str) -> None:
        self._remote, self._run_id = RemoteCheckpoints(storage.canonical_path(location)), run_id
        self._folder, self._config = Path(config.run_dir), config.checkpoint
        self._thread: threading.Thread | None = None
        self._started_s = -float("inf")
        self._target: str | None = None  # the newest local checkpoint at the start of the current upload pass
        self._newest_uploaded: str | None = None  # the newest remote checkpoint
        self._uploaded_starts: bytes | None = None  # if the remote list of starts differs, a later start wrote it
        self._is_outage_reported = self._has_other_owner = self._is_ending = self._has_ended = False
        shutil.rmtree(self._folder / UPLOAD_LINKS, ignore_errors=True)  # links of a killed process

    def upload_if_due(self) -> None:
        """Start an upload pass if one is due and there is a new checkpoint, without waiting for it.

        The first checkpoint after a start is uploaded immediately.
        """
        is_due = time.monotonic() - self._started_s >= 60.0 * self._config.remote_every_minutes
        if is_due and not self.is_uploading and self._newest_local() != self._newest_uploaded:
            self._start_pass()

    @property
    def is_uploading(self) -> bool:
        """Whether an upload pass is in progress."""
        return self._thread is not None and self._thread.is_alive()

    def finish(self, is_stopping: Callable[[], bool]) -> None:
        """Upload the newest files and wait for the upload; warn if the remote copy is not up to date afterwards.

        Args:
            is_stopping: Returns whether the machine is about to stop. The wait is limited to
                `checkpoint.remote_wait_seconds` in this case, otherwise to an hour.
        """
        if self._has_ended:
            return
        self._is_ending = True
        started_s, limit_s = time.monotonic(), LONGEST_WAIT_S
        for is_last in (False, True):  # the current pass ends, or is cancelled if there is a newer checkpoint
            if is_last and not self.is_uploading:
                self._start_pass()
            while self._thread and self.is_uploading and time.monotonic() < started_s + limit_s:
                if limit_s == LONGEST_WAIT_S and is_stopping():
                    limit_s = time.monotonic() - started_s + self._config.remote_wait_seconds
                self._thread.join(_POLL_INTERVAL_S)
        in_time, self._has_ended = not self.is_uploading, True
        if not self._has_other_owner and not (in_time and self._newest_uploaded == self._newest_local()):
            text = (
                "%s contains checkpoints up to %s. Later checkpoints in %s are only on this machine%s. The next start"
            )
            text += " uploads them"
            newest = self._newest_uploaded or "those of earlier starts"
            reason = "" if in_time else ", because the time for uploads was over"
            logger.warning(text, self._remote.location, newest, self._folder / CHECKPOINTS, reason)

    def __enter__(self) -> Mirror:
        return self

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        if isinstance(error, Exception):
            self.finish(lambda: True)
        self._has_ended = True

    def _start_pass(self) -> None:
        self._started_s, self._target = time.monotonic(), self._newest_local()
        if not self._has_other_owner:
            self._thread = threading.Thread(target=self._run_pass, name="mirror", daemon=True)
            self._thread.start()

    def _run_pass(self) -> None:
        try:
            with suppress_retry_warnings():
                self._upload_pass()
            self._is_outage_reported = False
        except _CancelledError:
            pass
        except RemoteFolderTakenError as error:
            self._has_other_owner = True
            logger.warning("%s", error)
        except (UserError, OSError) as error:
            log = logger.info if self._is_outage_reported else logger.warning
            text = "%s is not up to date: %s. Training continues; next attempt in %g minutes"
            log(text, REMOTE_KEY, describe_upload_error(error), self._config.remote_every_minutes)
            self._is_outage_reported = True
        except Exception:  # no error here may stop the run
            logger.exception("%s: %s is not up to date; training continues", REMOTE_KEY, self._remote.location)
        finally:
            shutil.rmtree(self._folder / UPLOAD_LINKS, ignore_errors=True)

    def _cancel_if_outdated(self) -> None:
        """Cancel the upload pass if the mirror has ended, or is finishing and there is a newer checkpoint."""
        if self._has_ended or (self._is_ending and self._newest_local() != self._target):
            raise _CancelledError

    def _upload_pass(self) -> None:
        """Upload missing files: the small files of the run, the newest complete checkpoint, and the best one.

        Incomplete older checkpoints are removed before the upload, to free space. Complete ones beyond
        `checkpoint.keep` are removed afterwards.

        Raises:
            RemoteFolderTakenError: The remote folder belongs to another run, or another machine has resumed this run.
            UnreachableError: The remote folder cannot be reached.
            OSError: The run folder cannot be read, or links cannot be written into it.
        """
        remote = self._remote
        listing = remote.list_files()
        remote.find_owner(listing, self._run_id)
        path = storage.join(remote.location, ENVIRONMENT)
        with suppress(FileNotFoundError):  # two uploaders would overwrite each other's files
            if self._uploaded_starts is not None and storage.read_small_file(path, MAX_BYTES) != self._uploaded_starts:
                problem = f"{remote.location} is used by a later start of this run, {describe_last_start(path)}"
                fix = "This start continues without uploads. Stop one of the two"
                raise RemoteFolderTakenError(where=REMOTE_KEY, found=problem, fix=fix)
        names = [path.name for path in reversed(list_checkpoints(self._folder / CHECKPOINTS))]
        newest = next(filter(None, map(self._link_files, names)), None)
        if newest is None:
            return
        best = read_state_file(newest).best_name
        for name in sorted(listing.keys() - {*list_complete(listing), newest.name, best}):
            if step_number(name) < step_number(newest.name):
                self._cancel_if_outdated()
                remote.remove(name)
        self._upload_small_files()
        for checkpoint in (newest, self._link_files(best) if best and best != newest.name else None):
            if checkpoint is not None:
                remote.upload(checkpoint, listing.get(checkpoint.name, {}), self._cancel_if_outdated)
        for name in sorted({*list_complete(remote.list_files())[self._config.keep :]} - {newest.name, best}):
            self._cancel_if_outdated()
            remote.remove(name)
        self._newest_uploaded = newest.name

    def _upload_small_files(self) -> None:
        """Upload copies of the small files, because they may grow during the upload."""
        for name in SMALL_FILES:
            source, copy = self._folder / name, self._folder / UPLOAD_LINKS / name
            if source.is_file():
                self._cancel_if_outdated()
                shutil.copyfile(source, copy)
                storage.upload(copy, storage.join(self._remote.location, name))
                if name == ENVIRONMENT:
                    self._uploaded_starts = copy.read_bytes()

    def _link_files(self, name: str) -> Path | None:
        """Link the files of a checkpoint into a folder of the mirror, so that training may remove it during the upload.

        Returns None if the checkpoint is incomplete or is being removed.

        Raises:
            OSError: A complete checkpoint cannot be read.
        """
        source, links = self._folder / CHECKPOINTS / name, self._folder / UPLOAD_LINKS / name
        shutil.rmtree(links, ignore_errors=True)
        try:
            for file in (MANIFEST, *parse_manifest(storage.read_small_file(source / MANIFEST, MAX_BYTES))):
                (links / file).parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(source / file, links / file)
                except OSError:  # a file system without hard links
                    shutil.copyfile(source / file, links / file)
        except (FileNotFoundError, InputError):
            return None
        return links

    def _newest_local(self) -> str | None:
        return next((path.name for path in reversed(list_checkpoints(self._folder / CHECKPOINTS))), None)


def describe_upload_error(error: Exception) -> str:
    """Return the message of an upload error; with a fix only if the reason is permanent."""
    if isinstance(error, UnreachableError) and not isinstance(error, RefusedError):
        return f"{error.where}: {error.found}"
    return str(error).rstrip(".")
