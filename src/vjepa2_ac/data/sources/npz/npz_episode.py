"""The .npz episode format, and its validation.

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

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.configured_spaces import measured_space
from vjepa2_ac.episode import EXTRINSICS_DIM, STATE_DIM
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_size import require_bounded
from vjepa2_ac.storage.block_file import BlockCachedFile
from vjepa2_ac.storage.npz_reader import NpzFile

_MOST_NUMBERS = 1 << 25  # of an array other than frames: 88 hours of 7 numbers at 15 Hz; 256 MB as float64
_MOST_LETTERS = 1 << 16
LABELS = ("scene", "building", "operator", "day")
FORMAT_HELP = "docs/data.md says what an episode holds"


@dataclass(frozen=True)
class NpzEpisode:
    """The content of an episode's file, except the frames (legend: `vjepa2_ac.episode`)."""

    states: Float[np.ndarray, "steps state_dim"]
    fps_hz: float
    success: bool | None
    language: str | None
    extrinsics: dict[str, Any]  # of each camera: [steps 6], or None
    joint_velocities: Float[np.ndarray, "steps joints"] | None
    commands: Float[np.ndarray, "steps action_dim"] | None
    labels: dict[str, str | None]  # the episode's labels

    @property
    def widths(self) -> tuple[int, int | None]:
        """The widths of a state and a command."""
        return self.states.shape[1], None if self.commands is None else self.commands.shape[1]


def read_episode(opened: str | BlockCachedFile, path: str, cameras: Sequence[str], config: DataConfig) -> NpzEpisode:
    """Read a file except the frames, whose shape is checked.

    Args:
        opened: The path, or an open remote file.
        path: Of the file, for messages.
        cameras: The cameras whose frames must exist.
        config: Whether camera poses and commands must exist, too, and the kind of state.

    Raises:
        InputError: It is no episode, or impossible for a robot.
    """
    with opened_npz(opened, path) as file:
        arrays = _Arrays(file, path)
        states = arrays.numbers("states", (None, STATE_DIM if config.states == "pose" else None))
        steps = len(states)
        measured_space(config, states.shape[1]).require_plausible(states, path, fix=FORMAT_HELP)
        extrinsics = {}
        for camera in cameras:
            require_frames(file, camera, steps, path)
            extrinsics[camera] = arrays.extrinsics(camera, steps)
            if config.pose_frame == "camera" and extrinsics[camera] is None:
                found, needed = "no poses of the camera", f"extrinsics or extrinsics_{camera}"
                raise InputError(where=path, found=found, needed=needed, fix="Set data.pose_frame: base")
        fps_hz = float(arrays.numbers("fps_hz", ()))
        if fps_hz <= 0:
            raise _refused(f"{path}: fps_hz", f"{fps_hz:g}", "control steps per second")
        has_velocities = "joint_velocities" in file.names
        return NpzEpisode(
            states=states,
            fps_hz=fps_hz,
            success=bool(arrays.numbers("success", ())) if "success" in file.names else None,
            language=arrays.text("language") if "language" in file.names else None,
            extrinsics=extrinsics,
            joint_velocities=arrays.numbers("joint_velocities", (steps, None)) if has_velocities else None,
            commands=arrays.numbers("actions", (steps, None)) if config.actions == "recorded" else None,
            labels={name: arrays.text(name) for name in LABELS if arrays.is_text(name)},
        )


@contextmanager
def opened_npz(opened: str | BlockCachedFile, path: str) -> Iterator[NpzFile]:
    """Open an .npz file for reading.

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


def require_frames(file: NpzFile, camera: str, steps: int, path: str, *, count: int = 1) -> None:
    """Refuse an array that cannot be the frames of a camera, without reading it.

    Args:
        file: The episode's.
        camera: The name of the array.
        steps: Of the episode.
        path: The file's, for messages.
        count: Frames that are read together.

    Raises:
        InputError: There is no such array, it is not [steps, height, width, 3] of uint8, or too large.
    """
    _require_array(file, camera, (steps, None, None, 3), "u", "frames (steps, height, width, 3)", path)
    header = file.header_of_rows(camera)
    require_bounded(header.shape[1], header.shape[2], f"{path}: {camera}", count=count)
    if header.dtype != np.uint8:
        raise _refused(f"{path}: {camera}", f"frames of {header.dtype}", "uint8, 0 to 255")


@dataclass(frozen=True)
class _Arrays:
    """Reads arrays of known shapes from an untrusted file."""

    file: NpzFile
    path: str

    def numbers(self, name: str, shape: tuple[int | None, ...]) -> Float64[np.ndarray, ...]:
        """Return finite numbers of a shape; None stands for any length."""
        _require_array(self.file, name, shape, "biuf", "numbers", self.path)
        self._require_small(name, prod(self.file.header(name).shape), _MOST_NUMBERS, "numbers")
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
        self._require_small(name, self.file.header(name).dtype.itemsize // 4, _MOST_LETTERS, "letters")
        return str(self.file.array(name))

    def extrinsics(self, camera: str, steps: int) -> Float64[np.ndarray, "steps 6"] | None:
        """Return the poses of a camera, repeated for a fixed one; None if there are none."""
        for name in (f"extrinsics_{camera}", "extrinsics"):
            if name in self.file.names:
                one_pose = len(self.file.header(name).shape) == 1
                values = self.numbers(name, (EXTRINSICS_DIM,) if one_pose else (steps, EXTRINSICS_DIM))
                return np.broadcast_to(values, (steps, EXTRINSICS_DIM))
        return None

    def _require_small(self, name: str, count: int, most: int, of_what: str) -> None:
        """Refuse an array far larger than any episode's before it is decompressed: zeros compress a thousandfold."""
        if count > most:
            raise _refused(f"{self.path}: {name}", f"{count:,} {of_what}", f"at most {most:,} in an episode")


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
