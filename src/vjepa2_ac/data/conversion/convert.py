"""Writes any data set that can be read as a LeRobot data set v3.0."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, IdleConfig
from vjepa2_ac.data.conversion.lerobot_writer import LeRobotWriter
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.sources.lerobot.info import INFO
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.reporter import INDEXING, Reporter

STATE, ACTION, SUCCESS, CAMERA = "observation.state", "action", "is_episode_successful", "observation.images."

_FRAMES_AT_ONCE = 32  # in memory


def convert_to_lerobot(config: DataConfig, folder: Path, reporter: Reporter) -> tuple[int, int]:
    """Write a data set as LeRobot v3.0, and return how many episodes and control steps were written.

    The episodes that `data.exclude` and `data.outcome` leave are written whole, with idle steps, in the order of the
    source: measured states, recorded commands if `data.actions` is recorded or else the change to the next control step
    (0 at the last one), frames of all cameras of `data.camera`, task and success. The folder appears complete.

    Args:
        config: Where the data are and how they are read.
        folder: A new or empty folder.
        reporter: Shows the progress.

    Raises:
        InputError: The data set cannot be read or is a latent cache, an episode is broken and `data.broken_episodes`
            does not skip it, or the folder cannot be written.
        UnreachableError: pyarrow or PyAV is not installed.
    """
    require_frames(config, to="write its frames")
    if wrong := [camera for camera in config.cameras if "/" in camera]:
        raise InputError(where="data.camera", found=repr(wrong[0]), needed="a name without /, as LeRobot requires")
    dataset = open_dataset(config.model_copy(update={"idle": IdleConfig()}), progress=reporter.task(INDEXING))
    episodes = np.flatnonzero(dataset.taking_part).tolist()
    is_known = dataset.table.success[episodes] >= 0
    if is_known.any() and not is_known.all():
        reporter.note(f"Success is left out: {(~is_known).sum()} of {counted(len(episodes), 'episode')} lack it.")
    progress, spaces = reporter.task("writing episodes"), dataset.spaces
    names = {STATE: spaces.state.names, ACTION: spaces.action.names}
    with (
        storage.folder_writer(folder, INFO) as filling,
        closing(LeRobotWriter(filling, dataset.control_rate_hz, names)) as writer,
    ):
        for done, index in enumerate(episodes, start=1):
            try:
                _add(writer, dataset, index, has_success=bool(is_known.all()))
            except InputError as error:
                dataset.leave_out(index, error)
            progress(done, len(episodes))
        writer.finish()
    return writer.num_episodes, writer.num_steps


def _add(writer: LeRobotWriter, dataset: Dataset, index: int, *, has_success: bool) -> None:
    by_camera = {camera: dataset.read(index, camera) for camera in dataset.config.cameras}
    recording = next(iter(by_camera.values()))
    columns = {STATE: recording.states.astype(np.float32), ACTION: _actions(recording, dataset)}
    if has_success:
        columns[SUCCESS] = np.full((len(recording.states), 1), dataset.table[index].success)
    frames = {CAMERA + camera: _frames(one) for camera, one in by_camera.items()}
    writer.add(columns, frames, recording.metadata.get("language", ""))


def _actions(recording: Episode, dataset: Dataset) -> Float32[np.ndarray, "steps action_dim"]:
    if recording.commands is not None:
        return recording.commands.astype(np.float32)
    actions = np.zeros(recording.states.shape, np.float32)
    if len(actions) > 1:
        actions[:-1] = dataset.spaces.state.differences(recording.states)
    return actions


def _frames(recording: Episode) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    steps = range(len(recording.states))
    for first in steps[::_FRAMES_AT_ONCE]:
        yield from recording.read_frames(steps[first : first + _FRAMES_AT_ONCE])
