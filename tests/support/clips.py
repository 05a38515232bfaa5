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


def open_in_memory(source: Any, /, **knobs: Any) -> Dataset:
    """Open the data set of a source, with all episodes in training unless the knobs say otherwise."""
    all_train = {"validation_share": 0.0, "test_share": 0.0, "workers": 0}
    values = {"path": "the set", "frames": 3, "stride": 2} | all_train | knobs
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(opening, "open_source", lambda _: source)
        return opening.open_dataset(DataConfig.model_validate(values))


def dataset_in_memory(source: EpisodeSource, /, **knobs: Any) -> Dataset:
    """Return the data set of a source as it is: no filter looks at it."""
    config = DataConfig.model_validate({"path": "memory", "frames": 3, **knobs})
    table = EpisodeTable.from_infos(source.infos())
    kept = StepSelection.all_steps(table, np.ones(len(table), bool))
    return Dataset(config, source, table, kept, BrokenEpisodes(config, len(table)))


def clip_at(dataset: Dataset, episode: int, start: int, *, camera: str | None = None) -> Clip:
    """Return the clip that starts at a control step of an episode."""
    return read_clip(dataset, ClipRequest(episode, start, camera))


def split_of(name: str, config: DataConfig) -> Split:
    """Return the split of an episode or group: the law, written a second time."""
    number = hash_identity(name) / 2**64
    if number < config.test_share:
        return "test"
    return "validation" if number < config.test_share + config.validation_share else "train"


def some_clips(batch: Batch, chosen: list[int]) -> Batch:
    """Return a batch with some of its clips; the others could not be read."""
    return replace(
        batch,
        frames=batch.frames[chosen],
        states=batch.states[chosen],
        actions=batch.actions[chosen],
        episode_ids=tuple(batch.episode_ids[place] for place in chosen),
        starts=tuple(batch.starts[place] for place in chosen),
    )
