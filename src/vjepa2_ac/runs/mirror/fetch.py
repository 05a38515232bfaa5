"""Download of a run from `checkpoint.remote`, to resume it on this machine.

Fetched is the newest checkpoint there whose every file matches its manifest; damaged ones are named and skipped. The
best one is fetched, too, and the run's small files. The checkpoint comes last, so that an interrupted download starts
again.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import FETCHING, remove_leavings, written_state
from vjepa2_ac.runs.folder import CHECKPOINTS, check_run_folder, with_settled_stride
from vjepa2_ac.runs.mirror.remote_checkpoints import RemoteCheckpoints
from vjepa2_ac.runs.mirror.upload import SMALL_FILES
from vjepa2_ac.storage import download, join, sync, write_atomically

logger = logging.getLogger(__name__)


def fetch_newest(
    remote: RemoteCheckpoints,
    names: Sequence[str],
    config: Config,
    reporter: Reporter,
    *,
    claim: Callable[[], None],
    allow_config_change: bool = False,
) -> list[str]:
    """Download a run into `run_dir`, with the first of its checkpoints that is complete.

    Args:
        remote: Where it is.
        names: Its checkpoints that are newer than this machine's, the newest first.
        config: The run.
        reporter: Receives messages for the user.
        claim: Called before the first file is written; raises if the folder belongs to another run.
        allow_config_change: The run there may have another config.

    Returns:
        The damaged checkpoints; all of `names` if none is complete.

    Raises:
        InputError: The run there has another config; nothing is downloaded then.
        UnreachableError: The place cannot be reached.
    """
    folder, damaged = Path(config.run_dir), []
    with tempfile.TemporaryDirectory() as temporary:
        small = Path(temporary)
        for name in SMALL_FILES:
            with suppress(FileNotFoundError):
                download(join(remote.place, name), small / name)
        _require_this_config(config, small, remote.place, allow_config_change=allow_config_change)
        claim()
        for name in SMALL_FILES:  # config.yaml first: without it the folder would be no run's
            if (small / name).is_file():
                write_atomically(folder / name, (small / name).read_bytes())
    remove_leavings(folder / CHECKPOINTS)
    for name in names:
        fetched = _fetch(remote, name, folder, name)
        if fetched is not None:
            _fetch_best(remote, fetched, folder)
            _give_name(fetched, folder / CHECKPOINTS / name)
            reporter.note(f"Fetched {name} from {remote.place}.")
            break
        damaged.append(name)
    return damaged


def _require_this_config(config: Config, fetched: Path, place: str, *, allow_config_change: bool) -> None:
    """Check that the run there is the requested one, as for a local folder."""
    try:
        there = with_settled_stride(config.model_copy(update={"run_dir": str(fetched)}))
        check_run_folder(there, allow_config_change=allow_config_change)
    except InputError as error:
        fix = "Set another checkpoint.remote for a new run; where the change is meant, add --allow-config-change"
        where = f"checkpoint.remote {place}"
        raise InputError(where=where, found=error.found, needed=error.needed, fix=fix) from None


def _fetch(remote: RemoteCheckpoints, name: str, folder: Path, described: str) -> Path | None:
    """Download a checkpoint under a temporary name; None, and a warning, if it is damaged."""
    fetched = folder / CHECKPOINTS / f"{FETCHING}{name}"
    problem = remote.fetch(name, fetched)
    if problem is None:
        return fetched
    shutil.rmtree(fetched)
    logger.warning("%s: %s: %s; passed over", remote.place, described, problem)
    return None


def _fetch_best(remote: RemoteCheckpoints, newest: Path, folder: Path) -> None:
    """Download the best checkpoint, if the newest names one that exists there and not on this machine."""
    name = written_state(newest).best_name
    if name is None or newest.name == f"{FETCHING}{name}" or (folder / CHECKPOINTS / name).is_dir():
        return
    fetched = _fetch(remote, name, folder, f"the best checkpoint, {name}")
    if fetched is not None:
        _give_name(fetched, folder / CHECKPOINTS / name)


def _give_name(fetched: Path, name: Path) -> None:
    if name.is_dir():  # a damaged local one
        shutil.rmtree(name)
    fetched.rename(name)
    sync(name.parent)
