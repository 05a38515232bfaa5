"""Goals from one demonstration: key frames of an episode, with durations and gripper modes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import find_episode, open_dataset
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.goals.key_frames import (
    KeyFrame,
    StillRule,
    Timing,
    find_gripper_key_frames,
    make_sub_goals,
    select_every_nth_frame,
)
from vjepa2_ac.planning.cameras import read_views, require_views
from vjepa2_ac.planning.goals import SubGoal, write_goals
from vjepa2_ac.storage.structured import utc_now


@dataclass(frozen=True)
class KeyFrameOptions(Timing):
    """Options for selecting key frames, and rules for their durations. A frame is a control step of an episode."""

    every: int | None = None  # distance in frames; None: frames at which the gripper changes or the arm stops
    apart: int = StillRule.min_distance  # smallest number of frames between a stop and another goal
    stride: int = 4  # frames per model step
    views: int = 1  # number of cameras whose images are side by side, beginning with the first

    @property
    def by(self) -> str:
        """The selection rule: "gripper", or "every" n-th frame."""
        return "gripper" if self.every is None else "every"


@dataclass(frozen=True, eq=False)
class DemonstrationGoals:
    """The goals of a demonstration, and a description of their source."""

    options: KeyFrameOptions
    keys: tuple[KeyFrame, ...]
    goals: tuple[SubGoal, ...]
    first: UInt8[np.ndarray, "height width 3"]  # the first frame of the demonstration
    frames: int  # number of frames of the demonstration
    states: Float[np.ndarray, "frames 7"] | None  # None: the states are not poses
    origin: Mapping[str, Any]  # source of the demonstration, as plain values

    def write(self, folder: Path) -> Path:
        """Write the folder of goals, and return the path of its goals.json.

        Raises:
            InputError: The folder cannot be written.
        """
        selection = {"by": self.options.by, "every": self.options.every, "stride": self.options.stride}
        creation = {"frames": self.frames, "version": __version__, "time": utc_now()}
        origin = {**self.origin, **selection, **creation}
        return write_goals(folder, self.goals, frames=[key.frame for key in self.keys], origin=origin)


def make_goals(
    config: DataConfig, episode_name: str, options: KeyFrameOptions, progress: Progress | None = None
) -> DemonstrationGoals:
    """Return the key frames of an episode of a data set as goals.

    Args:
        config: The data set and its camera or cameras.
        episode_name: The episode: its name in the data, its number from 0, or a part of its name.
        options: Options for selecting key frames.
        progress: Called with (done, total) while the data set is indexed for the first time.

    Raises:
        InputError: There is no such episode, it cannot be read, has only one frame, or has no poses although the
            options need them; or the data are latents without frames, or have too few cameras.
    """
    require_views(config, options.views)
    dataset = open_dataset(config, progress=progress)
    index = find_episode(dataset, episode_name)
    name, states = dataset.table.identity(index), dataset.source.read(index, config.cameras[0]).states
    if len(states) < 2:
        raise InputError(where=name, found=counted(len(states), "frame"), needed="at least 2")
    poses = states if config.states == "pose" else None
    if options.every is not None:
        keys = select_every_nth_frame(len(states), options.every)
    elif poses is None:
        problem, needed = "no measured poses", "an episode with poses and gripper"
        raise InputError(where=name, found=problem, needed=needed, fix="Use --every N to take every n-th frame")
    else:
        keys = find_gripper_key_frames(poses, StillRule(min_distance=options.apart))
    first, *images = read_views(dataset, index, options.views, [0, *(key.frame for key in keys)])
    goals, origin = make_sub_goals(images, keys, options, poses), {"data": config.path, "episode": name}
    return DemonstrationGoals(options, keys, goals, first, len(states), poses, {**origin, "camera": config.camera})


def read_episode_frame(config: DataConfig, text: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the image at EPISODE:STEP of a data set, or the last image of EPISODE.

    Raises:
        InputError: There is no such episode or step, or the episode cannot be read.
    """
    name, _, step = text.rpartition(":") if re.fullmatch(r".+:\d+", text) else (text, "", "")
    require_frames(config, to="read a goal image")
    dataset = open_dataset(config)
    episode = dataset.source.read(find_episode(dataset, name))
    num_steps = len(episode.states)
    if step and int(step) >= num_steps:
        problem = f"the episode has {counted(num_steps, 'step')}"
        raise InputError(where=f"--goal-from {text}", found=problem, needed=f"a step from 0 to {num_steps - 1}")
    return np.asarray(episode.read_frames([int(step) if step else num_steps - 1])[0])
