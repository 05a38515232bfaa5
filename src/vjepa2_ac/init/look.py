"""Which form of data is there, and what is in it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.data.sources.lerobot.info import INFO
from vjepa2_ac.errors import InputError
from vjepa2_ac.init.converters import way_by
from vjepa2_ac.init.found import FoundData
from vjepa2_ac.init.of_lerobot import look_at_lerobot
from vjepa2_ac.init.of_npz import look_at_npz
from vjepa2_ac.init.of_raw import look_at_raw
from vjepa2_ac.init.of_rlds import droid, like_droid, look_at_rlds

LOOKS: dict[str, Callable[[str], FoundData]] = {
    "rlds": look_at_rlds,
    "lerobot": look_at_lerobot,
    "npz": look_at_npz,
    "raw": look_at_raw,
}
_BY_HAND = "write one .npz for each episode (docs/data.md)"
_WAYS = {  # to what is read, by the end of a file's name
    ".mcap": f"a ROS 2 bag. {way_by('ros2_bag')} makes .npz of it",
    ".db3": f"a ROS 2 bag. {way_by('ros2_bag')} makes .npz of it",
    ".bag": f"a ROS 1 bag. {way_by('ros2_bag')} makes .npz of it",
    ".lance": f"LeRobot's tables in Lance. {way_by('lance_to_files')} makes files of them",
    ".mp4": f"videos alone. {way_by('mp4_and_csv')} makes .npz of videos and poses",
    ".hdf5": f"HDF5: {_BY_HAND}",
    ".h5": f"HDF5: {_BY_HAND}",
    ".zarr": f"Zarr: {_BY_HAND}",
}
_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
_DEEPEST = 2  # folders down, where a description may be


def look_at(path: str, form: str | None = None) -> FoundData:
    """Look at a data set.

    Args:
        path: A folder, or a URL.
        form: rlds, lerobot, npz or raw; None: recognized by its files.

    Raises:
        InputError: There is nothing of that kind; says what is there, and the way to what is read.
        UnreachableError: It cannot be read.
    """
    if path == droid().path:
        return droid()
    if not storage.is_url(path) and not Path(path).is_dir():
        fix = f"For a data set of the Hugging Face Hub: hf://datasets/{path}" if _HUB_NAME.fullmatch(path) else ""
        raise InputError(where=path, found="no such folder", needed="a folder, or a URL", fix=fix)
    try:
        form, root = (form, _root_of(path, form)) if form else _recognized(path)
        return LOOKS[form](root)
    except OSError as error:
        raise storage.unreadable(path, error) from None


def simulated(path: str) -> FoundData:
    """Return what `vjepa2-ac simulate record` will make."""
    return replace(
        like_droid(path, episodes=60, is_simulated=True),
        steps=60 * 41,
        usual_steps=41,
        short_steps=41,
        about=("60 episodes of the simulated arm, to be recorded",),
    )


def _root_of(path: str, form: str) -> str:
    """Return the folder with the description of a form, at or below a path; the path itself, where none is found."""
    marks = {"rlds": "dataset_info.json", "lerobot": INFO}
    return next(_with_file(path, marks[form], _DEEPEST), path) if form in marks else path


def _with_file(folder: str, name: str, deepest: int) -> Iterator[str]:
    """Yield the folders, at a path and below it, that have a file."""
    if storage.exists(storage.join(folder, name)):
        yield folder
    elif deepest:
        for inner in sorted(storage.list_names(folder), reverse=True)[:20]:  # the newest version first
            if "." not in inner or re.fullmatch(r"[\d.]+", inner):
                yield from _with_file(storage.join(folder, inner), name, deepest - 1)


def _recognized(path: str) -> tuple[str, str]:
    for form, mark in (("lerobot", INFO), ("rlds", "dataset_info.json")):
        if found := next(_with_file(path, mark, _DEEPEST), None):
            return form, found
    names = _names_below(path)
    if any(name.endswith(".npz") for name in names):
        return "npz", path
    if any(name == "trajectory.h5" or name.startswith("metadata_") for name in names):
        return "raw", path
    way = next((text for end, text in _WAYS.items() for name in names if name.lower().endswith(end)), "")
    shown = ", ".join(names[:5]) + (", …" if len(names) > 5 else "")
    raise InputError(
        where=path,
        found=f"nothing that is read ({shown or 'an empty folder'})",
        needed="LeRobot (meta/info.json), RLDS (dataset_info.json), .npz files, or raw DROID (trajectory.h5)",
        fix=f"This looks like {way}" if way else "docs/data.md says how other data become one of these",
    )


def _names_below(path: str) -> list[str]:
    """Return names of files at a path and a few folders down, of the first folder of each."""
    names: list[str] = []
    for _ in range(5):
        here = storage.list_names(path)
        names += here
        inner = next((name for name in sorted(here) if "." not in name), None)
        if inner is None:
            break
        path = storage.join(path, inner)
    return names
