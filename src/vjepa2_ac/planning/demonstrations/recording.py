"""A recorded demonstration: its frames, and the measured states where there are any."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.episode import FrameReader, Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.video_reader import count_frames, read_frames
from vjepa2_ac.storage import unreadable

_LEAST_FRAMES = 2


@dataclass(frozen=True, eq=False)
class Recording:
    """A demonstration. A frame is a control step of an episode, or a frame of a film."""

    name: str
    frames: int
    read: FrameReader  # of frames at these positions
    states: Float[np.ndarray, "frames 7"] | None  # None: nothing was measured, or the states are no poses
    rate_hz: float | None  # frames per second; None: not known
    origin: Mapping[str, Any]  # where it comes from, as plain values


def recording_of_episode(config: DataConfig, wanted: str, progress: Progress | None = None) -> Recording:
    """Return an episode of a data set.

    Args:
        config: The data set, and which camera.
        wanted: The episode's name in the data, or its number among the episodes, from 0.
        progress: Called with (done, total) while the data set is indexed for the first time.

    Raises:
        InputError: There is no such episode, it cannot be read, or the data are latents without frames.
    """
    if config.is_cache:
        fix = "Name the data set itself"
        raise InputError(
            where="data.source", found="latents, without frames", needed="frames to make goals of", fix=fix
        )
    dataset = open_dataset(config, progress=progress)
    index = _place_of(dataset, wanted)
    episode, name = dataset.source.read(index), dataset.table.identity(index)
    frames, where = len(episode.states), f"episode {name}"
    if frames < _LEAST_FRAMES:
        raise InputError(where=where, found=f"{frames} frames", needed=f"{_LEAST_FRAMES} at least")
    origin = {"data": config.path, "episode": name, "camera": config.camera}
    states = episode.states if config.states == "pose" else None
    return Recording(name, frames, episode.read_frames, states, episode.control_rate_hz, origin)


def _place_of(dataset: Dataset, wanted: str) -> int:
    place = dataset.table.find(wanted)
    if place is None and wanted.isdecimal() and len(wanted) < 10 and int(wanted) < len(dataset.table):
        return int(wanted)
    if place is None:
        example = dataset.table.identity(int(dataset.episodes[0]))
        needed = f"a name such as {example}, or a number from 0 to {len(dataset.table) - 1}"
        raise InputError(where=f"--episode {wanted}", found=f"no such episode in {dataset.config.path}", needed=needed)
    return place


def recording_of_film(path: Path) -> Recording:
    """Return a film, of which nothing is known but its frames.

    Raises:
        InputError: PyAV is not installed, or it is no MP4 of two frames or more.
    """
    where = str(path)
    try:
        frames = count_frames(path, where=where)
    except OSError as error:
        raise unreadable(where, error, needed="an MP4") from None
    if frames < _LEAST_FRAMES:
        raise InputError(where=where, found=f"{frames} frames", needed=f"{_LEAST_FRAMES} at least")
    return Recording(path.name, frames, partial(read_frames, path, where=where), None, None, {"film": where})
