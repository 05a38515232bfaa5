"""Excerpts of a few dozen episodes in grey, used to check that frames and states belong together."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.inspection.statistics import sample_of
from vjepa2_ac.errors import InputError

EPISODES = 24
STEPS = 64
_ROWS, _COLUMNS = 24, 32  # of a small frame: an arm is still some pixels wide, and a camera's noise is averaged out
_STRONG, _STRONG_SHARE = 40, 0.01  # difference of red and blue, of 255; of the pixels


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Neighbouring control steps of an episode."""

    name: str  # the episode's identity
    states: Float[np.ndarray, "steps state_dim"]
    grey: Float32[np.ndarray, "steps rows columns"]  # 0 to 255
    warmth: float  # of strongly coloured pixels: 1 all more red than blue, -1 more blue; 0 if there are none

    @property
    def frame_change(self) -> Float[np.ndarray, " changes"]:
        """The difference of each frame from the one before: the mean over its pixels."""
        return np.asarray(np.abs(np.diff(self.grey, axis=0)).mean(axis=(1, 2)), np.float64)


def excerpts_of(dataset: Dataset, *, episodes: int = EPISODES, steps: int = STEPS) -> Iterator[Excerpt]:
    """Yield the middle of some used episodes: always the same draw.

    Episodes that cannot be read are skipped, or raise an error, as `data.broken_episodes` says.

    Raises:
        InputError: As `Dataset.leave_out`.
    """

    def look(index: int) -> Excerpt | InputError:
        try:
            return _read(dataset, index, steps)
        except InputError as error:
            return error

    chosen = sample_of(dataset, episodes)
    threads = dataset.config.connections if storage.is_url(dataset.config.path) else 1
    with ThreadPoolExecutor(threads) as pool:
        for index, found in zip(chosen, pool.map(look, chosen), strict=True):
            if isinstance(found, InputError):
                dataset.leave_out(index, found)
            else:
                yield found


def _read(dataset: Dataset, index: int, steps: int) -> Excerpt:
    start, end = max(dataset.kept.of(index) or [(0, int(dataset.table.num_steps[index]))], key=lambda r: r[1] - r[0])
    first = start + max(0, end - start - steps) // 2
    chosen = range(first, min(end, first + steps))
    episode = dataset.source.read(index, None, dataset.needed_steps(index))
    frames = episode.read_frames(chosen)
    return Excerpt(
        name=episode.info.id,
        states=np.asarray(episode.states[chosen.start : chosen.stop], np.float64),
        grey=small_grey(frames),
        warmth=warmth_of(frames[:: len(frames) - 1 or 1]),
    )


def warmth_of(frames: UInt8[np.ndarray, "steps height width 3"]) -> float:
    """Return how much more red than blue the strongly coloured pixels are, -1 to 1; 0 if there are few."""
    warmer = frames[..., 0].astype(np.int16) - frames[..., 2]
    strong = warmer[np.abs(warmer) > _STRONG]
    return float(strong.sum() / np.abs(strong).sum()) if len(strong) > _STRONG_SHARE * warmer.size else 0.0


def small_grey(frames: UInt8[np.ndarray, "steps height width 3"]) -> Float32[np.ndarray, "steps rows columns"]:
    """Return frames in grey, each pixel the mean of a part; smaller frames are not reduced."""
    grey = frames.mean(axis=3, dtype=np.float32)
    for axis, wanted in ((1, _ROWS), (2, _COLUMNS)):
        size = grey.shape[axis]
        edges = np.linspace(0, size, min(wanted, size) + 1).astype(int)
        shape = [1, 1, 1]
        shape[axis] = -1
        grey = np.add.reduceat(grey, edges[:-1], axis=axis) / np.diff(edges).reshape(shape).astype(np.float32)
    return np.asarray(grey)
