"""Progress of demonstrations: 1 - distance now over distance at the start, in latents, to what is seen at the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from vjepa2_ac.config.planning import EnergyConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.intervals import Estimate, mean_of
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.energy import distance

_AT_ONCE = 64  # frames


@dataclass(frozen=True, eq=False)
class EpisodeProgress:
    """The progress of an episode: 0 at its start, 1 at its end; below 0 where it is farther away than at the start."""

    name: str
    index: int  # in the data set
    steps: Int[np.ndarray, " time"]  # control steps
    progress: Float[np.ndarray, " time"]

    @property
    def monotony(self) -> float:
        """Spearman's correlation with time: 1 if it always grows. NaN where nothing changes."""
        from scipy.stats import spearmanr

        return float(spearmanr(self.steps, self.progress).statistic) if np.ptp(self.progress) else float("nan")


@torch.no_grad()
def progress_of_episodes(
    model: WorldModel, dataset: Dataset, energy: EnergyConfig, *, every: int = 1, report: Progress = no_progress
) -> Iterator[EpisodeProgress]:
    """Yield the progress of all episodes that take part, in their order.

    Args:
        model: Whose encoder sees.
        dataset: Has the frames.
        energy: The distance.
        every: Control steps from one row to the next; the last frame is always one.
        report: Called with (done, total) in episodes.

    Raises:
        InputError: An episode cannot be read, or the data are latents.
    """
    require_frames(dataset.config, to="measure progress on")
    chosen = np.flatnonzero(dataset.taking_part).tolist()
    for done, index in enumerate(chosen, start=1):
        episode = dataset.source.read(index)
        last = len(episode.states) - 1
        steps = np.unique(np.append(np.arange(0, last, every), last))
        goal = encode_frames(model, episode.read_frames([last]), dataset.config.crop)[0]
        far: list[float] = []
        for first in range(0, len(steps), _AT_ONCE):
            frames = episode.read_frames(steps[first : first + _AT_ONCE].tolist())
            far += distance(encode_frames(model, frames, dataset.config.crop), goal, energy).tolist()
        found = 1.0 - np.array(far) / max(far[0], 1e-12)
        yield EpisodeProgress(dataset.table.identity(index), index, steps, found)
        report(done, len(chosen))


def monotony_of(episodes: Sequence[EpisodeProgress]) -> Estimate:
    """Return the mean monotony with its interval over episodes: whether this column is to be trusted."""
    found = np.array([one.monotony for one in episodes])
    kept = np.isfinite(found)
    return mean_of(found[kept], [one.name for one, is_kept in zip(episodes, kept, strict=True) if is_kept])
