"""Source of plain .npz files: one file per episode, in a folder or in folders below it.

An episode NAME.npz, as numpy.savez or numpy.savez_compressed writes it, holds

    states             [steps, 7]  measured: x, y, z in metres, roll, pitch, yaw in radians (extrinsic xyz Euler),
                                   gripper closedness, 0 open .. 1 closed; all in the robot's base frame
                                   ([steps, any] with data.states: vector: whatever the robot has)
    frames             [steps, height, width, 3] uint8, RGB: the frame at each step
    fps_hz             control steps per second, the same in all episodes

and may hold

    any other name     more cameras, shaped as `frames`; `data.camera` chooses by name
    extrinsics         [6] or [steps, 6]: the camera in the base frame; extrinsics_CAMERA: that of one camera
    joint_velocities   [steps, joints], *commanded*, radians per second: the idle filter's rule `commands` reads them
    actions            [steps, any], *commanded*: read with data.actions: recorded
    success            true or false
    language           the task as text
    scene, building, operator, day   texts: what `data.split_by` may keep together

Of a file that numpy.savez wrote, only the requested frames are read, and their checksum is not checked: it covers all
frames. Of one that numpy.savez_compressed wrote, the preceding frames must be decompressed, too: slow for long
episodes.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable, get_or_build, hash_of_states, index_key, labels_of
from vjepa2_ac.data.sources.configured_spaces import measured_space
from vjepa2_ac.data.sources.indexed_source import FramesByStep, IndexedSource, Opened, require_as_indexed
from vjepa2_ac.data.sources.listing import walk, within
from vjepa2_ac.episode import EXTRINSICS_DIM, STATE_DIM, Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import require_bounded
from vjepa2_ac.storage.block_file import BlockCachedFile
from vjepa2_ac.storage.npz_reader import NpzFile

logger = logging.getLogger(__name__)

FORMAT_HELP = "docs/data.md says what an episode holds"

_SUFFIX = ".npz"
_MOST_NUMBERS = 1 << 25  # of an array other than frames: 88 hours of 7 numbers at 15 Hz; 256 MB as float64
_MOST_TEXT_BYTES = 1 << 18
_LABELS = ("scene", "building", "operator", "day")


@dataclass(frozen=True)
class _Content:
    """The content of an episode's file, except the frames (legend: `vjepa2_ac.episode`)."""

    states: Float[np.ndarray, "steps state_dim"]
    fps_hz: float
    success: bool | None
    language: str | None
    extrinsics: dict[str, Any]  # of each camera: [steps 6], or None
    joint_velocities: Float[np.ndarray, "steps joints"] | None
    commands: Float[np.ndarray, "steps action_dim"] | None
    labels: dict[str, str | None]

    @property
    def kind(self) -> str:
        """What all episodes of a data set must have in common, in words."""
        action = "" if self.commands is None else f", {self.commands.shape[1]} an action"
        return f"{self.fps_hz:g} steps a second (fps_hz), {self.states.shape[1]} numbers a state{action}"


@dataclass(frozen=True)
class _Opened(Opened):
    version: str  # of all files: the key of the index


class NpzSource(IndexedSource[DataConfig, _Opened]):
    """The episodes of a folder of .npz files, in the order of their paths; a path without .npz is the identity.

    `infos` reads every file except the frames. Data from URLs is cached on this machine.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - files are fetched in blocks
        """Return one episode; only requested frames are read.

        Raises:
            InputError: The file is missing or damaged, or has changed since it was indexed.
            OSError: Data behind a URL cannot be read.
        """
        opened = self._open()
        info = opened.table[index]
        path, camera = self._path(info.id), camera or self._config.cameras[0]
        found = self._content(path, opened.version, (camera,))
        require_as_indexed(len(found.states), info, path)
        return Episode(
            info=info,
            states=found.states,
            read_frames=FramesByStep(info.num_steps, path, partial(self._frames, path, camera, info.num_steps)),
            control_rate_hz=found.fps_hz,
            extrinsics=found.extrinsics[camera],
            joint_velocities=found.joint_velocities,
            metadata={} if found.language is None else {"language": found.language},
            commands=found.commands,
        )

    def _frames(
        self, path: str, camera: str, num_steps: int, steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        with opened_npz(self._files.open(path, version=self._open().version), path) as file:
            _require_frames(file, camera, num_steps, path, count=len(set(steps)))
            return np.asarray(file.rows(camera, steps))

    def _content(self, path: str, version: str, cameras: Sequence[str]) -> _Content:
        with opened_npz(self._files.open(path, version=version), path) as file:
            return _content_of(file, path, cameras, self._config)

    def _look(self, progress: Progress) -> _Opened:
        """Return the cached table, or read every episode; a changed file changes the key."""
        config, root = self._config, self._config.path
        listed = sorted(
            (within(folder, file.name), file.size, file.version)
            for folder, file in walk(root, config.connections)
            if file.name.endswith(_SUFFIX)
        )
        if not listed:
            found = f"no .npz files under {root}"
            raise InputError(where="data.path", found=found, needed="one for each episode", fix=FORMAT_HELP)
        knobs: dict[str, object] = {"cameras": config.cameras, "pose_frame": config.pose_frame}
        if config.states == "vector":
            knobs |= {"states": config.states, "actions": config.actions}
        key = index_key({"source": "npz", **knobs, "listed": listed}, root)
        ids = [path.removesuffix(_SUFFIX) for path, _, _ in listed]
        build = partial(self._scan_all, ids, key, progress)
        return _Opened(get_or_build(config.disk_cache, key, root, build), key)

    def _scan_all(self, ids: list[str], version: str, progress: Progress) -> EpisodeTable:
        found, problems = self._scanned(
            lambda name: self._content(self._path(name), version, self._config.cameras),
            dict(zip(ids, ids, strict=True)),
            progress,
        )
        usual = Counter(one.kind for _, one in found).most_common(1)[0][0]
        problems += [self._unlike(name, one.kind, usual) for name, one in found if one.kind != usual]
        usable = {name: one for name, one in found if one.kind == usual}
        logger.info("%s: %d episodes, %d that cannot be used", self._config.path, len(usable), len(problems))
        return EpisodeTable.of(
            [EpisodeInfo(name, len(one.states), one.success) for name, one in usable.items()],
            problems=problems,
            texts={"control_rate_hz": str(next(iter(usable.values())).fps_hz)},
            state_hashes=[hash_of_states(one.states) for one in usable.values()],
            labels=labels_of([{"task": one.language, **one.labels} for one in usable.values()]),
        )

    def _unlike(self, identity: str, kind: str, usual: str) -> EpisodeProblem:
        fix = "Resample the episode, or keep the recordings of different robots in different folders"
        return EpisodeProblem(identity, self._path(identity), kind, f"{usual}, as in most episodes", fix)

    def _path(self, identity: str) -> str:
        return storage.join(self._config.path, identity + _SUFFIX)


@contextmanager
def opened_npz(opened: str | BlockCachedFile, path: str) -> Iterator[NpzFile]:
    """Open an .npz file, given by its path or as an open remote file, for reading.

    Raises:
        InputError: It is missing, or no .npz file; an UnreachableError if it cannot be read.
    """
    try:
        with closing(storage.open_to_read(opened) if isinstance(opened, str) else opened) as file:
            yield NpzFile(file, path)
    except FileNotFoundError:
        raise InputError(where=path, found="no such file", fix="Put it back, or leave the episode out") from None
    except OSError as error:
        raise storage.unreadable(path, error) from None


def _content_of(file: NpzFile, path: str, cameras: Sequence[str], config: DataConfig) -> _Content:
    """Return the content of a file except the frames of the cameras, whose shape is checked.

    Raises:
        InputError: It is no episode, or impossible for a robot.
    """
    arrays = _Arrays(file, path)
    states = arrays.numbers("states", (None, STATE_DIM if config.states == "pose" else None))
    steps = len(states)
    measured_space(config, states.shape[1]).require_plausible(states, path, fix=FORMAT_HELP)
    extrinsics = {}
    for camera in cameras:
        _require_frames(file, camera, steps, path)
        extrinsics[camera] = arrays.extrinsics(camera, steps)
        if config.pose_frame == "camera" and extrinsics[camera] is None:
            found, needed = "no poses of the camera", f"extrinsics or extrinsics_{camera}"
            raise InputError(where=path, found=found, needed=needed, fix="Set data.pose_frame: base")
    fps_hz = float(arrays.numbers("fps_hz", ()))
    if fps_hz <= 0:
        raise _refused(f"{path}: fps_hz", f"{fps_hz:g}", "control steps per second")
    has_velocities = "joint_velocities" in file.names
    return _Content(
        states=states,
        fps_hz=fps_hz,
        success=bool(arrays.numbers("success", ())) if "success" in file.names else None,
        language=arrays.text("language") if "language" in file.names else None,
        extrinsics=extrinsics,
        joint_velocities=arrays.numbers("joint_velocities", (steps, None)) if has_velocities else None,
        commands=arrays.numbers("actions", (steps, None)) if config.actions == "recorded" else None,
        labels={name: arrays.text(name) for name in _LABELS if arrays.is_text(name)},
    )


def _require_frames(file: NpzFile, camera: str, steps: int, path: str, *, count: int = 1) -> None:
    """Refuse an array that cannot be the frames of a camera, without reading it; `count` are read together."""
    _require_array(file, camera, (steps, None, None, 3), "u", "frames (steps, height, width, 3)", path)
    header = file.header(camera)
    require_bounded(header.shape[1], header.shape[2], f"{path}: {camera}", count=count)
    if header.dtype != np.uint8:
        raise _refused(f"{path}: {camera}", f"frames of {header.dtype}", "uint8, 0 to 255")
    if header.by_columns:
        found = "frames in Fortran order, of which none can be read by itself"
        raise InputError(where=f"{path}: {camera}", found=found, needed="C order", fix="Use numpy.ascontiguousarray")


@dataclass(frozen=True)
class _Arrays:
    """Reads arrays of known shapes from an untrusted file."""

    file: NpzFile
    path: str

    def numbers(self, name: str, shape: tuple[int | None, ...]) -> Float64[np.ndarray, ...]:
        """Return finite numbers of a shape; None stands for any length."""
        _require_array(self.file, name, shape, "biuf", "numbers", self.path)
        if (count := prod(self.file.header(name).shape)) > _MOST_NUMBERS:
            raise _refused(f"{self.path}: {name}", f"{count:,} numbers", f"at most {_MOST_NUMBERS:,} in an episode")
        values = self.file.array(name).astype(np.float64)
        if not np.isfinite(values).all():
            step = np.argwhere(~np.isfinite(values))[0][:1].tolist()
            at = f" at step {step[0]}" if step else ""
            raise _refused(f"{self.path}: {name}", f"NaN or infinity{at}", "numbers")
        return values

    def is_text(self, name: str) -> bool:
        """Return whether there is an array of this name with one text; a camera may have that name, too."""
        header = self.file.header(name) if name in self.file.names else None
        return header is not None and header.shape == () and header.dtype.kind == "U"

    def text(self, name: str) -> str:
        """Return a text."""
        _require_array(self.file, name, (), "U", "one text", self.path)
        if (size := self.file.header(name).nbytes) > _MOST_TEXT_BYTES:
            raise _refused(f"{self.path}: {name}", f"a text of {size:,} bytes", f"at most {_MOST_TEXT_BYTES:,}")
        return str(self.file.array(name))

    def extrinsics(self, camera: str, steps: int) -> Float64[np.ndarray, "steps 6"] | None:
        """Return the poses of a camera, repeated for a fixed one; None if there are none."""
        for name in (f"extrinsics_{camera}", "extrinsics"):
            if name in self.file.names:
                one_pose = len(self.file.header(name).shape) == 1
                values = self.numbers(name, (EXTRINSICS_DIM,) if one_pose else (steps, EXTRINSICS_DIM))
                return np.broadcast_to(values, (steps, EXTRINSICS_DIM))
        return None


def _require_array(
    file: NpzFile, name: str, shape: tuple[int | None, ...], kinds: str, meaning: str, path: str
) -> None:
    """Refuse an array that is missing, or of another shape or type."""
    if name not in file.names:
        there = ", ".join(file.names)[:200] or "none"
        raise _refused(f"{path}: {name}", "no such array", f"{meaning}; there are {there}")
    header = file.header(name)
    alike = len(header.shape) == len(shape) and all(b in {a, None} for a, b in zip(header.shape, shape, strict=True))
    if not alike or header.dtype.kind not in kinds or (0 in header.shape[1:]):
        wanted = " x ".join("any" if size is None else str(size) for size in shape) or "a single one"
        raise _refused(f"{path}: {name}", f"shape {header.shape} of {header.dtype}", f"{meaning}: {wanted}")


def _refused(where: str, found: str, needed: str) -> InputError:
    return InputError(where=where, found=found, needed=needed, fix=FORMAT_HELP)
