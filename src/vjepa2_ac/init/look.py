"""Recognise the form of a data set and read its properties: cameras, columns, rates and lengths of episodes."""

from __future__ import annotations

import ast
import importlib.resources
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.loading import admit_forms_of_data, parse_config
from vjepa2_ac.data.files import in_parallel, walk
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.selection import describe_splits, held_out_by
from vjepa2_ac.data.sources.droid_raw import find_episodes
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.data.sources.lerobot_meta import INFO
from vjepa2_ac.data.sources.npz import FORMAT_HELP, opened_npz
from vjepa2_ac.episode import STATE_DIM, Progress
from vjepa2_ac.errors import InputError, UserError, counted, shell_command
from vjepa2_ac.init.described import droid, like_droid, look_at_lerobot, look_at_rlds
from vjepa2_ac.init.found import FoundData, Knob, idle_rule, pick_camera, plain
from vjepa2_ac.storage.paths import BUILTIN

_CONNECTIONS = 16  # number of parallel reads
_CONVERTERS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "convert"


def converters() -> dict[str, str]:
    """Return the description of each converter script, by name."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_CONVERTERS.glob("*.py"))}
    return {name: (ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0] for name, text in texts.items()}


def converter_text(name: str) -> str:
    """Return the source text of a converter script.

    Raises:
        InputError: There is no converter with this name.
    """
    if name not in converters():
        needed = f"one of {', '.join(converters())}"
        raise InputError(where="command line", found=f"no converter {name}", needed=needed)
    return (_CONVERTERS / f"{name}.py").read_text(encoding="utf-8")


def way_by(name: str) -> str:
    """Return the commands with which a user starts with a converter script."""
    return f"`vjepa2-ac data converter {name} > {name}.py`, then `python {name}.py --help`"


def look_at_npz(path: str) -> FoundData:
    """Read the properties of a folder of .npz files from the first file.

    Raises:
        InputError: There are no .npz files, or the first one has no states, no rate or no frames.
    """
    listed = [storage.join(folder, file.name) for folder, file in walk(path, _CONNECTIONS)]
    files = sorted(name for name in listed if name.endswith(".npz"))
    if not files:
        raise InputError(where=path, found="no .npz files", needed="one for each episode", fix=FORMAT_HELP)
    where = storage.join(path, files[0])
    with opened_npz(where, where) as file:
        headers = {name: file.header(name) for name in file.names}
        missing = [name for name in ("states", "fps_hz") if name not in headers]
        cameras = [name for name, array in headers.items() if array.dtype == np.uint8 and len(array.shape) == 4]
        if missing or not cameras or len(headers["states"].shape) != 2:
            arrays = ", ".join(f"{name} {list(array.shape)} {array.dtype}" for name, array in headers.items())
            needed = "states [steps, 7], fps_hz and frames [steps, height, width, 3] of uint8"
            raise InputError(where=where, found=arrays or "no arrays", needed=needed, fix=FORMAT_HELP)
        rate = float(np.asarray(file.array("fps_hz")).reshape(-1)[0])
    steps, width = headers["states"].shape
    first = "frames" if "frames" in cameras else pick_camera(cameras)
    is_pose = width == STATE_DIM
    return FoundData(
        source="npz",
        path=path,
        knobs={"camera": Knob(first, f"of {', '.join(cameras)}" if len(cameras) > 1 else "", len(cameras) > 1)},
        rate_hz=Knob(rate, f"of {files[0]}"),
        states="pose" if is_pose else "vector",
        episodes=len(files),
        idle=idle_rule(has_velocities="joint_velocities" in headers) if is_pose else None,
        about=(f".npz, {counted(len(files), 'episode')} at {rate:g} a second, the first of {counted(steps, 'step')}",),
    )


def look_at_raw(path: str) -> FoundData:
    """Return the properties of raw DROID data. Behind a URL the episodes are not counted, because that is slow.

    Raises:
        InputError: There are no episodes.
    """
    is_remote = storage.is_url(path)
    episodes = None if is_remote else len(find_episodes(path, _CONNECTIONS))
    if episodes == 0:
        raise InputError(where=path, found="no episode", needed="folders with trajectory.h5 and metadata_*.json")
    size = "behind a URL" if episodes is None else counted(episodes, "episode")
    return FoundData(
        source="droid_raw",
        path=path,
        knobs={"camera": Knob("left", "what the released weights saw; or right, wrist, a serial number")},
        rate_hz=Knob(15.0, "DROID's"),
        episodes=episodes,
        idle={"rule": Knob("commands", "openpi's rule, on the commanded joint velocities")},
        about=(f"raw DROID, {size}, 15 steps a second",),
    )


LOOKS: dict[str, Callable[[str], FoundData]] = {
    "rlds": look_at_rlds,
    "lerobot": look_at_lerobot,
    "npz": look_at_npz,
    "raw": look_at_raw,
}
_MARKS = {"lerobot": INFO, "rlds": "dataset_info.json"}  # description file of a data set, by form
_FIXES = {  # advice for other formats, by file suffix
    (".mcap", ".db3", ".bag"): f"a ROS bag. {way_by('ros2_bag')} makes .npz files of it",
    (".lance",): f"LeRobot's tables in Lance. {way_by('lance_to_files')} makes files of them",
    (".mp4",): f"videos alone. {way_by('mp4_and_csv')} makes .npz files of videos and poses",
    (".hdf5", ".h5", ".zarr"): "HDF5 or Zarr: write one .npz for each episode (docs/data.md)",
}
_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
_VERSION = re.compile(r"\d+(\.\d+)*")  # name of a version folder of TFDS
_DEEPEST = 2  # levels of subfolders that are searched for a description file
_MOST_FOLDERS = 50  # subfolders of each folder that are searched


def look_at(path: str) -> FoundData:
    """Recognise the form of a data set in a folder or at a URL by its files, and read its properties.

    Raises:
        InputError: There is no supported data set. The error names the files that exist and, if possible, a converter.
        UnreachableError: The folder or URL cannot be read.
    """
    if path == droid().path:
        return droid()
    if not storage.is_url(path) and not Path(path).is_dir():
        fix = f"For a data set of the Hugging Face Hub: hf://datasets/{path}" if _HUB_NAME.fullmatch(path) else ""
        raise InputError(where=path, found="no such folder", needed="a folder, or a URL", fix=fix)
    with storage.translate_read_errors(path):
        if data := _look_with_plugins(path):
            return data
        described = _find_described_sets(path)
        if not described:
            return LOOKS[_recognize_form(path)](path)
        form, newest, versions = _require_only_set(described, path)
        data = LOOKS[form](newest)
        version_note = f"version {_name_of(newest)}, the newest of {', '.join(versions)}"
        return replace(data, about=(*data.about, *[version_note] * (len(versions) > 1)))


def _look_with_plugins(path: str) -> FoundData | None:
    """Return the properties of a data set if a third-party source recognises it (docs/extending.md)."""
    admit_forms_of_data(all_installed=True)
    for source, kind in DataConfig.kinds.items():
        if (values := kind.look(path)) is not None:
            why = f"found by {kind.__name__}"
            rate = Knob(10.0, "not said: your robot's control steps a second", is_guess=True)
            if "control_rate_hz" in values:
                rate = Knob(values.pop("control_rate_hz"), why)
            knobs = {name: Knob(value, why) for name, value in values.items()}
            return FoundData(source, path, knobs, rate, about=(f"{source}, a form of data of your own",))
    return None


def simulated(path: str) -> FoundData:
    """Return the properties of the data set that `vjepa2-ac simulate record` will write."""
    return replace(
        like_droid(path, episodes=60, title="the simulated arm"),
        steps=60 * 41,
        usual_steps=41,
        short_steps=41,
        about=("60 episodes of the simulated arm, to be recorded",),
    )


def _find_described_sets(path: str) -> list[tuple[str, str]]:
    """Return form and folder of each data set with a description file.

    The path and two levels of subfolders are searched; at a third level only version folders are searched.
    """
    described: dict[str, tuple[str, str]] = {}  # by absolute path, because several links may lead to one data set
    folders = [path]
    for depth in range(_DEEPEST + 2):
        listed = zip(folders, in_parallel(storage.list_folder, folders, _CONNECTIONS), strict=True)
        folders = []
        for folder, entries in listed:
            names = {entry.name for entry in entries}
            marked = [form for form, mark in _MARKS.items() if mark.partition("/")[0] in names]
            if form := next((form for form in marked if storage.exists(storage.join(folder, _MARKS[form]))), None):
                described.setdefault(storage.canonical_path(folder), (form, folder))
                continue
            inner = [entry.name for entry in entries if not entry.is_file and not entry.name.startswith(".")]
            if depth == _DEEPEST:
                inner = [name for name in inner if _VERSION.fullmatch(name)]
            folders += [storage.join(folder, name) for name in sorted(inner, key=_as_version)[-_MOST_FOLDERS:]]
    return list(described.values())


def _require_only_set(described: Sequence[tuple[str, str]], path: str) -> tuple[str, str, list[str]]:
    """Return form and folder of the newest version of the only data set, and the names of all its versions.

    Raises:
        InputError: There are several data sets. The error lists their folders.
    """
    sets: dict[str, list[tuple[str, str]]] = {}
    for form, folder in described:
        is_version = folder != path and _VERSION.fullmatch(_name_of(folder))
        sets.setdefault(folder.rpartition("/")[0] if is_version else folder, []).append((form, folder))
    if len(sets) > 1:
        found = f"{len(sets)} data sets: {', '.join(sorted(sets))}"
        fix = f"Name one: `{shell_command('init', min(sets))}`"
        raise InputError(where=path, found=found, needed="one data set", fix=fix)
    versions = sorted(*sets.values(), key=lambda version: _as_version(_name_of(version[1])))
    return *versions[-1], [_name_of(folder) for _, folder in versions]


def _name_of(folder: str) -> str:
    return folder.rpartition("/")[2]


def _as_version(name: str) -> list[tuple[int, str]]:
    """Return a sort key for names with numbers, with which 1.10.0 comes after 1.9.0."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _recognize_form(path: str) -> str:
    """Return the form of a data set without a description file, by the names of its files.

    Raises:
        InputError: No form is recognised.
    """
    names = _names_below(path)
    if any(name.endswith(".npz") for name in names):
        return "npz"
    if any(name == "trajectory.h5" or name.startswith("metadata_") for name in names):
        return "raw"
    fixes = (text for ends, text in _FIXES.items() for name in names if name.lower().endswith(ends))
    shown = ", ".join(names[:5]) + (", …" if len(names) > 5 else "") or "an empty folder"
    needed = "LeRobot (meta/info.json), RLDS (dataset_info.json), .npz files, or raw DROID (trajectory.h5)"
    fix = f"This looks like {next(fixes, 'other data: docs/data.md shows how to convert them')}"
    raise InputError(where=path, found=f"nothing that is read ({shown})", needed=needed, fix=fix)


def _names_below(path: str) -> list[str]:
    """Return the names of files and folders at a path, in its first subfolder, and so on, up to five levels."""
    names: list[str] = []
    for _ in range(5):
        names_in_folder = storage.list_names(path)
        names += names_in_folder
        inner = next((name for name in sorted(names_in_folder) if "." not in name), None)
        if inner is None:
            break
        path = storage.join(path, inner)
    return names


def measured(data: FoundData, progress: Progress | None = None) -> FoundData:
    """Add the numbers and lengths of episodes, and the splits, from the index of the data set.

    The properties are returned unchanged for a URL, or if the index cannot be built; `data check` then shows the
    reason.
    """
    section = {"source": data.source, "path": data.path, "states": data.states, **plain(data.knobs)}
    values = {"run_dir": "none", "data": section, "model": {"base": f"{BUILTIN}sim-tiny"}}
    if storage.is_url(data.path):
        return data
    try:
        config = parse_config(values, where="vjepa2-ac init").data
        table = EpisodeTable.of(open_source(config).infos(progress))
    except UserError:
        return data
    if not len(table):
        return data
    lengths, splits = table.num_steps, describe_splits(table, config)
    return replace(
        data,
        episodes=len(lengths),
        steps=int(lengths.sum()),
        usual_steps=int(np.median(lengths)),
        short_steps=int(np.quantile(lengths, 0.1)),
        own_splits=tuple(held_out_by(table, config)),
        about=(*data.about, f"splits: {splits}") if splits else data.about,
    )
