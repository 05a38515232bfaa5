"""Open a run: check and lock its folder, and download a newer checkpoint from `checkpoint.remote`."""

from __future__ import annotations

import contextlib
import logging
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError, counted
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import (
    CHECKPOINTS,
    FETCHING,
    RunState,
    find_damage,
    list_checkpoints,
    newest_checkpoint,
    read_state_file,
    remove_incomplete,
)
from vjepa2_ac.runs.folder import CONFIG, SMALL_FILES, RunLock, check_run_folder, open_run_folder, with_values_of_run
from vjepa2_ac.runs.mirror import (
    REMOTE_KEY,
    Mirror,
    RemoteCheckpoints,
    describe_upload_error,
    list_complete,
    step_number,
)
from vjepa2_ac.storage.retries import suppress_retry_warnings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class OpenRun:
    """A run that is ready to start or resume, in the process that writes its files."""

    config: Config  # with the calibrated stride; its run_dir contains the checkpoints to resume from
    lock: RunLock
    allow_config_change: bool

    def begin(self, config: Config, state: RunState) -> None:
        """Lock the run folder and record this start in it. A new folder is created here, not earlier.

        Args:
            config: The config of the run; its stride is a number.
            state: The state from which the run starts.

        Raises:
            InputError: Another process trains in the folder, or has written a later checkpoint; or see
                `open_run_folder`.
        """
        self.lock.take()
        checkpoints = list_checkpoints(Path(config.run_dir, CHECKPOINTS))
        later = [path for path in checkpoints if step_number(path.name) > state.step]
        if newest := next((path for path in reversed(later) if find_damage(path) is None), None):
            problem = f"a checkpoint of step {step_number(newest.name)} from another start; this start is at step"
            problem += f" {state.step}"
            raise InputError(where=str(newest), found=problem, fix="Run the same command again to resume from it")
        open_run_folder(config, state.run_id, allow_config_change=self.allow_config_change)

    def mirror(self, run_id: str) -> Mirror | None:
        """Return the mirror that keeps `checkpoint.remote` up to date; None if that is not set."""
        location = self.config.checkpoint.remote
        return None if location is None else Mirror(location, self.config, run_id)


@contextlib.contextmanager
def open_run(
    config: Config, reporter: Reporter, *, check_only: bool = False, allow_config_change: bool = False
) -> Iterator[OpenRun]:
    """Check the run folder, download a newer checkpoint from `checkpoint.remote`, and hold the lock during the block.

    Args:
        config: The config of the run.
        reporter: Receives messages.
        check_only: Lock nothing, and download into a temporary folder.
        allow_config_change: Accept that the run in the folder has another config.

    Raises:
        InputError: The folder belongs to another run, is in use or is not writable; or see `open_remote`.
    """
    config, check_folder = with_values_of_run(config), None
    check_run_folder(config, allow_config_change=allow_config_change)
    with contextlib.ExitStack() as exit_stack:
        lock = exit_stack.enter_context(RunLock(Path(config.run_dir)))
        if check_only:
            check_folder = Path(exit_stack.enter_context(tempfile.TemporaryDirectory()), "run")
        elif Path(config.run_dir).is_dir():  # a new folder is created and locked after all checks
            lock.take()
        # The lock is acquired before a download into the run folder: another process could still be writing there.
        lock_to_take = None if check_only else lock
        config = open_remote(
            config, reporter, lock=lock_to_take, allow_config_change=allow_config_change, into=check_folder
        )
        yield OpenRun(with_values_of_run(config), lock, allow_config_change)


def open_remote(
    config: Config,
    reporter: Reporter,
    *,
    lock: RunLock | None = None,
    allow_config_change: bool = False,
    into: Path | None = None,
) -> Config:
    """Test access to `checkpoint.remote` if it is set, download a newer checkpoint, and return the config to use.

    The test writes a small remote file and removes it again. The download contains the newest undamaged checkpoint, the
    best checkpoint, and the small files of the run. Damaged checkpoints are reported and skipped, and removed after the
    download. A remote folder that cannot be reached causes a warning, or an error if this machine has no checkpoint and
    the remote folder is known to contain some.

    Args:
        config: The config of the run.
        reporter: Receives messages for the user.
        lock: The lock to acquire before the first download.
        allow_config_change: Accept that the remote run has another config.
        into: A new or empty folder for the download instead of the run folder; nothing is removed remotely then.

    Returns:
        The config, whose run_dir contains the run to resume.

    Raises:
        InputError: The remote folder is not writable; its checkpoints belong to another run or config, or are damaged
            while this machine has none; or another process holds the lock.
        UnreachableError: A remote checkpoint cannot be downloaded, and this machine has none.
    """
    if config.checkpoint.remote is None:
        return config
    location, run_dir = storage.canonical_path(config.checkpoint.remote), Path(config.run_dir).resolve()
    if not storage.is_url(location) and Path(location).is_relative_to(run_dir):
        problem, needed = f"{location}, and run_dir is {run_dir}", "a folder outside run_dir"
        fix = "Set checkpoint.remote to a folder on another disk, or a URL such as gs://bucket/run"
        raise InputError(where=REMOTE_KEY, found=problem, needed=needed, fix=fix)
    state = None
    with suppress(InputError):  # all local checkpoints are damaged, but a remote one may be complete
        newest = newest_checkpoint(run_dir / CHECKPOINTS)
        state = None if newest is None else read_state_file(newest)
    remote, newer = RemoteCheckpoints(location), list[str]()
    owner: str | None = None
    try:
        with suppress_retry_warnings():
            storage.check_writable(location)
            listing = remote.list_files()
            owner = remote.find_owner(listing, None if state is None else state.run_id)
        minutes = config.checkpoint.remote_every_minutes
        reporter.note(f"{location} is writable. It is updated every {minutes:g} minutes, and at the end of the run.")
        newer = [name for name in list_complete(listing) if state is None or step_number(name) > state.step]
        if not newer and (state is not None or owner is None):
            return config
        # An owner without a complete checkpoint means that a machine was killed during its first upload.
        target = config if into is None else config.model_copy(update={"run_dir": str(into)})
        _require_same_config(target, location, allow_config_change=allow_config_change)
        if lock is not None:
            lock.take()
        is_fetched = _fetch_newest(remote, newer, Path(target.run_dir), reporter, removes_damaged=into is None)
    except RefusedError as error:
        fix = f"{error.fix.rstrip('.')}. Or set another checkpoint.remote, or remove it"
        raise InputError(where=REMOTE_KEY, found=f"{error.where}: {error.found}", fix=fix) from error
    except UnreachableError as error:
        if state is None and (newer or owner is not None):  # a new run could not use the remote folder of another run
            raise
        local_state = f"step {state.step}" if state else "no checkpoint"
        newer_remote = f"; {newer[0]} is newer" if newer else ""
        text = "%s: %s. Training starts from the state on this machine (%s%s). Uploads are tried again later"
        logger.warning(text, REMOTE_KEY, describe_upload_error(error), local_state, newer_remote)
        return config
    if is_fetched or state is not None:
        return target if is_fetched else config
    problem = f"{location}: none of {counted(len(newer), 'checkpoint')} is complete"
    fix = "To start the run again from step 0, remove them, or set another checkpoint.remote"
    raise InputError(where=REMOTE_KEY, found=problem, fix=fix)


def _require_same_config(config: Config, location: str, *, allow_config_change: bool) -> None:
    """Refuse a remote run whose config differs, as for a local run folder."""
    with tempfile.TemporaryDirectory() as folder:
        with suppress(FileNotFoundError):
            storage.download(storage.join(location, CONFIG), Path(folder, CONFIG))
        try:
            remote_config = with_values_of_run(config.model_copy(update={"run_dir": folder}))
            check_run_folder(remote_config, allow_config_change=allow_config_change)
        except InputError as error:
            fix = "Set another checkpoint.remote for a new run. To resume with the changed"
            fix += " config, add --allow-config-change"
            raise InputError(
                where=f"{REMOTE_KEY} {location}", found=error.found, needed=error.needed, fix=fix
            ) from None


def _fetch_newest(
    remote: RemoteCheckpoints, names: Sequence[str], folder: Path, reporter: Reporter, *, removes_damaged: bool
) -> bool:
    """Download the small files of a run, and the first checkpoint in `names` that is complete.

    The checkpoint is downloaded last, so that an interrupted download starts again. Returns False if all are damaged.
    """
    for name in SMALL_FILES:  # config.yaml first, because it marks a run folder
        with suppress(FileNotFoundError):
            storage.download(storage.join(remote.location, name), folder / name)
    remove_incomplete(folder / CHECKPOINTS)
    for number, name in enumerate(names):
        if _fetch(remote, name, folder / CHECKPOINTS):
            reporter.note(f"Downloaded {name} from {remote.location}.")
            with suppress(UnreachableError):
                for damaged in names[:number] if removes_damaged else ():
                    remote.remove(damaged)
            return True
    return not names


def _fetch(remote: RemoteCheckpoints, name: str, checkpoints: Path) -> bool:
    """Download a checkpoint and the best checkpoint that it names; return False, with a warning, if it is damaged."""
    fetched, final = checkpoints / f"{FETCHING}{name}", checkpoints / name
    if problem := remote.download(name, fetched):
        shutil.rmtree(fetched)
        logger.warning("%s: %s: %s; skipped", remote.location, name, problem)
        return False
    best = read_state_file(fetched).best_name
    if best is not None and best != name and not (checkpoints / best).is_dir():
        _fetch(remote, best, checkpoints)
    shutil.rmtree(final, ignore_errors=True)  # a damaged local checkpoint
    fetched.rename(final)
    storage.sync(checkpoints)
    return True
