"""Source of plain .npz files: one file per episode, in a folder or in folders below it.

An episode NAME.npz, as numpy.savez or numpy.savez_compressed writes it, holds

    states             [steps, 7]  measured: x, y, z in metres, roll, pitch, yaw in radians (extrinsic xyz Euler),
                                   gripper position, 0 open .. 1 closed; all in the robot's base frame
                                   ([steps, any] with data.states: vector: any numbers)
    frames             [steps, height, width, 3] uint8, RGB: the frame at each step
    fps_hz             control steps per second, the same in all episodes

and may hold

    any other name     more cameras, shaped as `frames`; `data.camera` selects cameras by name
    extrinsics         [6] or [steps, 6]: the camera in the base frame; extrinsics_CAMERA: that of one camera
    joint_velocities   [steps, joints], *commanded*, radians per second; used by the rule `commands` of the idle filter
    actions            [steps, any], *commanded*; read with data.actions: recorded
    success            true or false
    language           the instruction as text
    scene, building, operator, day   texts by which `data.split_by` can group episodes

From a file of numpy.savez only the requested frames are read, without verifying their checksum, which covers all
frames. In a file of numpy.savez_compressed the preceding frames must be decompressed, too, which is slow for long
episodes.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import IO, cast

import numpy as np
from jaxtyping import Float64, Shaped, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.files import CONNECTIONS, walk
from vjepa2_ac.data.index import EpisodeTable, get_or_build_index, index_key, summarize_states
from vjepa2_ac.data.sources.indexed_source import (
    IndexedSource,
    IndexEntry,
    get_state_space,
    make_frame_reader,
    require_indexed_length,
)
from vjepa2_ac.episode import EXTRINSICS_DIM, STATE_DIM, Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError, UserError, did_you_mean
from vjepa2_ac.media.images import require_decodable_size
from vjepa2_ac.storage.block_file import BlockCachedFile

FORMAT_HELP = "docs/data.md describes the arrays of an episode"

_SUFFIX = ".npz"
_MAX_NUMBERS = 1 << 25  # limit for arrays other than frames: 88 hours of 7 numbers at 15 Hz; 256 MB as float64
_MAX_TEXT_BYTES = 1 << 18
_LABELS = ("scene", "building", "operator", "day")
_LOCAL_HEADER_BYTES = 30
_MAX_BYTES = 1 << 30  # limit for an array that is read completely
_MAX_UNPACKED_BYTES, _MAX_RATIO = 1 << 30, 100  # above the first size, limit of the ratio of unpacked to packed bytes
_COMPRESSIONS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})  # other types may expand without limit
_FIX = "Write the file again, with numpy.savez"


class NpzSource(IndexedSource[DataConfig, None]):
    """The episodes of a folder of .npz files, in the order of their paths; the identity is the path without .npz.

    `infos` reads all files except their frames. Remote data are cached on this machine.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - files are fetched in blocks
        """Return an episode; only requested frames are read.

        Raises:
            InputError: The file is missing or damaged, or has changed since it was indexed.
            OSError: Data behind a URL cannot be read.
        """
        table = self.infos()
        info = table[index]
        episode, _ = self._read_episode(info.id, table.texts["index"], (camera or self._config.cameras[0],))
        require_indexed_length(len(episode.states), info, self._path(info.id))
        return episode

    def _read_episode(
        self, identity: str, version: str, cameras: Sequence[str]
    ) -> tuple[Episode, dict[str, str | None]]:
        """Return an episode with the frames of the first of some cameras, and the labels of the episode.

        Raises:
            InputError: The file is not an episode, or its numbers are implausible.
        """
        path, config = self._path(identity), self._config
        with open_npz(self._files.open(path, version=version), path) as file:
            names = file.names
            states = file.read_numbers("states", (None, STATE_DIM if config.states == "pose" else None))
            steps = len(states)
            get_state_space(config, states.shape[1]).require_plausible(states, path, fix=FORMAT_HELP)
            for camera in cameras:
                file.require_frames(camera, steps)
            extrinsics = [file.read_extrinsics(camera, steps) for camera in cameras]
            if config.pose_frame == "camera" and any(poses is None for poses in extrinsics):
                problem = "the camera poses are missing"
                needed = "the array extrinsics, or extrinsics_CAMERA for each camera of data.camera"
                raise InputError(where=path, found=problem, needed=needed, fix="Set data.pose_frame: base")
            fps_hz = float(file.read_numbers("fps_hz", ()))
            if fps_hz <= 0:
                raise file.array_error("fps_hz", f"{fps_hz:g}", "a positive number of control steps per second")
            joints = "joint_velocities"
            language = file.read_text("language") if "language" in names else None
            episode = Episode(
                info=EpisodeInfo(
                    identity, steps, bool(file.read_numbers("success", ())) if "success" in names else None
                ),
                states=states,
                read_frames=make_frame_reader(
                    steps, path, partial(self._read_frames, path, version, cameras[0], steps)
                ),
                control_rate_hz=fps_hz,
                extrinsics=extrinsics[0],
                joint_velocities=file.read_numbers(joints, (steps, None)) if joints in names else None,
                metadata={} if language is None else {"language": language},
                commands=file.read_numbers("actions", (steps, None)) if config.actions == "recorded" else None,
            )
            headers = {name: file.read_header(name) for name in _LABELS if name in names}  # a camera may have this name
            is_text = {name: header.shape == () and header.dtype.kind == "U" for name, header in headers.items()}
            labels = {name: file.read_text(name) for name in headers if is_text[name]}
            return episode, {"task": language, **labels}

    def _read_frames(
        self, path: str, version: str, camera: str, num_steps: int, steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        with open_npz(self._files.open(path, version=version), path) as file:
            file.require_frames(camera, num_steps, count=len(set(steps)))
            return np.asarray(file.read_rows(camera, steps))

    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, None]:
        """Return the cached table, or read all episodes; a changed file changes the key."""
        config, root = self._config, self._config.path
        file_entries = sorted(
            (storage.join(folder, file.name), file.size, file.version)
            for folder, file in walk(root, CONNECTIONS)
            if file.name.endswith(_SUFFIX)
        )
        if not file_entries:
            problem = f"no .npz files under {root}"
            raise InputError(where="data.path", found=problem, needed="one .npz file for each episode", fix=FORMAT_HELP)
        config_values: dict[str, object] = {"cameras": config.cameras, "pose_frame": config.pose_frame}
        if config.states == "vector":
            config_values |= {"states": config.states, "actions": config.actions}
        key = index_key({"source": "npz", **config_values, "listed": file_entries}, root)
        ids = [path.removesuffix(_SUFFIX) for path, _, _ in file_entries]
        build = partial(self._scan_all, partial(self._scan, key), dict(zip(ids, ids, strict=True)), progress)
        return get_or_build_index(config.disk_cache, key, root, build), None

    def _scan(self, version: str, identity: str) -> IndexEntry:
        episode, labels = self._read_episode(identity, version, self._config.cameras)
        kind = f"{episode.control_rate_hz:g} steps per second (fps_hz), {episode.states.shape[1]} numbers per state"
        if episode.commands is not None:
            kind += f", {episode.commands.shape[1]} numbers per action"
        where, states = self._path(identity), summarize_states(episode.states)
        return IndexEntry(episode.info, where, {}, states, labels, episode.control_rate_hz, kind)

    def _path(self, identity: str) -> str:
        return storage.join(self._config.path, identity + _SUFFIX)


@contextmanager
def open_npz(file_or_path: str | BlockCachedFile, path: str) -> Iterator[NpzFile]:
    """Open an .npz file, given by its path or as an open remote file, for reading.

    Raises:
        InputError: The file is missing, or not an .npz file.
        UnreachableError: The file cannot be read now.
    """
    with (
        storage.translate_read_errors(path, fix="Restore the file, or exclude the episode"),
        closing(storage.open_for_reading(file_or_path) if isinstance(file_or_path, str) else file_or_path) as file,
    ):
        yield NpzFile(file, path)


# ---- the .npz format of untrusted files ----


@dataclass(frozen=True)
class ArrayHeader:
    """Shape and type of an array, and the offset of the values in the unpacked file of the array."""

    shape: tuple[int, ...]
    dtype: np.dtype
    start: int
    by_columns: bool = False  # whether the array has several dimensions and Fortran order

    @property
    def nbytes(self) -> int:
        """Size of the values in bytes."""
        return prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        """Size of one row in bytes."""
        return prod(self.shape[1:]) * self.dtype.itemsize


class NpzFile:
    """An .npz file open for reading.

    Raises:
        InputError: The file is not an .npz file. All methods raise it for a damaged file.
    """

    def __init__(self, file: storage.ByteReader, where: str) -> None:
        self._file, self._where = file, where
        with self._translate_errors():
            self._archive = zipfile.ZipFile(cast("IO[bytes]", file))
            members = [info for info in self._archive.infolist() if info.compress_type in _COMPRESSIONS]
        self._members = {info.filename.removesuffix(".npy"): info for info in members if info.filename.endswith(".npy")}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the arrays."""
        return tuple(self._members)

    def read_header(self, name: str) -> ArrayHeader:
        """Read shape and type of an array without its values; refuse a shape that does not match the stored size."""
        member = self._members[name]
        with self._translate_errors(name), self._archive.open(member) as file:
            # Version 1.0 limits the length of a header. Numpy writes other versions only for records of many fields.
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("an array in a format that numpy does not write")
            shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
            header = ArrayHeader(shape, dtype, file.tell(), by_columns and len(shape) > 1)
            if dtype.hasobject:
                raise ValueError("an array of Python objects, which are not loaded because unpickling can execute code")
            if header.start + header.nbytes != member.file_size:
                raise ValueError(f"shape {header.shape} of {header.dtype} does not match {member.file_size} bytes")
            if member.file_size > max(_MAX_UNPACKED_BYTES, _MAX_RATIO * member.compress_size):
                unpacked = f"{member.compress_size:,} bytes that unpack to {member.file_size:,}"
                limit = f"above {_MAX_UNPACKED_BYTES:,} bytes the largest compression ratio is {_MAX_RATIO}"
                raise ValueError(f"{unpacked}; {limit}")
            return header

    def read_array(self, name: str) -> Shaped[np.ndarray, ...]:
        """Read a complete array and verify its checksum."""
        header = self.read_header(name)
        with self._translate_errors(name), self._archive.open(self._members[name]) as member:
            if header.nbytes > _MAX_BYTES:
                raise ValueError(f"shape {header.shape} exceeds the limit of {_MAX_BYTES:,} bytes per array")
            values = np.frombuffer(member.read(), header.dtype, offset=header.start)
            return values.reshape(header.shape, order="F" if header.by_columns else "C")

    def read_rows(self, name: str, rows: Sequence[int]) -> Shaped[np.ndarray, "rows ..."]:
        """Read some rows of an array in C order, in the requested order.

        From an uncompressed array only these rows are read, without verifying the checksum, which covers the whole
        array. A compressed array is decompressed up to the last of these rows, without storing other rows.
        """
        header, member = self.read_header(name), self._members[name]
        with self._translate_errors(name), self._archive.open(member) as unpacked:
            stored = member.compress_type == zipfile.ZIP_STORED
            file, start = (self._file, self._find_content(member)) if stored else (unpacked, 0)
            unique_rows, indices = np.unique(rows, return_inverse=True)
            values = np.empty((len(unique_rows), *header.shape[1:]), header.dtype)
            for index, row in enumerate(unique_rows.tolist()):
                file.seek(start + header.start + row * header.row_bytes)
                values[index] = np.frombuffer(file.read(header.row_bytes), header.dtype).reshape(header.shape[1:])
            return values if (indices == np.arange(len(rows))).all() else values[indices]

    def array_error(self, name: str, problem: str, needed: str) -> InputError:
        """Return an error about an array."""
        return InputError(where=f"{self._where}: {name}", found=problem, needed=needed, fix=FORMAT_HELP)

    def read_numbers(self, name: str, shape: tuple[int | None, ...]) -> Float64[np.ndarray, ...]:
        """Read an array of finite numbers. None in `shape` means any size."""
        self._require(name, shape, "biuf", "numbers")
        if (count := prod(self.read_header(name).shape)) > _MAX_NUMBERS:
            raise self.array_error(name, f"{count:,} numbers", f"at most {_MAX_NUMBERS:,} in an episode")
        values = self.read_array(name).astype(np.float64)
        if not np.isfinite(values).all():
            step = np.argwhere(~np.isfinite(values))[0][:1].tolist()
            raise self.array_error(name, f"NaN or infinity{f' at step {step[0]}' if step else ''}", "finite numbers")
        return values

    def read_text(self, name: str) -> str:
        """Read a text."""
        self._require(name, (), "U", "a text")
        if (size := self.read_header(name).nbytes) > _MAX_TEXT_BYTES:
            raise self.array_error(name, f"a text of {size:,} bytes", f"at most {_MAX_TEXT_BYTES:,} bytes")
        return str(self.read_array(name))

    def read_extrinsics(self, camera: str, steps: int) -> Float64[np.ndarray, "steps 6"] | None:
        """Return the poses of a camera at all steps (repeated for a fixed camera), or None if there are none."""
        for name in (f"extrinsics_{camera}", "extrinsics"):
            if name in self.names:
                is_single_pose = len(self.read_header(name).shape) == 1
                values = self.read_numbers(name, (EXTRINSICS_DIM,) if is_single_pose else (steps, EXTRINSICS_DIM))
                return np.broadcast_to(values, (steps, EXTRINSICS_DIM))
        return None

    def require_frames(self, camera: str, steps: int, *, count: int = 1) -> None:
        """Refuse an array whose header is not that of a camera's frames; `count` frames will be read together."""
        self._require(camera, (steps, None, None, 3), "u", "frames (steps, height, width, 3)")
        header = self.read_header(camera)
        require_decodable_size(header.shape[1], header.shape[2], f"{self._where}: {camera}", count=count)
        if header.dtype != np.uint8:
            raise self.array_error(camera, f"frames of {header.dtype}", "uint8, 0 to 255")
        if header.by_columns:
            raise self.array_error(camera, "frames in Fortran order", "C order, as by numpy.ascontiguousarray")

    def _require(self, name: str, shape: tuple[int | None, ...], kinds: str, meaning: str) -> None:
        """Refuse an array that is missing or has another shape or type."""
        if name not in self.names:
            existing = ", ".join(self.names)[:200] or "none"
            error = self.array_error(name, f"no such array; existing arrays: {existing}", meaning)
            fix = f"{did_you_mean(name, self.names)}{error.fix}"
            raise InputError(where=error.where, found=error.found, needed=error.needed, fix=fix)
        header = self.read_header(name)
        has_shape = len(header.shape) == len(shape) and all(
            expected in {size, None} for size, expected in zip(header.shape, shape, strict=True)
        )
        if not has_shape or header.dtype.kind not in kinds or (0 in header.shape[1:]):
            expected_shape = " x ".join("any" if size is None else str(size) for size in shape) or "a scalar"
            raise self.array_error(
                name, f"shape {header.shape} of {header.dtype}", f"{meaning} of shape {expected_shape}"
            )

    def _find_content(self, member: zipfile.ZipInfo) -> int:
        """Return the offset in the file of the content of an uncompressed member."""
        self._file.seek(member.header_offset)
        local = self._file.read(_LOCAL_HEADER_BYTES)
        name_bytes, extra_bytes = (int.from_bytes(local[start : start + 2], "little") for start in (26, 28))
        return member.header_offset + _LOCAL_HEADER_BYTES + name_bytes + extra_bytes

    @contextmanager
    def _translate_errors(self, name: str = "") -> Iterator[None]:
        try:
            yield
        except UserError:
            raise
        except Exception as error:  # zipfile, zlib and numpy raise many types of errors for damaged files
            if storage.is_os_read_error(error):
                raise
            where = f"{self._where}: {name}" if name else self._where
            problem = f"cannot be read ({str(error)[:200] or type(error).__name__})"
            raise InputError(where=where, found=problem, needed="an undamaged .npz file", fix=_FIX) from None
