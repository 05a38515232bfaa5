"""Goals from one demonstration: key frames of an episode, with durations and gripper modes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.episode import FrameReader, Progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.goals.key_frames import (
    KeyFrame,
    StillRule,
    Timing,
    every_key_frame,
    gripper_key_frames,
    sub_goals_of,
)
from vjepa2_ac.planning.cameras import read_views, require_views
from vjepa2_ac.planning.goals import SubGoal, write_goals
from vjepa2_ac.storage.structured import utc_now

By = Literal["gripper", "every"]


@dataclass(frozen=True, eq=False)
class Recording:
    """A demonstration. A frame is a control step of an episode.

    Raises:
        InputError: It has one frame.
    """

    name: str
    frames: int
    read: FrameReader  # of frames at these positions
    states: Float[np.ndarray, "frames 7"] | None  # None: nothing was measured, or the states are no poses
    origin: Mapping[str, Any]  # where it comes from, as plain values

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise InputError(where=self.name, found=f"{self.frames} frames", needed="2 at least")


def recording_of_episode(
    config: DataConfig, wanted: str, progress: Progress | None = None, *, views: int = 1
) -> Recording:
    """Return an episode of a data set.

    Args:
        config: The data set, and which camera, or cameras.
        wanted: The episode's name in the data, or its number among the episodes, from 0.
        progress: Called with (done, total) while the data set is indexed for the first time.
        views: How many of the cameras are seen side by side, from the first on.

    Raises:
        InputError: There is no such episode, it cannot be read, the data are latents without frames, or there are not
            as many cameras.
    """
    require_views(config, views)
    dataset = open_dataset(config, progress=progress)
    return recording_of(dataset, number_of_episode(dataset, wanted), views)


def recording_of(dataset: Dataset, index: int, views: int = 1) -> Recording:
    """Return an episode of an open data set, with so many of its cameras side by side.

    Raises:
        InputError: It cannot be read.
    """
    config, name = dataset.config, dataset.table.identity(index)
    episode = dataset.source.read(index, config.cameras[0])
    origin = {"data": config.path, "episode": name, "camera": config.camera}
    states = episode.states if config.states == "pose" else None
    return Recording(name, len(episode.states), partial(read_views, dataset, index, views), states, origin)


def number_of_episode(dataset: Dataset, wanted: str) -> int:
    """Return which episode of a data set is meant by its name, or by its number, from 0.

    Raises:
        InputError: There is no such episode.
    """
    table, index = dataset.table, dataset.table.find(wanted)
    if index is None and wanted.isdecimal() and len(wanted) < 10 and int(wanted) < len(table):
        index = int(wanted)
    if index is None:
        found = f"no such episode in {dataset.config.path}"
        needed = f"a name such as {table.identity(int(dataset.episodes[0]))}, or a number from 0 to {len(table) - 1}"
        raise InputError(where=f"--episode {wanted}", found=found, needed=needed)
    return index


def frame_of_episode(config: DataConfig, place: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the image at EPISODE:STEP of a data set, or the last one of EPISODE.

    Raises:
        InputError: There is no such episode or step, or it cannot be read.
    """
    name, _, step = place.rpartition(":") if re.fullmatch(r".+:\d+", place) else (place, "", "")
    require_frames(config, to="take a goal from")
    dataset = open_dataset(config)
    episode = dataset.source.read(number_of_episode(dataset, name))
    count = len(episode.states)
    if step and int(step) >= count:
        found = f"an episode of {counted(count, 'step')}"
        raise InputError(where=f"--goal-from {place}", found=found, needed="one of them, from 0")
    return np.asarray(episode.read_frames([int(step) if step else count - 1])[0])


@dataclass(frozen=True)
class KeyFrameOptions(Timing):
    """Which frames become goals, and how long each may take."""

    by: By = "gripper"
    every: int | None = None  # frames, by `every`
    apart: int = StillRule.apart  # least frames between a stop and another goal
    stride: int = 4  # frames of a model step


@dataclass(frozen=True, eq=False)
class MadeGoals:
    """The goals of a demonstration, and what is known about them."""

    recording: Recording
    options: KeyFrameOptions
    keys: tuple[KeyFrame, ...]
    goals: tuple[SubGoal, ...]
    first: UInt8[np.ndarray, "height width 3"]  # the first frame of the demonstration

    def write(self, folder: Path) -> Path:
        """Write the folder of goals, and return the path of its goals.json.

        Raises:
            InputError: It cannot be written.
        """
        about = {"by": self.options.by, "every": self.options.every, "stride": self.options.stride}
        made = {"frames": self.recording.frames, "version": __version__, "time": utc_now()}
        return write_goals(
            folder,
            self.goals,
            frames=[key.frame for key in self.keys],
            origin={**self.recording.origin, **about, **made},
        )


def make_goals(recording: Recording, options: KeyFrameOptions) -> MadeGoals:
    """Return the key frames of a demonstration as goals.

    Raises:
        InputError: The demonstration has no poses, and the options need them.
    """
    if options.by == "every":
        keys = every_key_frame(recording.frames, options.every or 1)
    elif recording.states is None:
        found, needed = f"{recording.name}: no measured poses", "an episode with poses and gripper"
        raise InputError(where="goals", found=found, needed=needed, fix="Take every n-th frame: --every N")
    else:
        keys = gripper_key_frames(recording.states, StillRule(apart=options.apart))
    first, *images = recording.read([0, *(key.frame for key in keys)])
    return MadeGoals(recording, options, keys, sub_goals_of(images, keys, options, recording.states), first)
