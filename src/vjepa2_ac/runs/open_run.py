"""Open a run: check and lock its folder, and fetch a newer checkpoint from `checkpoint.remote`."""

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
    listed,
    newest_checkpoint,
    remove_leavings,
    written_state,
)
from vjepa2_ac.runs.folder import CONFIG, SMALL_FILES, RunLock, check_run_folder, open_run_folder, with_settled_values
from vjepa2_ac.runs.mirror import REMOTE_KEY, Mirror, RemoteCheckpoints, complete, reason_of, step_number
from vjepa2_ac.storage.retries import quietly

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class OpenRun:
    """A run that can begin or resume, in the process that writes its files."""

    config: Config  # with the stride that the run has chosen; its run_dir has the checkpoints to resume from
    lock: RunLock
    allow_config_change: bool

    def begin(self, config: Config, state: RunState) -> None:
        """Lock the folder, and record this start in it; a new folder is only created now.

        Args:
            config: The run; its stride is a number.
            state: The state that the run starts from.

        Raises:
            InputError: Another process trains in the folder, or has done so since it was inspected; or as
                `open_run_folder`.
        """
        self.lock.take()
        # Checkpoints up to this step were inspected when the run was resumed.
        later = [path for path in listed(Path(config.run_dir, CHECKPOINTS)) if step_number(path.name) > state.step]
        if newest := next((path for path in reversed(later) if find_damage(path) is None), None):
            there = f"a checkpoint of step {step_number(newest.name)}"
            found = f"{there}, which another start wrote while this one stood at {state.step}"
            raise InputError(where=str(newest), found=found, fix="Start again: the run continues from there")
        open_run_folder(config, state.run_id, allow_config_change=self.allow_config_change)

    def mirror(self, run_id: str) -> Mirror | None:
        """Return the mirror that keeps `checkpoint.remote` up to date; None: there is no remote."""
        place = self.config.checkpoint.remote
        return None if place is None else Mirror(place, self.config, run_id)


@contextlib.contextmanager
def open_run(
    config: Config, reporter: Reporter, *, check_only: bool = False, allow_config_change: bool = False
) -> Iterator[OpenRun]:
    """Check the folder of a run, fetch what is newer in `checkpoint.remote`, and hold the lock to the end of the block.

    Args:
        config: The run.
        reporter: Receives messages.
        check_only: Lock nothing, and download into a temporary folder.
        allow_config_change: The run in the folder may have another config.

    Raises:
        InputError: The folder is not this run's, is in use or cannot be written; or as `open_remote`.
    """
    config, trial = with_settled_values(config), None
    check_run_folder(config, allow_config_change=allow_config_change)
    with contextlib.ExitStack() as exit_stack:
        lock = exit_stack.enter_context(RunLock(Path(config.run_dir)))
        if check_only:
            trial = Path(exit_stack.enter_context(tempfile.TemporaryDirectory()), "run")
        elif Path(config.run_dir).is_dir():  # a new one is created, and locked, after all checks
            lock.take()
        # Locked before anything is downloaded into the run's folder: another process could still be writing there.
        first = None if check_only else lock
        config = open_remote(config, reporter, lock=first, allow_config_change=allow_config_change, into=trial)
        yield OpenRun(with_settled_values(config), lock, allow_config_change)


def open_remote(
    config: Config,
    reporter: Reporter,
    *,
    lock: RunLock | None = None,
    allow_config_change: bool = False,
    into: Path | None = None,
) -> Config:
    """Test `checkpoint.remote` if it is set, fetch a newer checkpoint from there, and return the config to use.

    The test writes a small file there and removes it again. This fetches the newest checkpoint whose files all
    match its manifest, the best checkpoint, and the run's small files. Damaged checkpoints are reported and
    skipped, and removed there after a complete one was fetched. A place that cannot be reached is a warning, unless
    this machine has no checkpoint and the place is known to have some, complete or not.

    Args:
        config: The run.
        reporter: Receives messages for the user.
        lock: The lock to take before the first file is fetched.
        allow_config_change: The config of the run there may differ.
        into: The folder to fetch into, new or empty, if not the run's own: for a trial, which removes nothing there.

    Returns:
        The config, whose run_dir has the run to resume.

    Raises:
        InputError: This user may not write there; the checkpoints there are of another run, or have another config;
            they are damaged and this machine has none to resume from; or another process has the lock.
        UnreachableError: A checkpoint there cannot be fetched, and this machine has none to resume from.
    """
    if config.checkpoint.remote is None:
        return config
    place, run_dir = storage.absolute(config.checkpoint.remote), Path(config.run_dir).resolve()
    if not storage.is_url(place) and Path(place).is_relative_to(run_dir):
        found, needed = f"{place}, and run_dir is {run_dir}", "a place outside the run's folder"
        fix = "Set checkpoint.remote to a folder on another disk, or a URL such as gs://bucket/run"
        raise InputError(where=REMOTE_KEY, found=found, needed=needed, fix=fix)
    state = None
    with suppress(InputError):  # no local checkpoint is complete: a remote one may be
        newest = newest_checkpoint(run_dir / CHECKPOINTS)
        state = None if newest is None else written_state(newest)
    remote, newer = RemoteCheckpoints(place), list[str]()
    owner: str | None = None
    try:
        with quietly():
            storage.try_writing(place)
            listing = remote.listing()
            owner = remote.owner(listing, None if state is None else state.run_id)
        minutes = config.checkpoint.remote_every_minutes
        reporter.note(f"{place} can be written: it is brought up to date every {minutes:g} minutes, and in the end.")
        newer = [name for name in complete(listing) if state is None or step_number(name) > state.step]
        if not newer and (state is not None or owner is None):
            return config
        # If an owner but no complete checkpoint is there, a machine was killed during its first upload.
        target = config if into is None else config.model_copy(update={"run_dir": str(into)})
        _require_this_config(target, place, allow_config_change=allow_config_change)
        if lock is not None:
            lock.take()
        is_fetched = _fetch_newest(remote, newer, Path(target.run_dir), reporter, removes_damaged=into is None)
    except RefusedError as error:
        fix = f"{error.fix.rstrip('.')}. Or name another place, or leave checkpoint.remote out"
        raise InputError(where=REMOTE_KEY, found=f"{error.where}: {error.found}", fix=fix) from error
    except UnreachableError as error:
        if state is None and (newer or owner is not None):  # a run is there: a new one could not be mirrored there
            raise
        stand = f"after step {state.step}" if state else "without a checkpoint"
        there = f", though {newer[0]} is there" if newer else ""
        text = "%s: %s. Training begins with what is on this machine, %s%s, and tries again later"
        logger.warning(text, REMOTE_KEY, reason_of(error), stand, there)
        return config
    if is_fetched or state is not None:
        return target if is_fetched else config
    found = f"{place}: none of {counted(len(newer), 'checkpoint')} is whole"
    fix = "To start the run again from step 0, remove them, or set another checkpoint.remote"
    raise InputError(where=REMOTE_KEY, found=found, fix=fix)


def _require_this_config(config: Config, place: str, *, allow_config_change: bool) -> None:
    """Refuse a run at the place whose config differs, as for a local folder."""
    with tempfile.TemporaryDirectory() as folder:
        with suppress(FileNotFoundError):
            storage.download(storage.join(place, CONFIG), Path(folder, CONFIG))
        try:
            there = with_settled_values(config.model_copy(update={"run_dir": folder}))
            check_run_folder(there, allow_config_change=allow_config_change)
        except InputError as error:
            fix = "Set another checkpoint.remote for a new run; where the change is meant, add --allow-config-change"
            raise InputError(where=f"{REMOTE_KEY} {place}", found=error.found, needed=error.needed, fix=fix) from None


def _fetch_newest(
    remote: RemoteCheckpoints, names: Sequence[str], folder: Path, reporter: Reporter, *, removes_damaged: bool
) -> bool:
    """Download a run into its folder, with the first of these checkpoints (the newest first) that is complete.

    The checkpoint comes last, so that an interrupted download starts again. Returns False if all are damaged.
    """
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
    return not names


def _fetch(remote: RemoteCheckpoints, name: str, checkpoints: Path) -> bool:
    """Download a checkpoint, after the best one that it names; return False, with a warning, if it is damaged."""
    fetched, final = checkpoints / f"{FETCHING}{name}", checkpoints / name
    if problem := remote.fetch(name, fetched):
        shutil.rmtree(fetched)
        logger.warning("%s: %s: %s; skipped", remote.place, name, problem)
        return False
    best = written_state(fetched).best_name
    if best is not None and best != name and not (checkpoints / best).is_dir():
        _fetch(remote, best, checkpoints)
    shutil.rmtree(final, ignore_errors=True)  # a damaged local one
    fetched.rename(final)
    storage.sync(checkpoints)
    return True
