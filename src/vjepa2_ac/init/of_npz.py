"""A folder of .npz files: the arrays of the first one."""

from __future__ import annotations

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.sources.listing import walk, within
from vjepa2_ac.data.sources.npz import FORMAT_HELP, opened_npz
from vjepa2_ac.episode import STATE_DIM
from vjepa2_ac.errors import InputError
from vjepa2_ac.init.found import FoundData
from vjepa2_ac.init.knob import Knob
from vjepa2_ac.init.names import pick_camera

_CONNECTIONS = 8


def look_at_npz(path: str) -> FoundData:
    """Look at a folder of .npz files.

    Raises:
        InputError: There are none, or the first has no states, no rate or no frames.
    """
    files = sorted(within(folder, file.name) for folder, file in walk(path, _CONNECTIONS) if file.name.endswith(".npz"))
    if not files:
        raise InputError(where=path, found="no .npz files", needed="one for each episode", fix=FORMAT_HELP)
    where = storage.join(path, files[0])
    with opened_npz(where, where) as file:
        headers = {name: file.header(name) for name in file.names}
        missing = [name for name in ("states", "fps_hz") if name not in headers]
        cameras = [name for name, one in headers.items() if one.dtype == np.uint8 and len(one.shape) == 4]
        if missing or not cameras or len(headers["states"].shape) != 2:
            arrays = ", ".join(f"{name} {list(one.shape)} {one.dtype}" for name, one in headers.items())
            needed = "states [steps, 7], fps_hz and frames [steps, height, width, 3] of uint8"
            raise InputError(where=where, found=arrays or "no arrays", needed=needed, fix=FORMAT_HELP)
        rate = float(np.asarray(file.array("fps_hz")).reshape(-1)[0])
    steps, width = headers["states"].shape
    first = "frames" if "frames" in cameras else pick_camera(cameras)
    velocities = "joint_velocities" in headers
    is_pose = width == STATE_DIM
    return FoundData(
        source="npz",
        path=path,
        knobs={"camera": Knob(first, f"of {', '.join(cameras)}" if len(cameras) > 1 else "", len(cameras) > 1)},
        rate_hz=Knob(rate, f"of {files[0]}"),
        states="pose" if is_pose else "vector",
        episodes=len(files),
        idle={"rule": Knob("commands" if velocities else "motion", "pauses teach nothing")} if is_pose else None,
        sample=where,
        about=(f".npz, {len(files):,} episodes at {rate:g} a second, the first of {steps:,} steps",),
    )
