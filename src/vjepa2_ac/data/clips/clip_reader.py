"""Clips from the steps and frames of an episode, and batches from clips."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.clips.actions import actions_of, require_widths
from vjepa2_ac.data.clips.dataset import Dataset
from vjepa2_ac.data.clips.transforms import view
from vjepa2_ac.data.filters.exclusion import with_way_out
from vjepa2_ac.episode import Augmentation, Batch, Clip, Episode, StoredLatents, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.geometry import states_in_camera_frame

Augment = Callable[[int, int], Augmentation | None]  # from the height and width of a clip's frames


@dataclass(frozen=True)
class ClipRequest:
    """A request for the clip that starts at a control step of an episode."""

    episode: int  # index into the data set's table
    start: int  # first control step
    camera: str | None = None  # whose frames; None: the config's (first) camera
    augmentation: Augment | None = None  # draws the augmentation


def collate(clips: Sequence[Clip], bytes_fetched: int = 0) -> Batch:
    """Stack clips into a batch; it has camera poses if each of the clips has.

    Raises:
        InputError: The frames of two clips differ in size.
    """
    frames = [clip.frames for clip in clips if clip.frames is not None]
    latents = [clip.latents for clip in clips if clip.latents is not None]
    if frames:
        _require_one_size(clips)
    extrinsics = [clip.extrinsics for clip in clips if clip.extrinsics is not None]
    augmentations = tuple(clip.augmentation for clip in clips if clip.augmentation is not None)
    return Batch(
        frames=torch.from_numpy(np.stack(frames)) if frames else None,
        states=torch.from_numpy(np.stack([clip.states for clip in clips])),
        actions=torch.from_numpy(np.stack([clip.actions for clip in clips])),
        extrinsics=torch.from_numpy(np.stack(extrinsics)) if len(extrinsics) == len(clips) else None,
        episode_ids=tuple(clip.episode_id for clip in clips),
        starts=tuple(clip.start for clip in clips),
        augmentations=augmentations,
        bytes_fetched=bytes_fetched,
        latents=joined_latents(latents, torch.stack) if latents else None,
        cameras=tuple(clip.camera for clip in clips),
    )


def frames_of(dataset: Dataset, batch: Batch, row: int) -> UInt8[np.ndarray, "time height width 3"]:
    """Return the frames of a clip of a batch, cropped, for people to look at; small frames for cached latents.

    Raises:
        InputError: The frames of a cache cannot be read.
        ValueError: The clip belongs to another data set.
    """
    if batch.frames is not None:
        return batch.frames[row].numpy()
    episode, start = dataset.table.find(batch.episode_ids[row]), batch.starts[row]
    if episode is None:
        raise ValueError(f"no episode {batch.episode_ids[row]}")
    steps = range(start, start + dataset.config.clip_steps, dataset.config.model_stride)
    return view(dataset.source.read(episode, batch.cameras[row]).read_frames(steps), dataset.config.crop)


def _require_one_size(clips: Sequence[Clip]) -> None:
    shapes = [(clip.frames.shape, clip) for clip in clips if clip.frames is not None]
    first_shape, first = shapes[0]
    for shape, clip in shapes:
        if shape != first_shape:
            error = InputError(
                where=f"episode {clip.episode_id}",
                found=f"frames of {'x'.join(map(str, shape[1:3]))} after the crop",
                needed=f"{'x'.join(map(str, first_shape[1:3]))}, as in episode {first.episode_id}",
                fix="Train on episodes of one size, or set training.batch_size: 1",
            )
            raise with_way_out(error, [clip.episode_id], skippable=False)


def joined_latents(latents: Sequence[StoredLatents], join: Callable[[list[Tensor]], Tensor]) -> StoredLatents:
    """Return latents joined by `torch.stack` or `torch.cat`, and their scales likewise."""
    scales = [one.scales for one in latents if one.scales is not None]
    return StoredLatents(join([one.values for one in latents]), join(scales) if scales else None)


def read_clip(dataset: Dataset, request: ClipRequest) -> Clip:
    """Return a clip; decodes its frames only.

    Raises:
        InputError: The episode or one of the frames cannot be read; does not say how to leave the episode out.
    """
    config = dataset.config
    steps = range(request.start, request.start + config.clip_steps, config.model_stride)
    recording = dataset.source.read(request.episode, request.camera, dataset.needed_steps(request.episode))
    require_widths(recording, dataset.widths)
    frames = latents = augmentation = None
    if recording.read_latents is not None:
        latents = recording.read_latents(steps)
    else:
        frames = view(recording.read_frames(steps), config.crop)
        if request.augmentation is not None:
            augmentation = request.augmentation(frames.shape[1], frames.shape[2])
    states, extrinsics = _states(recording, list(steps), in_camera_frame=config.pose_frame == "camera")
    return Clip(
        frames=frames,
        states=states.astype(np.float32),
        actions=actions_of(states, recording.commands, steps, config).astype(np.float32),
        extrinsics=None if extrinsics is None else extrinsics.astype(np.float32),
        episode_id=recording.info.id,
        start=request.start,
        stride=config.model_stride,
        augmentation=augmentation,
        latents=latents,
        camera=request.camera,
    )


def _states(
    recording: Episode, steps: list[int], *, in_camera_frame: bool
) -> tuple[Float[np.ndarray, "time state_dim"], Float[np.ndarray, "time 6"] | None]:
    """Return states and camera poses at some steps."""
    states = recording.states[steps]
    extrinsics = None if recording.extrinsics is None else recording.extrinsics[steps]
    if not in_camera_frame:
        return states, extrinsics
    if extrinsics is None:
        raise InputError(
            where=f"episode {recording.info.id}",
            found="no pose of the camera",
            needed="one, for data.pose_frame: camera",
            fix="Set data.pose_frame: base, or choose a camera that has one",
        )
    return states_in_camera_frame(states, extrinsics), extrinsics


def no_clips(frames: int, widths: Widths, bytes_fetched: int) -> Batch:
    """Return an empty micro-batch, of which no clip could be read."""
    return Batch(
        frames=torch.zeros(0, frames, 1, 1, 3, dtype=torch.uint8),
        states=torch.zeros(0, frames, widths.state),
        actions=torch.zeros(0, frames - 1, widths.action),
        extrinsics=None,
        episode_ids=(),
        starts=(),
        bytes_fetched=bytes_fetched,
    )
