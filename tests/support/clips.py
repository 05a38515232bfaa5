"""Data sets in memory, single clips, and the split of a single name."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data import dataset as opening
from vjepa2_ac.data.clips import ClipRequest
from vjepa2_ac.data.dataset import Dataset, read_clip
from vjepa2_ac.data.index import EpisodeTable, StepSelection, hash_identity
from vjepa2_ac.data.selection import BrokenEpisodes
from vjepa2_ac.episode import Batch, Clip, EpisodeSource


def open_memory_source(source: Any, /, **options: Any) -> Dataset:
    """Open the data set of a source. By default all episodes are in the training split."""
    all_train = {"validation_share": 0.0, "test_share": 0.0, "workers": 0}
    values = {"path": "the set", "frames": 3, "stride": 2} | all_train | options
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(opening, "open_source", lambda _: source)
        return opening.open_dataset(DataConfig.model_validate(values))


def dataset_in_memory(source: EpisodeSource, /, **options: Any) -> Dataset:
    """Return the data set of a source without filters."""
    config = DataConfig.model_validate({"path": "memory", "frames": 3, **options})
    table = EpisodeTable.from_infos(source.infos())
    selection = StepSelection.all_steps(table, np.ones(len(table), bool))
    return Dataset(config, source, table, selection, BrokenEpisodes(config, len(table)))


def clip_at(dataset: Dataset, episode: int, start: int, *, camera: str | None = None) -> Clip:
    """Return the clip that starts at a control step of an episode."""
    return read_clip(dataset, ClipRequest(episode, start, camera))


def split_of(name: str, config: DataConfig) -> Split:
    """Return the split of an episode or group, computed independently of the package."""
    number = hash_identity(name) / 2**64
    if number < config.test_share:
        return "test"
    return "validation" if number < config.test_share + config.validation_share else "train"


def some_clips(batch: Batch, chosen: list[int]) -> Batch:
    """Return a batch with the clips at the given indices, as if the other clips could not be read."""
    return replace(
        batch,
        frames=batch.frames[chosen],
        states=batch.states[chosen],
        actions=batch.actions[chosen],
        episode_ids=tuple(batch.episode_ids[index] for index in chosen),
        starts=tuple(batch.starts[index] for index in chosen),
    )
