"""Clips of episodes, batches of clips, and a `torch.utils.data.Dataset` of clips."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, SupportsIndex

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset
from torch.utils.data._utils.collate import default_collate_fn_map

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.files import map_in_threads
from vjepa2_ac.data.selection import add_exclusion_fix
from vjepa2_ac.data.sources.indexed_source import get_state_space
from vjepa2_ac.data.transforms import crop_frames
from vjepa2_ac.episode import Batch, Clip, Episode, StoredLatents, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import states_in_camera_frame


@dataclass(frozen=True)
class ClipRequest:
    """A request for the clip that starts at a control step of an episode."""

    episode: int  # index into the data set's table
    start: int  # first control step
    camera: str | None = None  # camera of the frames; None: the first camera of the config


@dataclass(frozen=True)
class ClipDataset(TorchDataset[Clip]):
    """A data set of the clips of a split, for any `torch.utils.data.DataLoader`; see `dataset.Dataset.clips`."""

    read: Callable[[int], Clip]
    count: int
    connections: int  # number of clips that are read concurrently

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: SupportsIndex) -> Clip:
        """Return a clip; a negative index counts from the end.

        Raises:
            IndexError: There is no such clip.
            InputError: The clip cannot be read.
        """
        return self.read(range(self.count)[index])

    def __getitems__(self, indices: Sequence[SupportsIndex]) -> list[Clip]:
        """Return several clips for a DataLoader; clips behind a URL are read concurrently."""
        return list(map_in_threads(self.__getitem__, indices, self.connections))


def cut_clip(recording: Episode, request: ClipRequest, config: DataConfig) -> Clip:
    """Return a clip of an episode, decoding only the frames of the clip.

    Raises:
        InputError: A frame cannot be read, or `data.pose_frame` is camera and the camera's pose is unknown.
    """
    steps = range(request.start, request.start + config.clip_steps, config.model_stride)
    frames = latents = None
    if recording.read_latents is not None:
        latents = recording.read_latents(steps)
    else:
        frames = crop_frames(recording.read_frames(steps), config.crop)
    states = recording.states[list(steps)]
    extrinsics = None if recording.extrinsics is None else recording.extrinsics[list(steps)]
    if config.pose_frame == "camera":
        if extrinsics is None:
            fix = "Set data.pose_frame: base, or choose a camera with a known pose"
            raise InputError(where=f"episode {recording.info.id}", found="no camera pose", fix=fix)
        states = states_in_camera_frame(states, extrinsics)
    return Clip(
        frames=frames,
        states=states.astype(np.float32),
        actions=compute_actions(states, recording.commands, steps, config).astype(np.float32),
        extrinsics=None if extrinsics is None else extrinsics.astype(np.float32),
        episode_id=recording.info.id,
        start=request.start,
        stride=config.model_stride,
        latents=latents,
        camera=request.camera,
    )


def compute_actions(
    states: Float[np.ndarray, "time state_dim"],
    commands: Float[np.ndarray, "steps action_dim"] | None,
    steps: Sequence[int],
    config: DataConfig,
) -> Float[np.ndarray, "time-1 action_dim"]:
    """Return the actions between consecutive model steps of a clip.

    Args:
        states: States at the steps of the clip, in the config's coordinate frame.
        commands: Recorded commands of all control steps of the episode; used only with `data.actions: recorded`.
        steps: Control steps of the clip, equally spaced.
        config: Defines an action with `data.actions` and `data.join_actions`.

    Raises:
        ValueError: Commands are required and the episode has none.
    """
    if config.actions == "difference":
        return get_state_space(config, states.shape[1]).compute_differences(states)
    if commands is None:
        raise ValueError("the episode has no recorded commands")
    return join_commands(commands[steps[0] : steps[-1]], config.model_stride, config.join_actions)


def join_commands(
    commands: Float[np.ndarray, "steps action_dim"], stride: int, operation: str | None
) -> Float[np.ndarray, "model_steps action_dim"]:
    """Join the commands of each model step into one action: their sum, their mean, or the last command.

    The command of a control step is sent after the state of that step was measured, so the model step from control
    step t to t + stride joins the commands of the control steps t to t + stride - 1.
    """
    groups = commands.reshape(-1, stride, commands.shape[1])
    if operation == "sum":
        return np.asarray(groups.sum(axis=1))
    if operation == "mean":
        return np.asarray(groups.mean(axis=1))
    return groups[:, -1]  # also for stride 1, where a group has one command


def collate(clips: Sequence[Clip]) -> Batch:
    """Stack clips into a batch; the batch has camera poses only if all clips have them.

    Raises:
        InputError: The frames of two clips differ in size.
    """
    frames = [clip.frames for clip in clips if clip.frames is not None]
    sizes = [
        ("x".join(map(str, array.shape[1:3])), clip.episode_id) for array, clip in zip(frames, clips, strict=False)
    ]
    first_size, first_episode = sizes[0] if sizes else ("", "")
    for size, episode in sizes:
        if size != first_size:
            problem = (
                f"frames of {size} pixels after the crop, but the frames of episode {first_episode} have {first_size}"
            )
            fix = "Train on episodes with frames of one size, or set training.batch_size: 1"
            raise add_exclusion_fix(InputError(where=f"episode {episode}", found=problem, fix=fix), [episode])
    latents = [clip.latents for clip in clips if clip.latents is not None]
    extrinsics = [clip.extrinsics for clip in clips if clip.extrinsics is not None]
    return Batch(
        frames=torch.from_numpy(np.stack(frames)) if frames else None,
        states=torch.from_numpy(np.stack([clip.states for clip in clips])),
        actions=torch.from_numpy(np.stack([clip.actions for clip in clips])),
        extrinsics=torch.from_numpy(np.stack(extrinsics)) if len(extrinsics) == len(clips) else None,
        episode_ids=tuple(clip.episode_id for clip in clips),
        starts=tuple(clip.start for clip in clips),
        latents=join_latents(latents, torch.stack) if latents else None,
        cameras=tuple(clip.camera for clip in clips),
    )


def _collate_by_default(clips: Sequence[Clip], **_: Any) -> Batch:
    return collate(clips)


default_collate_fn_map[Clip] = _collate_by_default  # PyTorch documents this as the way to extend `default_collate`


def join_latents(latents: Sequence[StoredLatents], join: Callable[[list[Tensor]], Tensor]) -> StoredLatents:
    """Join latents and their scales with `torch.stack` or `torch.cat`."""
    scales = [stored.scales for stored in latents if stored.scales is not None]
    return StoredLatents(join([stored.values for stored in latents]), join(scales) if scales else None)


def empty_batch(frames: int, widths: Widths) -> Batch:
    """Return an empty micro-batch, used if none of its clips could be read."""
    return Batch(
        frames=torch.zeros(0, frames, 1, 1, 3, dtype=torch.uint8),
        states=torch.zeros(0, frames, widths.state),
        actions=torch.zeros(0, frames - 1, widths.action),
        extrinsics=None,
        episode_ids=(),
        starts=(),
    )
