"""Statistics of a data set: lengths, outcomes, idle time, and the motion of the robot per model step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, Removed
from vjepa2_ac.data.idle import idle_by_motion
from vjepa2_ac.data.inspection.coverage import Coverage, coverage_of
from vjepa2_ac.data.inspection.duplicates import Duplicates, find_duplicates
from vjepa2_ac.data.inspection.statistics_vectors import ChangePerStep, change_per_step
from vjepa2_ac.data.sources.configured_spaces import spaces_of
from vjepa2_ac.data.windows import spread
from vjepa2_ac.episode import Episode, Progress, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.geometry import states_in_camera_frame
from vjepa2_ac.spaces import POSE, Spaces, StateSpace

PERCENTILES = (10, 50, 90, 99)
SPLITS: tuple[Split, ...] = ("train", "validation", "test")

RELEASED_STEP_CM = 12.9  # motion of the flange between the two frames of upstream's example (franka_example_traj.npz)
RELEASED = (
    "the released weights saw DROID at a step of 4, 8 or 15 control steps (0.27, 0.53 or 1 s): which one is unsettled."
    f" The one known pair of frames, upstream's own example, is {RELEASED_STEP_CM} cm apart."
    " `data calibrate` lets the weights choose"
)


@dataclass(frozen=True, eq=False)
class ReadEpisode:
    """An episode of the sample, without frames."""

    index: int  # index into the data set's table
    states: Float[np.ndarray, "steps state_dim"]
    kept: tuple[tuple[int, int], ...]  # ranges that clips come from
    extrinsics: Float[np.ndarray, "steps 6"] | None = None  # of the camera that `data.pose_frame` says

    def changes(self, stride: int, space: StateSpace) -> Iterator[Float[np.ndarray, "pairs state_dim"]]:
        """Yield the changes from each step to the one `stride` later, within kept ranges, in the model's frame."""
        states = self.states if self.extrinsics is None else states_in_camera_frame(self.states, self.extrinsics)
        for start, end in self.kept:
            for first in range(start, min(start + stride, end - stride)):
                yield space.differences(states[first:end:stride])


@dataclass(frozen=True, eq=False)
class MotionPerStep:
    """Translation and rotation of the flange per model step, at one stride."""

    stride: int
    seconds: float
    moved_cm: Float[np.ndarray, " pairs"]
    turned_deg: Float[np.ndarray, " pairs"]

    def percentiles(self, name: str) -> list[float]:
        """Return the percentiles 10, 50, 90 and 99 of `moved_cm` or `turned_deg`; empty if no pair of steps fits."""
        values = getattr(self, name)
        return [float(value) for value in np.percentile(values, PERCENTILES)] if len(values) else []


@dataclass(frozen=True, eq=False)
class Inspection:
    """The statistics of a data set; motion is measured on a sample of the used episodes."""

    config: DataConfig
    control_rate_hz: float
    lengths: np.ndarray  # control steps of every readable episode
    success: np.ndarray  # of every readable episode: 1, 0, or -1 if unknown
    broken: int
    removed: tuple[Removed, ...]
    episodes_of: dict[Split, int]
    windows_of: dict[Split, int]
    duplicates: Duplicates
    sample: tuple[ReadEpisode, ...]
    widths: Widths
    still_share: float | None  # of the sample's steps: in a run of idle ones, by the measured motion; None: no poses
    motions: tuple[MotionPerStep, ...]  # of poses
    changes: tuple[ChangePerStep, ...]  # of vectors

    @property
    def hours(self) -> float:
        """The total duration of all readable episodes."""
        return float(self.lengths.sum() / self.control_rate_hz / 3600)

    @property
    def success_share(self) -> float | None:
        """The share of successes among the episodes with known outcome; None: there are none."""
        known = self.success >= 0
        return float(self.success[known].mean()) if known.any() else None

    @property
    def length_percentiles(self) -> list[int]:
        """The shortest, the percentiles 10, 50 and 90, and the longest length in control steps."""
        return [int(value) for value in np.percentile(self.lengths, [0, 10, 50, 90, 100])]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The available cameras, as far as the config knows them."""
        return self.config.offered_cameras

    @property
    def spaces(self) -> Spaces:
        """The spaces of states and actions."""
        return spaces_of(self.config, self.widths)

    @property
    def has_poses(self) -> bool:
        """Whether there is a position, of which motion is measured."""
        return self.spaces.state.position is not None

    @property
    def ranges(self) -> Float[np.ndarray, "state_dim 2"]:
        """The least and the greatest value of each number of the sample's states."""
        return np.array([self.range_of(column) for column in range(self.widths.state)])

    def range_of(self, column: int) -> tuple[float, float]:
        """Return the least and the greatest value of one number of the sample's states."""
        values = np.concatenate([one.states[:, column] for one in self.sample])
        return float(values.min()), float(values.max())

    @property
    def gripper_range(self) -> tuple[float, float]:
        """The least and the greatest closedness of the sample."""
        return self.range_of(self.spaces.state.gripper or 0)

    @cached_property
    def coverage(self) -> Coverage | None:
        """The coverage of actions by the sample at the config's stride; None: no step fits."""
        return _coverage(self.sample, self.spaces.state, self.config.model_stride)

    def as_dict(self) -> dict[str, Any]:
        """Return all statistics as plain values, for `inspect.json`."""
        return {
            "path": self.config.path,
            "source": self.config.source,
            "cameras": list(self.cameras),
            "camera": list(self.config.cameras),
            "control_rate_hz": self.control_rate_hz,
            "episodes": len(self.lengths),
            "broken_episodes": self.broken,
            "steps": int(self.lengths.sum()),
            "hours": self.hours,
            "length_percentiles_0_10_50_90_100": self.length_percentiles,
            "success_share": self.success_share,
            "success_known_of": int((self.success >= 0).sum()),
            "removed": [vars(one) for one in self.removed],
            "splits": {name: {"episodes": self.episodes_of[name], "windows": self.windows_of[name]} for name in SPLITS},
            "duplicates": self.duplicates.as_dict(),
            "sampled_episodes": len(self.sample),
            "state_dim": self.widths.state,
            "action_dim": self.widths.action,
            "percentiles": list(PERCENTILES),
            "coverage": None if self.coverage is None else self.coverage.as_dict(),
            **(self._poses_as_dict() if self.has_poses else self._vectors_as_dict()),
        }

    def _poses_as_dict(self) -> dict[str, Any]:
        return {
            "still_share": self.still_share,
            "xyz_m": [self.range_of(column) for column in range(3)],
            "gripper": self.gripper_range,
            "per_model_step": [
                {
                    "stride": one.stride,
                    "seconds": one.seconds,
                    "moved_cm": one.percentiles("moved_cm"),
                    "turned_deg": one.percentiles("turned_deg"),
                }
                for one in self.motions
            ],
            "released_weights": RELEASED,
        }

    def _vectors_as_dict(self) -> dict[str, Any]:
        return {
            "ranges": self.ranges.tolist(),
            "per_model_step": [
                {
                    "stride": one.stride,
                    "seconds": one.seconds,
                    "changed_percent_of_range": one.percentiles(PERCENTILES),
                }
                for one in self.changes
            ],
        }


def inspect_dataset(dataset: Dataset, *, episodes: int = 100, progress: Progress | None = None) -> Inspection:
    """Compute the statistics of a data set: from the table for all episodes, from the states of a sample for motion.

    Args:
        dataset: Its stride is a number.
        episodes: At most as many are read, without frames, spread over the used ones.
        progress: Called with (episodes read, total number).

    Raises:
        InputError: Episodes of the sample cannot be read, and `data.broken_episodes` does not skip them.
    """
    sample = tuple(_read(dataset, sample_of(dataset, episodes), progress))
    rate, strides = dataset.control_rate_hz, dataset.config.strides_to_try(dataset.control_rate_hz)
    found = Inspection(
        config=dataset.config,
        control_rate_hz=rate,
        lengths=dataset.table.num_steps,
        success=dataset.table.success,
        broken=len(dataset.table.problems),
        removed=dataset.removed,
        episodes_of={name: _episodes(dataset, name) for name in SPLITS},
        windows_of={name: _windows(dataset, name) for name in SPLITS},
        duplicates=find_duplicates(dataset),
        sample=sample,
        widths=dataset.widths,
        still_share=None,
        motions=(),
        changes=(),
    )
    if not found.has_poses:
        pieces = [one.states[start:end] for one in sample for start, end in one.kept]
        return replace(found, changes=tuple(change_per_step(pieces, found.ranges, stride, rate) for stride in strides))
    idle = np.concatenate([idle_runs(one.states, dataset.config) for one in sample])
    motions = tuple(motion_per_step(sample, stride, rate) for stride in strides)
    return replace(found, still_share=float(idle.mean()), motions=motions)


def coverage_in(dataset: Dataset, *, episodes: int = 64) -> Coverage | None:
    """Return the coverage of actions by a sample of the episodes, read without frames; None: no step fits.

    Raises:
        InputError: As `inspect_dataset`.
    """
    sample = _read(dataset, sample_of(dataset, episodes), None)
    return _coverage(sample, dataset.spaces.state, dataset.config.model_stride)


def _coverage(sample: Iterable[ReadEpisode], space: StateSpace, stride: int) -> Coverage | None:
    changes = [piece for one in sample for piece in one.changes(stride, space)]
    return coverage_of(np.concatenate(changes), space, stride) if changes else None


def sample_of(dataset: Dataset, count: int) -> list[int]:
    """Return at most `count` of the used episodes: a random draw that is always the same."""
    # A latent cache has only the episodes that clips come from.
    members = dataset.starts.episodes if dataset.config.is_cache else dataset.episodes
    members = members[np.argsort(dataset.table.id_hash[members], kind="stable")]
    return [int(members[place]) for place in spread(len(members), count)]


def motion_per_step(sample: Sequence[ReadEpisode], stride: int, control_rate_hz: float) -> MotionPerStep:
    """Return the motion of the flange from each step to the one `stride` later, within one kept range."""
    pieces = [one.states[start:end] for one in sample for start, end in one.kept if end - start > stride]
    if not pieces:
        return MotionPerStep(stride, stride / control_rate_hz, np.zeros(0), np.zeros(0))
    moved = [POSE.shown_size(piece[stride:] - piece[:-stride]) for piece in pieces]
    turned = []
    for piece in pieces:
        rotations = Rotation.from_euler("xyz", piece[:, POSE.rotation])
        turned.append((rotations[stride:] * rotations[:-stride].inv()).magnitude())
    return MotionPerStep(stride, stride / control_rate_hz, np.concatenate(moved), np.rad2deg(np.concatenate(turned)))


def idle_runs(states: Float[np.ndarray, "steps 7"], config: DataConfig) -> Bool[np.ndarray, " steps"]:
    """Return the steps in runs of idle ones, by measured motion, that are long enough for the idle filter."""
    idle = idle_by_motion(states, config.idle)
    edges = np.flatnonzero(np.diff(idle.astype(np.int8), prepend=0, append=0))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        idle[start:end] = end - start >= config.idle.shortest_idle_steps
    return idle


def _read(dataset: Dataset, episodes: Sequence[int], progress: Progress | None) -> Iterator[ReadEpisode]:
    def look(index: int) -> Episode | InputError:
        try:
            return dataset.source.read(index)
        except InputError as error:
            return error

    threads = dataset.config.connections if storage.is_url(dataset.config.path) else 1
    with ThreadPoolExecutor(threads) as pool:
        for done, (index, episode) in enumerate(zip(episodes, pool.map(look, episodes), strict=True), start=1):
            if progress is not None:
                progress(done, len(episodes))
            if isinstance(episode, InputError):
                dataset.leave_out(index, episode)
            else:
                camera = episode.extrinsics if dataset.config.pose_frame == "camera" else None
                yield ReadEpisode(index, np.asarray(episode.states, np.float64), tuple(dataset.kept.of(index)), camera)


def _episodes(dataset: Dataset, split: Split) -> int:
    return int(dataset.members(split).sum())


def _windows(dataset: Dataset, split: Split) -> int:
    try:
        return len(dataset.windows(split))
    except InputError:  # an empty split is a statistic here, not an error
        return 0
