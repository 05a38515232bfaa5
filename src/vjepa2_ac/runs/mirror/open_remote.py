"""Preparation of `checkpoint.remote` before a run's first step: test it, check its owner, and resume from it.

A place that cannot be reached is a warning. A place that can never be written, or is another run's, is an error.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import (
    CHECKPOINTS,
    FETCHING,
    newest_checkpoint,
    remove_leavings,
    step_of,
    written_state,
)
from vjepa2_ac.runs.folder import CONFIG, check_run_folder, with_settled_stride
from vjepa2_ac.runs.mirror.background_sync import Mirror, reason_of
from vjepa2_ac.runs.mirror.remote_checkpoints import Listing, RemoteCheckpoints, complete
from vjepa2_ac.runs.mirror.upload import SMALL_FILES, RemoteUpdate
from vjepa2_ac.storage import absolute, download, is_url, join, sync, try_writing
from vjepa2_ac.storage.retries import quietly

logger = logging.getLogger(__name__)

_KNOB = "checkpoint.remote"


@dataclass(frozen=True)
class Remote:
    """State of `checkpoint.remote` before the first step."""

    place: str
    config: Config  # its run_dir has the run to resume
    is_reachable: bool = True
    damaged: tuple[str, ...] = ()  # checkpoints there

    def mirror(self, run_id: str) -> Mirror:
        """Return the mirror that keeps the place up to date."""
        folder, checkpoint = Path(self.config.run_dir), self.config.checkpoint
        update = RemoteUpdate(RemoteCheckpoints(self.place), folder, run_id, checkpoint.keep, self.damaged)
        return Mirror(update, checkpoint, outage_reported=not self.is_reachable)


def open_remote(
    config: Config,
    reporter: Reporter,
    *,
    claim: Callable[[], None] = lambda: None,
    allow_config_change: bool = False,
    into: Path | None = None,
) -> Remote | None:
    """Test `checkpoint.remote`, and fetch a newer checkpoint from there; None if it is not set.

    A small file is written there and removed again. Fetched is the newest checkpoint there whose every file matches
    its manifest, the best one, and the run's small files; damaged ones are named and skipped.

    Args:
        config: The run.
        reporter: Receives messages for the user.
        claim: Called before the first file is fetched; raises if the folder belongs to another run.
        allow_config_change: The run there may have another config.
        into: The folder to fetch into, new or empty, if not the run's own.

    Raises:
        InputError: It can never be written, it has another run's checkpoints or another config, or its checkpoints are
            damaged or cannot be fetched and this machine has none to resume from.
    """
    if config.checkpoint.remote is None:
        return None
    remote = Remote(absolute(config.checkpoint.remote), config)
    _refuse_own_folder(remote.place, Path(config.run_dir))
    step, run_id = _where_this_machine_stands(Path(config.run_dir))
    checkpoints = RemoteCheckpoints(remote.place)
    try:
        with quietly():
            listing, owner = _look(checkpoints, run_id)
    except UnreachableError as error:
        stand = "without a checkpoint" if step is None else f"after step {step}"
        _warn(f"{reason_of(error)}. Training begins with what is on this machine, {stand}, and tries again later")
        return replace(remote, is_reachable=False)
    minutes = config.checkpoint.remote_every_minutes
    reporter.note(f"{remote.place} can be written: it is brought up to date every {minutes:g} minutes, and in the end.")
    further = [name for name in complete(listing) if step is None or (step_of(name) or 0) > step]
    is_begun_there = step is None and owner is not None  # a machine was killed during its first upload or before
    if not further and not is_begun_there:
        return remote
    target = config if into is None else config.model_copy(update={"run_dir": str(into)})
    try:
        damaged = _fetch_newest(
            checkpoints, further, target, reporter, claim=claim, allow_config_change=allow_config_change
        )
    except UnreachableError as error:
        if step is None:
            raise
        _warn(f"{reason_of(error)}. Training goes on after step {step}, though {further[0]} is there")
        return remote
    if further and damaged == further:
        if step is None:
            found = f"{remote.place}: none of {len(damaged)} checkpoints is whole"
            fix = "To start the run anew, remove them, or set another checkpoint.remote"
            raise InputError(where=_KNOB, found=found, fix=fix)
        return replace(remote, damaged=tuple(damaged))
    return replace(remote, config=target, damaged=tuple(damaged))


def _look(checkpoints: RemoteCheckpoints, run_id: str | None) -> tuple[Listing, str | None]:
    """Return the checkpoints there and our run id, as far as known, after checking that the place is writable and ours.

    Raises:
        InputError: It can never be written, or holds checkpoints of another run.
        UnreachableError: It cannot be reached now.
    """
    try:
        try_writing(checkpoints.place)
        listing = checkpoints.listing()
        owner = _refuse_foreign(checkpoints, listing, run_id)
    except RefusedError as error:
        found, needed = f"{checkpoints.place}: {error.found}", "a place where files can be written and removed"
        fix = f"{error.fix.rstrip('.')}. Or name another place, or leave checkpoint.remote out"
        raise InputError(where=_KNOB, found=found, needed=needed, fix=fix) from error
    return listing, owner


def _refuse_foreign(checkpoints: RemoteCheckpoints, listing: Listing, run_id: str | None) -> str | None:
    """Refuse checkpoints, also incomplete ones, of several runs or of another run than ours; return the run."""
    for name in sorted(listing, reverse=True):
        owner = checkpoints.run_id(name)
        run_id = owner if run_id is None else run_id
        if owner is not None and owner != run_id:
            found = f"{checkpoints.place} holds a checkpoint of another run, {name}"
            fix = "Set another checkpoint.remote; nothing was written there"
            raise InputError(where=_KNOB, found=found, needed="an empty place, or the one of this run", fix=fix)
    return run_id


def _refuse_own_folder(remote: str, run_dir: Path) -> None:
    own = run_dir.resolve()
    if not is_url(remote) and (Path(remote) == own or own in Path(remote).parents):
        found, needed = f"{remote}, and run_dir is {own}", "a place outside the run's folder"
        fix = "Set checkpoint.remote to a folder on another disk, or a URL such as gs://bucket/run"
        raise InputError(where=_KNOB, found=found, needed=needed, fix=fix)


def _where_this_machine_stands(run_dir: Path) -> tuple[int | None, str | None]:
    """Return step and run of the newest complete local checkpoint."""
    with suppress(InputError):  # none is complete: a remote one may be
        if (checkpoint := newest_checkpoint(run_dir / CHECKPOINTS)) is not None:
            state = written_state(checkpoint)
            return state.step, state.run_id
    return None, None


def _warn(text: str) -> None:
    logger.warning("%s: %s", _KNOB, text)


def _fetch_newest(
    remote: RemoteCheckpoints,
    names: Sequence[str],
    config: Config,
    reporter: Reporter,
    *,
    claim: Callable[[], None],
    allow_config_change: bool = False,
) -> list[str]:
    """Download a run into `run_dir`, with the first of these checkpoints (the newest first) that is complete.

    Of all it fetches, the checkpoint comes last, so that an interrupted download starts again.

    Returns:
        The damaged checkpoints; all of `names` if none is complete.

    Raises:
        InputError: The run there has another config; nothing is downloaded then.
        UnreachableError: The place cannot be reached.
    """
    folder, checkpoints = Path(config.run_dir), Path(config.run_dir, CHECKPOINTS)
    _require_this_config(config, remote.place, allow_config_change=allow_config_change)
    claim()
    for name in SMALL_FILES:  # config.yaml first: without it the folder would be no run's
        with suppress(FileNotFoundError):
            download(join(remote.place, name), folder / name)
    remove_leavings(checkpoints)
    for number, name in enumerate(names):
        if _fetch(remote, name, checkpoints):
            reporter.note(f"Fetched {name} from {remote.place}.")
            return list(names[:number])
    return list(names)


def _require_this_config(config: Config, place: str, *, allow_config_change: bool) -> None:
    """Check that the run there is the requested one, as for a local folder."""
    with tempfile.TemporaryDirectory() as folder:
        with suppress(FileNotFoundError):
            download(join(place, CONFIG), Path(folder, CONFIG))
        try:
            there = with_settled_stride(config.model_copy(update={"run_dir": folder}))
            check_run_folder(there, allow_config_change=allow_config_change)
        except InputError as error:
            fix = "Set another checkpoint.remote for a new run; where the change is meant, add --allow-config-change"
            where = f"checkpoint.remote {place}"
            raise InputError(where=where, found=error.found, needed=error.needed, fix=fix) from None


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
    sync(checkpoints)
    return True
