"""The loader: batches depend only on seed and position; a worker's error reaches the user."""

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clips import clip_at, open_memory_source
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import ProcessShare, collate, training_loader, validation_batches
from vjepa2_ac.episode import Batch, Episode
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import actions_from_states, states_in_camera_frame

Names = list[tuple[str, int]]


def config_of(folder: Path, **options: Any) -> DataConfig:
    values = {"frames": 3, "stride": 2, "workers": 0, "validation_share": 0.3, "test_share": 0.0} | options
    return DataConfig(path=str(folder), **values)


def load_batches(count: int, config: DataConfig, **options: Any) -> list[Batch]:
    values = {"seed": 1, "batch_size": 2} | options
    return list(itertools.islice(training_loader(open_dataset(config), **values), count))


def names(batches: list[Batch]) -> Names:
    return [name for batch in batches for name in zip(batch.episode_ids, batch.starts, strict=True)]


def assert_equal_batches(batches: list[Batch], expected: list[Batch]) -> None:
    assert names(batches) == names(expected)
    for batch, expected_batch in zip(batches, expected, strict=True):
        assert torch.equal(batch.frames, expected_batch.frames)
        assert torch.equal(batch.states, expected_batch.states)
        assert torch.equal(batch.actions, expected_batch.actions)


def test_clip_has_the_strided_steps_of_its_episode(droid: Path) -> None:
    config = config_of(droid, frames=4, stride=3)
    dataset = open_dataset(config)
    episode = dataset.source.read(2)
    clip = clip_at(dataset, 2, 4)
    assert (clip.episode_id, clip.start, clip.stride) == (episode.info.id, 4, 3)
    assert np.array_equal(clip.states, episode.states[[4, 7, 10, 13]].astype(np.float32))
    assert np.array_equal(clip.frames, episode.read_frames([4, 7, 10, 13])[:, :, 15:80])


def test_loading_does_not_use_the_global_random_generator(droid: Path) -> None:
    before = torch.get_rng_state()
    load_batches(2, config_of(droid))
    assert torch.equal(torch.get_rng_state(), before)


def test_validation_clips_are_distinct_and_cover_all_held_out_episodes(droid: Path) -> None:
    config = config_of(droid, validation_share=0.6)
    batches = list(validation_batches(open_dataset(config), "validation", clips=7, batch_size=3))
    assert [len(batch.starts) for batch in batches] == [3, 3, 1]
    assert len(set(names(batches))) == 7
    held_out_episodes = {
        name for name, _ in names(list(validation_batches(open_dataset(config), "validation", clips=999, batch_size=9)))
    }
    assert len(held_out_episodes) > 1
    assert {name for name, _ in names(batches)} == held_out_episodes


@pytest.mark.parametrize("workers", [0, 1])
def test_worker_error_reaches_the_caller_unchanged(
    write_with_changed_record: Callable[..., Path], workers: int
) -> None:
    def change_features(features: dict[str, tuple[Any, Any]]) -> None:
        features["steps/observation/exterior_image_1_left"][1][:] = [b"GIF89a"] * 12

    config = config_of(write_with_changed_record(change_features), workers=workers, validation_share=0.0)
    with pytest.raises(InputError, match="not a JPEG") as caught:
        load_batches(60, config)
    assert type(caught.value) is InputError
    assert "tfrecord-00000-of-00002: record 0 at byte 0" in caught.value.where
    assert caught.value.needed == "a JPEG or PNG image"
    exclude = tuple(json.loads(caught.value.fix.split("data.exclude: ")[1]))
    assert len(exclude) == 1
    assert exclude[0] not in {
        name for name, _ in names(load_batches(60, config.model_copy(update={"exclude": exclude})))
    }


RUN_THAT_DIES = """
import os, signal, sys
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import training_loader
if __name__ == "__main__":
    config = DataConfig(path=sys.argv[1], frames=3, stride=2, workers=1, validation_share=0.0, test_share=0.0)
    batches = training_loader(open_dataset(config), seed=0, batch_size=1)
    next(batches)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_workers_exit_when_the_run_is_killed(droid: Path, tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(RUN_THAT_DIES)
    with subprocess.Popen(
        [sys.executable, str(script), str(droid)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as run:
        try:
            run.communicate(timeout=120)  # waits until all processes have closed the pipe
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            pytest.fail("a worker did not exit after the run")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("workers", [0, 1])
def test_pinned_batches_equal_unpinned_batches(droid: Path, workers: int) -> None:
    dataset = open_dataset(config_of(droid, workers=workers))
    with closing(training_loader(dataset, seed=1, batch_size=2, pinned=True)) as batches:
        pinned = [next(batches), next(batches)]
    assert all(batch.frames.is_pinned() for batch in pinned)
    assert_equal_batches(pinned, load_batches(2, config_of(droid)))


def test_frames_of_different_sizes_raise_in_collate(droid: Path) -> None:
    config = config_of(droid)
    clip = clip_at(open_dataset(config), 0, 0)
    smaller = replace(clip, frames=clip.frames[:, :20], episode_id="smaller")
    with pytest.raises(InputError, match=r"smaller: frames of 20x65.*48x65") as caught:
        collate([clip, smaller])
    assert "broken_episodes" not in caught.value.fix, "skipping would not help"


# ---- properties of the order, for episodes in memory, which count reads ----


def take_batches(dataset: Dataset, count: int, **options: Any) -> list[Batch]:
    values = {"seed": 1, "batch_size": 2} | options
    return list(itertools.islice(training_loader(dataset, **values), count))


@pytest.mark.parametrize("world_size", [1, 3])
@pytest.mark.parametrize("batch_size", [1, 4])
def test_ranks_read_each_window_exactly_once_per_epoch(world_size: int, batch_size: int) -> None:
    dataset = open_memory_source(MemorySource([9, 12, 7, 10]))
    all_windows = {(f"episode {e}", s) for e, length in enumerate((9, 12, 7, 10)) for s in range(length - 4)}
    steps = -(-2 * len(all_windows) // (world_size * batch_size))
    batches_by_rank = [
        take_batches(dataset, steps, batch_size=batch_size, share=ProcessShare(rank, world_size))
        for rank in range(world_size)
    ]
    assert {len(batch.starts) for rank in batches_by_rank for batch in rank} == {batch_size}
    clips = names([batches_by_rank[rank][step] for step in range(steps) for rank in range(world_size)])
    for epoch in (clips[: len(all_windows)], clips[len(all_windows) : 2 * len(all_windows)]):
        assert len(set(epoch)) == len(epoch)
        assert set(epoch) == all_windows


def test_resume_reads_no_earlier_clips() -> None:
    lengths = [30] * 40
    all_names = names(take_batches(open_memory_source(MemorySource(lengths)), 60))
    source = MemorySource(lengths)
    resumed = take_batches(open_memory_source(source), 2, start_position=100)
    assert names(resumed) == all_names[100:104]
    assert len(source.reads) == 4
    assert len(source.decoded) == 4 * 3


CAMERAS = ("exterior_1_left", "exterior_2_left", "wrist_left")


def test_camera_of_a_clip_depends_on_seed_and_position_only() -> None:
    def cameras(start: int, count: int) -> list[str | None]:
        source = MemorySource([30] * 10)
        take_batches(open_memory_source(source, camera=CAMERAS[:2]), count, batch_size=1, start_position=start)
        return [camera for _, camera, _ in source.reads]

    drawn = cameras(0, 200)
    assert cameras(150, 50) == drawn[150:]
    assert set(drawn) == set(CAMERAS[:2])
    assert 70 < drawn.count(CAMERAS[0]) < 130


# ---- camera poses ----


def test_camera_frame_poses_give_camera_frame_actions() -> None:
    cameras = np.tile([0.3, -0.2, 0.5, 0.4, -0.3, 1.2], (30, 1))
    source = MemorySource([30], extrinsics=lambda _: cameras)
    base_frame_clip = clip_at(open_memory_source(source), 0, 3)
    dataset = open_memory_source(source)
    dataset = replace(dataset, config=dataset.config.model_copy(update={"pose_frame": "camera"}))
    clip = clip_at(dataset, 0, 3)
    expected = states_in_camera_frame(source.read(0).states[3:8:2], cameras[3:8:2])
    np.testing.assert_allclose(clip.states, expected, atol=1e-6)
    np.testing.assert_allclose(clip.actions, actions_from_states(expected), atol=1e-6)
    assert not np.allclose(clip.actions, base_frame_clip.actions, atol=1e-3)
    assert np.allclose(clip.extrinsics, cameras[:3])


# ---- unreadable clips ----


def broken_set(broken: set[int], **options: Any) -> Dataset:
    source = MemorySource([5] * 300, pictureless=frozenset(broken))
    return open_memory_source(source, **({"broken_episodes": "skip"} | options))


def test_unreadable_clip_is_dropped_without_replacement(caplog: pytest.LogCaptureFixture) -> None:
    complete_batches = [names([batch]) for batch in take_batches(broken_set(set()), 80, batch_size=4)]
    broken = {f"episode {number}" for number in (3, 17)}
    dataset = broken_set({3, 17})
    batches = take_batches(dataset, 80, batch_size=4)
    assert [names([batch]) for batch in batches] == [
        [clip for clip in clips if clip[0] not in broken] for clips in complete_batches
    ]
    assert any(len(batch.starts) < 4 for batch in batches)
    assert set(dataset.broken.reasons) == broken
    assert sum("Skipped a clip" in record.getMessage() for record in caplog.records) == 2
    assert "memory: pictures of episode 17: damaged." in caplog.text


def test_batch_of_unreadable_clips_is_empty() -> None:
    batches = take_batches(broken_set({3, 17}), 300, batch_size=1)
    empty_batches = [batch for batch in batches if not batch.starts]
    assert empty_batches
    assert empty_batches[0].frames.shape[:2] == (0, 3)
    assert empty_batches[0].actions.shape == (0, 2, 7)


def test_unreadable_clip_raises_by_default() -> None:
    with pytest.raises(InputError, match=r"pictures of episode \d+: damaged\..*broken_episodes: skip, or add to"):
        take_batches(broken_set(set(range(300)), broken_episodes="error"), 1)


def test_validation_with_only_broken_clips_raises() -> None:
    windows = broken_set({0}, validation_share=0.5).windows("validation")
    unreadable = broken_set(set(windows.episodes.tolist()), validation_share=0.5)
    with pytest.raises(InputError, match=r"none of the clips can be read; broken episodes: episode \d+"):
        list(validation_batches(unreadable, "validation", clips=1, batch_size=1))


def test_workers_and_resume_are_bit_exact_with_all_options(write_with_changed_record: Callable[..., Path]) -> None:
    def change_features(features: dict[str, tuple[Any, Any]]) -> None:
        features["steps/observation/exterior_image_1_left"][1][3] = b"GIF89a"

    config = config_of(
        write_with_changed_record(change_features),
        validation_share=0.0, broken_episodes="skip", camera=CAMERAS, crop="letterbox",
        idle={"rule": "motion", "shortest_kept_steps": 2, "cut_last_steps": 6},
    )  # fmt: skip
    in_this_process = load_batches(40, config)
    assert sum(len(batch.starts) for batch in in_this_process) < 80
    for batches, start in (
        (load_batches(40, config.model_copy(update={"workers": 2})), 0),
        (load_batches(10, config, start_position=60), 30),
        (load_batches(10, config.model_copy(update={"workers": 1}), start_position=60), 30),
    ):
        assert_equal_batches(batches, in_this_process[start : start + len(batches)])


def test_remote_clips_are_read_concurrently() -> None:
    barrier = threading.Barrier(4, timeout=120)

    class Slow(MemorySource):
        def read(self, *arguments: Any) -> Episode:
            barrier.wait()  # no thread continues before four have arrived
            return super().read(*arguments)

    dataset = open_memory_source(Slow([30] * 10))
    expected = names(take_batches(open_memory_source(MemorySource([30] * 10)), 3, batch_size=4))
    remote = replace(dataset, config=dataset.config.model_copy(update={"path": "gs://bucket/set"}))
    assert names(take_batches(remote, 3, batch_size=4)) == expected
