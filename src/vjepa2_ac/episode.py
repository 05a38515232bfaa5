"""What flows through the program? Episode -> Clip -> Batch -> LatentBatch, and the legend of axes, units and frames.

Axes
    batch    clips that are computed together
    time     model steps: neighbouring model steps are `stride` control steps apart
    steps    control steps of an episode (DROID: 15 per second)
    height, width, channel   pixels, RGB, uint8
    tokens   patches of one frame, row by row (256 at 256 px)
    dim      width of a latent (1408 for ViT-g)

State (7 numbers): x, y, z in metres; roll, pitch, yaw in radians, as extrinsic xyz Euler angles; gripper closedness,
    0 open .. 1 closed. All in the robot base frame; the point is the flange, not the finger tip. States are *measured*.

Action (7 numbers): what carries a state to the next *model* step's state: metres, extrinsic xyz Euler angles of
    R[t+1] @ R[t].T, and the change of closedness. See `geometry.actions_from_states`.

Extrinsics (6 numbers): the camera in the robot base frame: x, y, z, roll, pitch, yaw.

A clip of T frames has T states and T - 1 actions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, UInt8

if TYPE_CHECKING:
    from torch import Tensor

STATE_DIM = 7
ACTION_DIM = 7
EXTRINSICS_DIM = 6


@runtime_checkable
class FrameReader(Protocol):
    """Reads pictures of one camera of one episode, and only those that are asked for."""

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB pictures at these control steps, in this order."""
        ...


@dataclass(frozen=True)
class EpisodeInfo:
    """What is known of an episode without reading its pictures: enough to choose clips from it."""

    id: str  # the same whatever the order of episodes and the number of shards
    num_steps: int
    success: bool | None = None  # None: the data set does not say


@dataclass(frozen=True)
class Episode:
    """One demonstration: states of every control step, and pictures that are read when asked for."""

    info: EpisodeInfo
    states: Float[np.ndarray, "steps 7"]
    read_frames: FrameReader
    control_rate_hz: float
    extrinsics: Float[np.ndarray, "steps 6"] | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)  # language instruction and the like; never interpreted


@dataclass(frozen=True)
class Clip:
    """A window of an episode at the model's step length; frames are cropped, not yet resized."""

    frames: UInt8[np.ndarray, "time height width 3"]
    states: Float32[np.ndarray, "time 7"]
    actions: Float32[np.ndarray, "time-1 7"]
    extrinsics: Float32[np.ndarray, "time 6"] | None
    episode_id: str
    start: int  # first control step
    stride: int  # control steps per model step


@dataclass(frozen=True)
class Batch:
    """Clips stacked for the device; pixels stay uint8 until they are there."""

    frames: UInt8[Tensor, "batch time height width 3"]
    states: Float32[Tensor, "batch time 7"]
    actions: Float32[Tensor, "batch time-1 7"]
    extrinsics: Float32[Tensor, "batch time 6"] | None
    episode_ids: tuple[str, ...]
    starts: tuple[int, ...]


@dataclass(frozen=True)
class LatentBatch:
    """What training, evaluation and planning see: layer-normalised latents in place of pixels."""

    latents: Float[Tensor, "batch time tokens dim"]
    states: Float[Tensor, "batch time 7"]
    actions: Float[Tensor, "batch time-1 7"]
    extrinsics: Float[Tensor, "batch time 6"] | None
    episode_ids: tuple[str, ...]
    starts: tuple[int, ...]


@runtime_checkable
class EpisodeSource(Protocol):
    """A set of episodes in a fixed order. It knows nothing of clips, crops or batches."""

    def infos(self) -> Sequence[EpisodeInfo]:
        """Return what is known of every episode, in the order of `read`."""
        ...

    def read(self, index: int) -> Episode:
        """Return one episode.

        Raises:
            InputError: The episode cannot be read, or is not what the data set promises.
        """
        ...
