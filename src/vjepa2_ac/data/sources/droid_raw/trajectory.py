"""The trajectory.h5 of a raw DROID episode: its content, and whether it matches the frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from vjepa2_ac.errors import InputError, require_library
from vjepa2_ac.spaces import zero_steps

_POSE = "observation/robot_state/cartesian_position"
_GRIPPER = "observation/robot_state/gripper_position"
_SKIP = "observation/timestamp/skip_action"
_JOINT_VELOCITY = "action/joint_velocity"
_JOINTS = 7
_MOST_STEPS = 1_000_000  # a damaged header may claim any number
_FIX = "Copy the episode again"


@dataclass(frozen=True)
class Trajectory:
    """The control steps of an episode that have a frame (legend: `vjepa2_ac.episode`)."""

    states: Float[np.ndarray, "steps 7"]
    frame_places: Int[np.ndarray, " steps"]  # position of each step's frame in the MP4
    skipped: Bool[np.ndarray, " steps"]  # the operator was not in control
    extrinsics: dict[str, np.ndarray | None]  # of each camera, by its serial number: [steps 6]
    joint_velocities: Float[np.ndarray, "steps 7"] | None  # commanded

    def at(self, steps: Int[np.ndarray, " kept"]) -> Trajectory:
        """Return some of the steps."""
        return Trajectory(
            self.states[steps],
            self.frame_places[steps],
            self.skipped[steps],
            {serial: None if poses is None else poses[steps] for serial, poses in self.extrinsics.items()},
            None if self.joint_velocities is None else self.joint_velocities[steps],
        )


def parse_trajectory(data: bytes, *, where: str, serials: Sequence[str], frame_counts: Mapping[str, int]) -> Trajectory:
    """Read the content of a trajectory.h5.

    Args:
        data: The content of the file.
        where: The file, for messages.
        serials: Cameras whose poses are requested; one without poses has None.
        frame_counts: How many each MP4 holds: as many as there are steps, or one more or less. The steps that have a
            frame in every one are returned.

    Raises:
        InputError: Not HDF5, damaged, incomplete, or of another length than an MP4.
    """
    h5py = require_library("h5py", where=where, called="h5py, which reads trajectory.h5", extra="raw")
    try:
        # From memory: HDF5 then never waits for a network, nor crashes on a file that is being truncated.
        with h5py.File(h5py.h5f.open_file_image(data)) as file:
            trajectory = _Reader(file, where).trajectory(serials)
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, MemoryError, OverflowError) as error:
        found = f"{len(data)} bytes that cannot be read as HDF5 ({str(error)[:200]})"
        raise InputError(where=where, found=found, needed="an undamaged trajectory.h5", fix=_FIX) from None
    steps = len(trajectory.states)
    for serial, count in frame_counts.items():
        if abs(steps - count) > 1:
            found = f"{steps} steps, but {count} frames in {serial}.mp4"
            needed = "a frame for every step; the last one may be missing"
            raise InputError(where=where, found=found, needed=needed, fix=_FIX)
    return trajectory.at(np.arange(min(steps, *frame_counts.values())))


@dataclass(frozen=True)
class _Reader:
    """Reads arrays from an untrusted HDF5 file."""

    file: Any
    where: str

    def trajectory(self, serials: Sequence[str]) -> Trajectory:
        pose = self.required(_POSE, 6, None)
        steps = len(pose)
        if steps == 0:
            raise zero_steps(self.where)
        skipped = self.optional(_SKIP, 1, steps)
        return Trajectory(
            states=np.concatenate([pose, self.required(_GRIPPER, 1, steps)], axis=1),
            frame_places=np.arange(steps),
            skipped=np.zeros(steps, bool) if skipped is None else skipped[:, 0] != 0,
            extrinsics={
                serial: self.optional(f"observation/camera_extrinsics/{serial}_left", 6, steps) for serial in serials
            },
            joint_velocities=self.optional(_JOINT_VELOCITY, _JOINTS, steps),
        )

    def required(self, name: str, width: int, steps: int | None) -> Float64[np.ndarray, "steps width"]:
        """Return an array of `width` numbers per step; for one number, the second axis may be missing."""
        found = self.optional(name, width, steps)
        if found is None:
            there = ", ".join(sorted(self.file))[:200]
            raise InputError(where=f"{self.where}: {name}", found=f"no such array; there are {there}", fix=_FIX)
        return found

    def _here(self, name: str) -> Any:
        """Return the object of a name in this file, or None: a link may lead to any other local file."""
        found: Any = self.file
        for part in name.split("/"):
            if not hasattr(found, "keys") or part not in found.keys():  # noqa: SIM118 - `in` would follow a link
                return None
            kind = type(found.get(part, getlink=True)).__name__
            found = found[part] if kind == "HardLink" else None
            if found is None or getattr(found, "is_virtual", False) or getattr(found, "external", None):
                needed, where = "the numbers themselves", f"{self.where}: {name}"
                raise InputError(where=where, found="a link to somewhere else", needed=needed, fix=_FIX)
        return found

    def optional(self, name: str, width: int, steps: int | None) -> Float64[np.ndarray, "steps width"] | None:
        """Return an array likewise, or None if the name does not exist."""
        data = self._here(name)
        if data is None:
            return None
        shape, kind = tuple(getattr(data, "shape", None) or ()), getattr(getattr(data, "dtype", None), "kind", "?")
        rows = shape[0] if shape else 0
        as_asked = shape == (rows, width) or (width == 1 and shape == (rows,))
        if not as_asked or rows != (rows if steps is None else steps) or rows > _MOST_STEPS or kind not in "fiub":
            found, needed = f"shape {shape} of kind {kind!r}", f"{width} numbers for each of {steps or 'the'} steps"
            raise InputError(where=f"{self.where}: {name}", found=found, needed=needed, fix=_FIX)
        values = np.asarray(data[()], dtype=np.float64).reshape(-1, width)
        if not np.isfinite(values).all():
            step = int((~np.isfinite(values)).any(axis=1).argmax())
            found, needed = f"{values[step]} at step {step}", "finite numbers"
            raise InputError(where=f"{self.where}: {name}", found=found, needed=needed, fix=_FIX)
        return values
