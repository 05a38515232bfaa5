"""Variants of a data set: shifted frames, mirrored or reversed states, swapped colour channels, ...

A variant changes one thing of every episode and nothing on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import Episode, EpisodeInfo, EpisodeSource, Progress, StepRanges
from vjepa2_ac.geometry import euler_from_matrices, matrices_from_euler
from vjepa2_ac.spaces import POSE


@dataclass(frozen=True)
class Variant:
    """Another reading of the same data."""

    name: str
    repair: str  # the fix, if it fits better
    change: Callable[[Episode], Episode]
    changes_frames: bool = False


def variants_of(config: DataConfig, shifts: Sequence[int]) -> list[Variant]:
    """Return the variants that apply to this data.

    Args:
        config: The data.
        shifts: Control steps by which to shift frames against states.
    """
    found = [
        Variant(
            f"frames {_steps(shift)} {'late' if shift > 0 else 'early'}",
            f"give each frame the state of {_steps(shift)} {'before' if shift > 0 else 'after'}",
            partial(_shifted, late=shift),
        )
        for size in shifts
        for shift in (size, -size)
    ]
    if config.actions == "difference":  # a command has no opposite
        found.append(Variant("the states backwards", "reverse the order of the frames", _backwards))
    if config.states == "pose":
        for axis, name in enumerate("xy"):
            repair = f"negate {name}, with the rotation (as of a mirror)"
            found.append(Variant(f"{name} negated", repair, partial(_with_mirrored_states, axis=axis)))
        found.append(Variant("the gripper inverted", config.gripper_fix, _with_gripper_inverted))
    if not config.is_cache:
        repair = "exchange red and blue (OpenCV reads and writes BGR) where the data is written"
        found.append(Variant("red and blue exchanged", repair, _with_channels_exchanged, changes_frames=True))
        repair = "flip the frames, left to right, where the data is written"
        found.append(Variant("frames mirrored", repair, _with_mirrored_frames, changes_frames=True))
    return found


def mirrored(states: Float[np.ndarray, "steps 7"], axis: int) -> Float[np.ndarray, "steps 7"]:
    """Return poses mirrored across the plane of two axes: one coordinate and two rotations negated."""
    mirror = np.ones(3)
    mirror[axis] = -1
    rotations = matrices_from_euler(states[:, POSE.rotation]) * mirror[:, None] * mirror
    return np.concatenate([states[:, POSE.position] * mirror, euler_from_matrices(rotations), states[:, -1:]], axis=1)


@dataclass(frozen=True)
class ChangedSource:
    """A source under a variant; without frames where the variant does not change them."""

    source: EpisodeSource
    variant: Variant

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        """Return the infos of the source."""
        return self.source.infos(progress)

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode, changed."""
        episode = self.variant.change(self.source.read(index, camera, needed))
        if self.variant.changes_frames:
            return episode
        return replace(episode, read_frames=_no_frames, read_latents=None)


@dataclass(frozen=True)
class RememberingSource:
    """A source that reads each episode once: a remote one, or one in a large record, takes long."""

    source: EpisodeSource
    episodes: dict[tuple[int, str | None], Episode] = field(default_factory=dict)

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        """Return the infos of the source."""
        return self.source.infos(progress)

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode, read at the first call."""
        if (index, camera) not in self.episodes:
            self.episodes[index, camera] = self.source.read(index, camera, needed)
        return self.episodes[index, camera]


def _no_frames(steps: Sequence[int]) -> np.ndarray:
    return np.zeros((len(steps), 1, 1, 3), np.uint8)


def _steps(shift: int) -> str:
    return "1 step" if abs(shift) == 1 else f"{abs(shift)} steps"


def _shifted(episode: Episode, *, late: int) -> Episode:
    """Give each step the state, and the command, of `late` steps before; beyond the ends, the first or the last."""
    steps = np.clip(np.arange(len(episode.states)) - late, 0, len(episode.states) - 1)
    commands = None if episode.commands is None else episode.commands[steps]
    return replace(episode, states=episode.states[steps], commands=commands)


def _backwards(episode: Episode) -> Episode:
    return replace(episode, states=np.ascontiguousarray(episode.states[::-1]))


def _with_mirrored_states(episode: Episode, *, axis: int) -> Episode:
    return replace(episode, states=mirrored(episode.states, axis))


def _with_gripper_inverted(episode: Episode) -> Episode:
    states = episode.states.copy()
    states[:, POSE.gripper] = 1 - states[:, POSE.gripper]
    return replace(episode, states=states)


def _with_channels_exchanged(episode: Episode) -> Episode:
    return _with_changed_frames(episode, lambda frames: frames[..., ::-1])


def _with_mirrored_frames(episode: Episode) -> Episode:
    return _with_changed_frames(episode, lambda frames: frames[:, :, ::-1])


def _with_changed_frames(episode: Episode, change: Callable[[np.ndarray], np.ndarray]) -> Episode:
    def read(steps: Sequence[int]) -> np.ndarray:
        return np.ascontiguousarray(change(episode.read_frames(steps)))

    return replace(episode, read_frames=read)
