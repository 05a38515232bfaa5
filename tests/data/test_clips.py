"""The clips of a split are a PyTorch data set that works in any DataLoader."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as TorchDataset

from clips import clip_at, open_memory_source
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.clips import collate
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.episode import Batch, Clip
from vjepa2_ac.errors import InputError


def open_set(folder: Path, **keys: Any) -> Dataset:
    values = {"frames": 3, "stride": 2, "validation_share": 0.3, "test_share": 0.0} | keys
    return open_dataset(DataConfig(path=str(folder), **values))


def windows_of(clips: list[Clip]) -> list[tuple[str, int]]:
    return [(clip.episode_id, clip.start) for clip in clips]


def test_clips_are_sorted_by_identity_and_start(droid: Path) -> None:
    dataset = open_set(droid)
    clips, windows = dataset.clips("train"), dataset.windows("train")
    assert isinstance(clips, TorchDataset)
    assert len(clips) == len(windows) > 10
    for index in (0, 5, len(clips) - 1):
        clip, expected = clips[index], clip_at(dataset, *windows[index])
        assert (clip.episode_id, clip.start, clip.stride) == (expected.episode_id, expected.start, 2)
        for part in ("frames", "states", "actions"):
            np.testing.assert_array_equal(getattr(clip, part), getattr(expected, part))
    assert (clips[0].frames.dtype, clips[0].states.dtype, clips[0].actions.dtype) == (np.uint8, np.float32, np.float32)
    assert (clips[0].frames.ndim, clips[0].states.shape, clips[0].actions.shape) == (4, (3, 7), (2, 7))
    assert all(first < second for first, second in pairwise(windows_of(list(clips))))


def test_negative_indices_and_iteration_follow_the_sequence_protocol() -> None:
    clips = open_memory_source(MemorySource([9, 9])).clips()
    assert len(list(clips)) == len(clips) == 10
    assert windows_of([clips[-1], clips[-10]]) == windows_of([clips[9], clips[0]])
    assert windows_of([clips[np.int64(3)], clips[torch.tensor(3)]]) == windows_of([clips[3]] * 2)
    for invalid_index in (10, -11):
        with pytest.raises(IndexError):
            clips[invalid_index]
    with pytest.raises(TypeError):
        clips[1.0]


def test_default_collate_returns_a_batch() -> None:
    clips = open_memory_source(MemorySource([9, 9])).clips()
    batches = list(DataLoader(clips, batch_size=4))
    assert [type(batch) for batch in batches] == [Batch] * 3
    assert [tuple(batch.frames.shape) for batch in batches] == [(4, 3, 4, 5, 3)] * 2 + [(2, 3, 4, 5, 3)]
    explicit = next(iter(DataLoader(clips, batch_size=4, collate_fn=collate)))
    assert torch.equal(explicit.frames, batches[0].frames)
    assert (explicit.episode_ids, explicit.starts) == (batches[0].episode_ids, batches[0].starts)
    assert isinstance(next(iter(DataLoader(clips, batch_size=None))), Clip)
    moved = explicit.to("meta")
    assert {tensor.device.type for tensor in (moved.frames, moved.states, moved.actions)} == {"meta"}
    assert moved.starts == explicit.starts


@pytest.mark.parametrize("policy", ["error", "skip"])
def test_broken_episode_error_names_the_episode_and_a_working_fix(
    write_with_changed_record: Callable[[Callable[[Any], None]], Path], policy: str
) -> None:
    def change_features(features: dict[str, tuple[Any, Any]]) -> None:
        features["steps/observation/exterior_image_1_left"][1][:] = [b"GIF89a"] * 12

    clips = open_set(write_with_changed_record(change_features), broken_episodes=policy, validation_share=0.0).clips()
    reasons = []
    for index in range(len(clips)):
        try:
            clips[index]
        except InputError as error:
            reasons.append(str(error))
    assert 0 < len(reasons) < len(clips)
    assert all("not a JPEG" in reason for reason in reasons)
    assert all("add to data.exclude" in reason and "skip" not in reason for reason in reasons)
