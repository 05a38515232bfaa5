"""Real recordings for tests: H.264 MP4s, and DROID's raw folders with HDF5."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
from jaxtyping import UInt8


def write_mp4(
    path: str | Path,
    camera_frames: Sequence[UInt8[np.ndarray, "height width 3"]],
    *,
    rate: int = 15,
    gop: int = 12,
    b_frames: int = 0,
    codec: str = "libx264",
    times: Sequence[int] | None = None,
    container: Mapping[str, str] | None = None,
    **options: str,
) -> Path:
    """Write images as a video with one key frame every `gop` frames; `times` are frame times in 1/15360 s."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=dict(container or {})) as file:
        stream = file.add_stream(codec, rate=rate)
        stream.height, stream.width = camera_frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 15360 if times else rate)
        fast = {"preset": "ultrafast"} if codec == "libx264" else {}
        scenes = {"sc_threshold": "0", "bf": str(b_frames)} if codec == "libx264" else {}
        stream.codec_context.options = fast | scenes | {"g": str(gop)} | options
        stream.codec_context.thread_count = 1
        for number, picture in enumerate(camera_frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts = times[number] if times else number
            frame.time_base = stream.codec_context.time_base
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return Path(path)


def write_raw_droid(
    folder: str | Path,
    states: np.ndarray,
    *,
    frames_by_serial: Mapping[str, Sequence[np.ndarray]],
    success: bool = True,
    skipped: Sequence[int] = (),
    extrinsics: Mapping[str, np.ndarray] | None = None,
    joint_velocities: np.ndarray | None = None,
    language: str = "move to place 0",
    **video: Any,
) -> Path:
    """Write one episode as DROID's raw data is; `frames_by_serial` are of the left, the right, the wrist camera."""
    target = Path(folder)
    target.mkdir(parents=True)
    with h5py.File(target / "trajectory.h5", "w") as file:
        file["observation/robot_state/cartesian_position"] = states[:, :6]
        file["observation/robot_state/gripper_position"] = states[:, 6]
        file["observation/timestamp/skip_action"] = np.isin(np.arange(len(states)), skipped)
        file["action/cartesian_position"] = states[:, :6] + 0.01  # commanded, not measured; must never be read
        if joint_velocities is not None:
            file["action/joint_velocity"] = joint_velocities
        for serial, poses in (extrinsics or {}).items():
            file[f"observation/camera_extrinsics/{serial}_left"] = poses
    for serial, camera_frames in frames_by_serial.items():
        write_mp4(target / "recordings/MP4" / f"{serial}.mp4", camera_frames, **video)
    names = dict(zip(("left", "right", "wrist"), frames_by_serial, strict=False))
    paths = {f"{name}_mp4_path": f"success/any/recordings/MP4/{serial}.mp4" for name, serial in names.items()}
    metadata = {"uuid": target.name, "success": success, "current_task": language, **paths}
    (target / f"metadata_{target.name}.json").write_text(json.dumps(metadata))
    return target
