"""Recognise the format of a data set and read its properties: cameras, columns, control rate, episode lengths."""

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
from vjepa2_ac.config.loading import accept_new_data_formats, parse_config
from vjepa2_ac.data.files import map_in_threads, walk
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.selection import describe_splits, held_out_splits
from vjepa2_ac.data.sources.droid_raw import find_episodes
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.data.sources.lerobot_meta import INFO
from vjepa2_ac.data.sources.npz import FORMAT_HELP, open_npz
from vjepa2_ac.episode import STATE_DIM, Progress
from vjepa2_ac.errors import InputError, UserError, counted, shell_command
from vjepa2_ac.init.dataset_properties import DatasetProperties, make_idle_section, pick_camera
from vjepa2_ac.init.draft_values import DraftValue, plain_values
from vjepa2_ac.init.lerobot import read_lerobot_properties
from vjepa2_ac.init.rlds import make_droid_properties, make_published_droid_properties, read_rlds_properties
from vjepa2_ac.storage.paths import BUILTIN

_CONNECTIONS = 16  # number of parallel reads
_CONVERTERS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "convert"


def list_converters() -> dict[str, str]:
    """Return the description of each converter script, by name."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_CONVERTERS.glob("*.py"))}
    return {name: (ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0] for name, text in texts.items()}


def read_converter(name: str) -> str:
    """Return the source text of a converter script.

    Raises:
        InputError: There is no converter with this name.
    """
    if name not in list_converters():
        needed = f"one of {', '.join(list_converters())}"
        raise InputError(where="command line", found=f"unknown converter {name!r}", needed=needed)
    return (_CONVERTERS / f"{name}.py").read_text(encoding="utf-8")


def _explain_converter(name: str) -> str:
    """Return a sentence with the commands that write a converter script and show its options."""
    return f"Convert them: `vjepa2-ac data converter {name} > {name}.py`, then `python {name}.py --help`"


def read_npz_properties(path: str) -> DatasetProperties:
    """Read the properties of a folder of .npz files from the first file.

    Raises:
        InputError: There are no .npz files, or the first one has no states, no rate or no frames.
    """
    paths = (storage.join(folder, file.name) for folder, file in walk(path, _CONNECTIONS))
    files = sorted(name for name in paths if name.endswith(".npz"))
    if not files:
        raise InputError(where=path, found="no .npz files", needed="one .npz file per episode", fix=FORMAT_HELP)
    where = storage.join(path, files[0])
    with open_npz(where, where) as file:
        headers = {name: file.read_header(name) for name in file.names}
        missing = [name for name in ("states", "fps_hz") if name not in headers]
        cameras = [name for name, array in headers.items() if array.dtype == np.uint8 and len(array.shape) == 4]
        if missing or not cameras or len(headers["states"].shape) != 2:
            arrays = ", ".join(f"{name} {list(array.shape)} {array.dtype}" for name, array in headers.items())
            needed = "states [steps, 7], fps_hz and frames [steps, height, width, 3] of uint8"
            raise InputError(where=where, found=arrays or "no arrays", needed=needed, fix=FORMAT_HELP)
        rate = float(np.asarray(file.read_array("fps_hz")).reshape(-1)[0])
    steps, width = headers["states"].shape
    camera = "frames" if "frames" in cameras else pick_camera(cameras)
    is_pose, is_guess = width == STATE_DIM, len(cameras) > 1
    return DatasetProperties(
        source="npz",
        path=path,
        config_values={"camera": DraftValue(camera, f"cameras: {', '.join(cameras)}" if is_guess else "", is_guess)},
        rate_hz=DraftValue(rate, f"read from {files[0]}"),
        states="pose" if is_pose else "vector",
        episodes=len(files),
        idle=make_idle_section(has_velocities="joint_velocities" in headers) if is_pose else None,
        descriptions=(
            f".npz files, {counted(len(files), 'episode')}, {rate:g} control steps per second",
            f"the first episode has {counted(steps, 'control step')}",
        ),
    )


def read_raw_droid_properties(path: str) -> DatasetProperties:
    """Return the properties of raw DROID data. Episodes at a URL are not counted, because listing them is slow.

    Raises:
        InputError: There are no episodes.
    """
    is_remote = storage.is_url(path)
    episodes = None if is_remote else len(find_episodes(path, _CONNECTIONS))
    if episodes == 0:
        raise InputError(
            where=path, found="no episodes", needed="one folder per episode with trajectory.h5 and metadata_*.json"
        )
    size = "episodes not counted" if episodes is None else counted(episodes, "episode")
    return DatasetProperties(
        source="droid_raw",
        path=path,
        config_values={
            "camera": DraftValue(
                "left", "the released model was trained on this camera; alternatives: right, wrist, a serial number"
            )
        },
        rate_hz=DraftValue(15.0, "DROID's control rate"),
        episodes=episodes,
        idle={
            "rule": DraftValue(
                "commands", "openpi's rule: removes steps in which the commanded joint velocities do not change"
            )
        },
        descriptions=(f"raw DROID, {size}, 15 control steps per second",),
    )


_READERS: dict[str, Callable[[str], DatasetProperties]] = {
    "rlds": read_rlds_properties,
    "lerobot": read_lerobot_properties,
    "npz": read_npz_properties,
    "raw": read_raw_droid_properties,
}
_DESCRIPTION_FILES = {"lerobot": INFO, "rlds": "dataset_info.json"}  # description file of a data set, by format
_CONVERSION_HELP = {  # advice for other formats, by file suffix
    (".mcap", ".db3", ".bag"): f"The folder contains ROS bags. {_explain_converter('ros2_bag')}",
    (".lance",): f"The folder contains LeRobot data in Lance tables. {_explain_converter('lance_to_files')}",
    (".mp4",): f"The folder contains videos. {_explain_converter('mp4_and_csv')}",
    (".hdf5", ".h5", ".zarr"): "The folder contains HDF5 or Zarr files. Write one .npz file per episode (docs/data.md)",
}
_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
_VERSION = re.compile(r"\d+(\.\d+)*")  # name of a version folder of TFDS
_UNKNOWN_RATE = "not stored in the data set. Enter the number of control steps per second of your robot"
_MAX_DEPTH = 2  # levels of subfolders that are searched for a description file
_MAX_FOLDERS = 50  # subfolders of each folder that are searched


def read_properties(path: str) -> DatasetProperties:
    """Recognise the format of a data set in a folder or at a URL by its files, and read its properties.

    Raises:
        InputError: There is no supported data set. The error names the files that exist and, if possible, a converter.
        UnreachableError: The folder or URL cannot be read.
    """
    if path == make_published_droid_properties().path:
        return make_published_droid_properties()
    if not storage.is_url(path) and not Path(path).is_dir():
        fix = f"For a data set on the Hugging Face Hub write hf://datasets/{path}" if _HUB_NAME.fullmatch(path) else ""
        problem = "no such folder"
        if Path(path).is_file():
            problem, fix = "a file", f"Pass the folder that contains it: `{shell_command('init', Path(path).parent)}`"
        raise InputError(where=path, found=problem, needed="a folder or a URL", fix=fix)
    with storage.translate_read_errors(path):
        if data := _read_with_plugins(path):
            return data
        described = _find_described_sets(path)
        if not described:
            return _READERS[_recognize_format(path)](path)
        form, newest, versions = _require_single_set(described, path)
        data = _READERS[form](newest)
        version_note = f"version {_last_name(newest)}, the newest of {', '.join(versions)}"
        return replace(data, descriptions=(*data.descriptions, *[version_note] * (len(versions) > 1)))


def _read_with_plugins(path: str) -> DatasetProperties | None:
    """Return the properties of a data set if a third-party source recognises it (docs/extending.md)."""
    accept_new_data_formats(all_installed=True)
    for source, kind in DataConfig.kinds.items():
        if (values := kind.detect(path)) is not None:
            reason = f"returned by {kind.__name__}.detect"
            rate = DraftValue(10.0, _UNKNOWN_RATE, is_guess=True)
            if "control_rate_hz" in values:
                rate = DraftValue(values.pop("control_rate_hz"), reason)
            config_values = {name: DraftValue(value, reason) for name, value in values.items()}
            description = f"read by the installed data source {source}"
            return DatasetProperties(source, path, config_values, rate, descriptions=(description,))
    return None


def make_simulated_properties(path: str) -> DatasetProperties:
    """Return the properties of the data set that `vjepa2-ac simulate record` will write."""
    return replace(
        make_droid_properties(path, episodes=60, title="simulated arm"),
        steps=60 * 41,
        median_steps=41,
        p10_steps=41,
        descriptions=("simulated arm, 60 episodes that `vjepa2-ac simulate record` will write",),
    )


def _find_described_sets(path: str) -> list[tuple[str, str]]:
    """Return format and folder of each data set with a description file.

    The path and two levels of subfolders are searched; at a third level only version folders are searched.
    """
    described: dict[str, tuple[str, str]] = {}  # by absolute path, because several links may lead to one data set
    folders = [path]
    for depth in range(_MAX_DEPTH + 2):
        listings = zip(folders, map_in_threads(storage.list_folder, folders, _CONNECTIONS), strict=True)
        folders = []
        for folder, entries in listings:
            names = {entry.name for entry in entries}
            candidates = [form for form, file in _DESCRIPTION_FILES.items() if file.partition("/")[0] in names]
            if form := next(
                (form for form in candidates if storage.exists(storage.join(folder, _DESCRIPTION_FILES[form]))), None
            ):
                described.setdefault(storage.canonical_path(folder), (form, folder))
                continue
            subfolders = [entry.name for entry in entries if not entry.is_file and not entry.name.startswith(".")]
            if depth == _MAX_DEPTH:
                subfolders = [name for name in subfolders if _VERSION.fullmatch(name)]
            folders += [storage.join(folder, name) for name in sorted(subfolders, key=_as_version)[-_MAX_FOLDERS:]]
    return list(described.values())


def _require_single_set(described: Sequence[tuple[str, str]], path: str) -> tuple[str, str, list[str]]:
    """Return format and folder of the newest version of the only data set, and the names of all versions.

    Raises:
        InputError: There are several data sets. The error lists their folders.
    """
    sets: dict[str, list[tuple[str, str]]] = {}
    for form, folder in described:
        is_version = folder != path and _VERSION.fullmatch(_last_name(folder))
        sets.setdefault(folder.rpartition("/")[0] if is_version else folder, []).append((form, folder))
    if len(sets) > 1:
        problem = f"{len(sets)} data sets: {', '.join(sorted(sets))}"
        fix = f"Pass the path of one data set, for example `{shell_command('init', min(sets))}`"
        raise InputError(where=path, found=problem, needed="exactly one data set", fix=fix)
    versions = sorted(*sets.values(), key=lambda version: _as_version(_last_name(version[1])))
    return *versions[-1], [_last_name(folder) for _, folder in versions]


def _last_name(folder: str) -> str:
    return folder.rpartition("/")[2]


def _as_version(name: str) -> list[tuple[int, str]]:
    """Return a sort key for names with numbers, with which 1.10.0 comes after 1.9.0."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _recognize_format(path: str) -> str:
    """Return the format of a data set without a description file, by the names of its files.

    Raises:
        InputError: No format is recognised.
    """
    names = _list_names(path)
    if any(name.endswith(".npz") for name in names):
        return "npz"
    if any(name == "trajectory.h5" or name.startswith("metadata_") for name in names):
        return "raw"
    needed = "LeRobot (meta/info.json), RLDS (dataset_info.json), .npz files, or raw DROID (trajectory.h5)"
    if not names:
        raise InputError(where=path, found="an empty folder", needed=needed)
    fixes = (text for ends, text in _CONVERSION_HELP.items() for name in names if name.lower().endswith(ends))
    shown = ", ".join(names[:5]) + (", …" if len(names) > 5 else "")
    fix = next(fixes, "docs/data.md shows how to convert other formats")
    raise InputError(where=path, found=f"no supported data format ({shown})", needed=needed, fix=fix)


def _list_names(path: str) -> list[str]:
    """Return the names of files and folders at a path, in its first subfolder, and so on, up to five levels."""
    names: list[str] = []
    for _ in range(5):
        names_in_folder = storage.list_names(path)
        names += names_in_folder
        subfolder = next((name for name in sorted(names_in_folder) if "." not in name), None)
        if subfolder is None:
            break
        path = storage.join(path, subfolder)
    return names


def add_episode_lengths(data: DatasetProperties, progress: Progress | None = None) -> DatasetProperties:
    """Return the properties with the number and lengths of the episodes, and the splits, from the data set's index.

    The properties are returned unchanged for a URL, and if the index cannot be built. In the second case `data check`
    reports the reason.
    """
    section = {"source": data.source, "path": data.path, "states": data.states, **plain_values(data.config_values)}
    values = {"run_dir": "none", "data": section, "model": {"base": f"{BUILTIN}sim-tiny"}}
    if storage.is_url(data.path):
        return data
    try:
        config = parse_config(values, where="vjepa2-ac init").data
        table = EpisodeTable.from_infos(open_source(config).infos(progress))
    except UserError:
        return data
    if not len(table):
        return data
    lengths, splits = table.num_steps, describe_splits(table, config)
    return replace(
        data,
        episodes=len(lengths),
        steps=int(lengths.sum()),
        median_steps=int(np.median(lengths)),
        p10_steps=int(np.quantile(lengths, 0.1)),
        predefined_splits=tuple(held_out_splits(table, config)),
        descriptions=(*data.descriptions, f"splits: {splits}") if splits else data.descriptions,
    )
