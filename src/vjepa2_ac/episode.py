"""Data records: Episode -> Clip -> Batch -> LatentBatch, and the conventions of axes, units and coordinate frames.

Axes
    batch    clips that are computed together
    time     model steps: consecutive model steps are `stride` control steps apart
    steps    control steps of an episode (DROID: 15 per second)
    height, width, channel   pixels, RGB, uint8
    tokens   patches of one frame, row by row (256 at 256 px)
    dim      width of a latent (1408 for ViT-g)

State (7 numbers, a pose): x, y, z in metres; roll, pitch, yaw in radians, as extrinsic xyz Euler angles; gripper
    gripper position, 0 open .. 1 closed. All in the robot base frame (x to the robot's front, y to its left, z up); the
    point is the flange, not the finger tip. States are *measured*. With `data.states: vector` a state is a
    vector of state_dim numbers from the source.

Action (7 numbers, of a pose): the change from a state to the state of the next *model* step: metres, extrinsic xyz
    Euler angles of R[t+1] @ R[t].T, and the change of gripper position. See `spaces.actions_from_states`. For vectors
    see `data.actions`.

Extrinsics (6 numbers): the camera in the robot base frame: x, y, z, roll, pitch, yaw.

A clip of T frames has T states and T - 1 actions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Int, Num, UInt8

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Progress = Callable[[int, int], None]  # done, total


def no_progress(done: int, total: int) -> None:
    """Ignore the progress."""


def shorten_names(names: Sequence[str]) -> dict[str, str]:
    """Return the shortest end of each episode name that distinguishes it from the other names.

    Common endings of all names, such as trajectory.h5, are removed. A single name is returned unchanged.
    """
    parts, short, count = {name: name.split("/") for name in names}, dict.fromkeys(names, ""), 0
    while len({part[-1] for part in parts.values()}) == 1 < min(map(len, parts.values())):
        parts = {name: part[:-1] for name, part in parts.items()}
    while len(set(short.values())) < len(parts) > 1:
        count += 1
        short = {name: "/".join(part[-count:]) for name, part in parts.items()}
    return short if count else {name: name for name in names}


STATE_DIM = 7  # of a pose
ACTION_DIM = 7
EXTRINSICS_DIM = 6


class Widths(NamedTuple):
    """The widths (number of components) of a state and an action."""

    state: int
    action: int


POSE_WIDTHS = Widths(STATE_DIM, ACTION_DIM)


FrameReader = Callable[[Sequence[int]], UInt8[np.ndarray, "time height width 3"]]
"""Reads RGB frames of one camera of one episode: those at the given control steps, in this order."""


@dataclass(frozen=True)
class StoredLatents:
    """Latents of frames in the type of the cache. `latent_files.unpack_latents` converts them to float32."""

    values: Num[Tensor, "*batch time tokens dim"]  # bfloat16, float32 or int8
    scales: Float32[Tensor, "*batch time tokens"] | None = None  # for int8: the scale of each token

    def map_tensors(self, change: Callable[[Tensor], Tensor]) -> StoredLatents:
        """Return the latents with each tensor replaced by the result of `change`."""
        return StoredLatents(change(self.values), None if self.scales is None else change(self.scales))


LatentReader = Callable[[Sequence[int]], StoredLatents]
"""Reads latents of one camera of one episode from a cache: those at the given control steps, in this order."""


@dataclass(frozen=True, slots=True)
class EpisodeInfo:
    """Facts about an episode that are known without its frames: enough to select clips from it."""

    id: str  # independent of the order of episodes and the number of shards
    num_steps: int
    success: bool | None = None  # None: not recorded


@dataclass(frozen=True)
class Episode:
    """One demonstration: states of every control step, and frames of one camera that are read on request."""

    info: EpisodeInfo
    states: Float[np.ndarray, "steps state_dim"]
    read_frames: FrameReader
    control_rate_hz: float
    extrinsics: Float[np.ndarray, "steps 6"] | None = None  # of the camera
    joint_velocities: Float[np.ndarray, "steps joints"] | None = None  # *commanded*, radians per second
    metadata: Mapping[str, str] = field(default_factory=dict)  # language instruction and the like; never interpreted
    commands: Float[np.ndarray, "steps action_dim"] | None = None  # recorded actions, if `data.actions` requests them
    read_latents: LatentReader | None = None  # of a cache; its `read_frames` returns small frames for display
    frame_steps: Int[np.ndarray, " frames"] | None = None  # control steps that have a frame, ascending; None: all


@dataclass(frozen=True)
class SkippedClip:
    """A clip of a batch that could not be read (`data.broken_episodes: skip`)."""

    episode_id: str
    reason: str
    replayed: bool = False  # a clip of the second data set


@dataclass(frozen=True)
class Clip:
    """A window of an episode at the model's step length: frames, cropped but not yet resized, or latents of a cache."""

    frames: UInt8[np.ndarray, "time height width 3"] | None  # None: there are latents
    states: Float32[np.ndarray, "time state_dim"]
    actions: Float32[np.ndarray, "time-1 action_dim"]
    extrinsics: Float32[np.ndarray, "time 6"] | None
    episode_id: str
    start: int  # first control step
    stride: int  # control steps per model step
    latents: StoredLatents | None = None
    camera: str | None = None  # None: the config's first


@dataclass(frozen=True)
class Batch:
    """Clips stacked for the device: pixels as uint8, and cached latents in the dtype of the cache."""

    frames: UInt8[Tensor, "batch time height width 3"] | None  # None: there are latents
    states: Float32[Tensor, "batch time state_dim"]
    actions: Float32[Tensor, "batch time-1 action_dim"]
    extrinsics: Float32[Tensor, "batch time 6"] | None
    episode_ids: tuple[str, ...]
    starts: tuple[int, ...]
    bytes_fetched: int = 0  # over the network, for these clips
    latents: StoredLatents | None = None
    cameras: tuple[str | None, ...] = ()  # one per clip; None: the config's first
    skipped: tuple[SkippedClip, ...] = ()  # clips that could not be read

    def map_tensors(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """Return the batch with each tensor replaced by the result of `change`."""
        return replace(
            self,
            frames=None if self.frames is None else change(self.frames),
            states=change(self.states),
            actions=change(self.actions),
            extrinsics=None if self.extrinsics is None else change(self.extrinsics),
            latents=None if self.latents is None else self.latents.map_tensors(change),
        )

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> Batch:
        """Return the batch with its tensors on a device."""
        return self.map_tensors(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Batch:
        """Return the batch in pinned memory, from which copies to the device do not block the host.

        DataLoader calls a method of this name to pin.
        """
        return self.map_tensors(lambda tensor: tensor.pin_memory())

    @property
    def nbytes(self) -> int:
        """Size of all tensors in bytes."""
        latents = () if self.latents is None else (self.latents.values, self.latents.scales)
        tensors = (self.frames, self.states, self.actions, self.extrinsics, *latents)
        return sum(tensor.nbytes for tensor in tensors if tensor is not None)


@dataclass(frozen=True)
class LatentBatch:
    """The input of training, evaluation and planning: layer-normalised latents in place of pixels."""

    latents: Float[Tensor, "batch time tokens dim"]
    states: Float[Tensor, "batch time state_dim"]
    actions: Float[Tensor, "batch time-1 action_dim"]
    extrinsics: Float[Tensor, "batch time 6"] | None
    episode_ids: tuple[str, ...]
    starts: tuple[int, ...]

    def select_clip(self, row: int) -> LatentBatch:
        """Return one clip, as a batch."""
        rows = slice(row, row + 1)
        extrinsics = None if self.extrinsics is None else self.extrinsics[rows]
        tensors = self.latents[rows], self.states[rows], self.actions[rows], extrinsics
        return LatentBatch(*tensors, self.episode_ids[rows], self.starts[rows])


StepRanges = Sequence[tuple[int, int]]  # [start, end) of control steps, ascending and disjoint


@runtime_checkable
class EpisodeSource(Protocol):
    """A set of episodes in a fixed order, independent of clips, crops and batches.

    It can be pickled to a loader worker, and read from several threads at once.
    """

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        """Return the facts about every usable episode, in the order of `read`.

        The first call may be slow, and calls `progress`. Later calls are fast, because the result is cached on disk.

        Raises:
            InputError: There is no such data set, or it is damaged beyond what `data.broken_episodes` allows.
        """
        ...

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return one episode; no frame is read or decoded before `Episode.read_frames` requests it.

        Args:
            index: Index in `infos`.
            camera: Name of the camera; None: the first camera of the config.
            needed: Steps that clips may come from; None: all. A remote source caches only these steps.

        Raises:
            InputError: The episode cannot be read, or does not match the data set's description.
        """
        ...
