"""Batches follow from seed and position alone; what goes wrong in a worker is what the user reads."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from synthetic import write_synthetic_droid
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import clip_at, collate, training_loader, validation_batches
from vjepa2_ac.data.sources.tfrecord import index_records
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.geometry import apply_action, matrices_from_euler

Names = list[tuple[str, int]]


def config_of(folder: Path, **knobs: Any) -> DataConfig:
    chosen = {"frames": 3, "stride": 2, "workers": 0, "validation_share": 0.3, "test_share": 0.0} | knobs
    return DataConfig(path=str(folder), **chosen)


def take(count: int, config: DataConfig, **knobs: Any) -> list[Batch]:
    chosen = {"seed": 1, "batch_size": 2} | knobs
    return list(itertools.islice(training_loader(open_dataset(config), **chosen), count))


def names(batches: list[Batch]) -> Names:
    return [name for batch in batches for name in zip(batch.episode_ids, batch.starts, strict=True)]


def assert_same(found: list[Batch], expected: list[Batch]) -> None:
    assert names(found) == names(expected)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one.frames, other.frames)
        assert torch.equal(one.states, other.states)
        assert torch.equal(one.actions, other.actions)


def test_a_clip_holds_the_strided_steps_of_its_episode(droid: Path) -> None:
    config = config_of(droid, frames=4, stride=3)
    dataset = open_dataset(config)
    episode = dataset.source.read(2)
    clip = clip_at(dataset, 2, 4)
    assert (clip.episode_id, clip.start, clip.stride) == (episode.info.id, 4, 3)
    assert np.array_equal(clip.states, episode.states[[4, 7, 10, 13]].astype(np.float32))
    assert np.array_equal(clip.frames, episode.read_frames([4, 7, 10, 13])[:, :, 15:80])


def test_the_actions_of_a_clip_lead_from_each_state_to_the_next(droid: Path) -> None:
    config = config_of(droid)
    clip = clip_at(open_dataset(config), 0, 1)
    reached = apply_action(clip.states[:-1].astype(np.float64), clip.actions.astype(np.float64))
    np.testing.assert_allclose(reached[:, [0, 1, 2, 6]], clip.states[1:][:, [0, 1, 2, 6]], atol=1e-6)
    np.testing.assert_allclose(
        matrices_from_euler(reached[:, 3:6]), matrices_from_euler(clip.states[1:, 3:6].astype(np.float64)), atol=1e-5
    )


def test_workers_change_nothing(droid: Path) -> None:
    assert_same(take(7, config_of(droid, workers=2)), take(7, config_of(droid)))


def test_resumed_run_sees_the_clips_the_uninterrupted_run_would_have(droid: Path) -> None:
    config = config_of(droid)
    uninterrupted = take(40, config)  # more than an epoch
    for done in (1, 17, 33):
        assert_same(take(5, config, start_position=done * 2), uninterrupted[done : done + 5])


def test_ranks_share_one_order_between_them(droid: Path) -> None:
    config = config_of(droid)
    alone = take(12, config)
    ranks = [take(4, config, rank=rank, world_size=3) for rank in range(3)]
    assert_same([ranks[rank][step] for step in range(4) for rank in range(3)], alone)


def test_another_layout_goes_on_where_the_run_stopped(droid: Path) -> None:
    config = config_of(droid)
    alone = names(take(12, config))
    ranks = [take(2, config, start_position=5, batch_size=3, rank=rank, world_size=2) for rank in range(2)]
    assert names([ranks[rank][step] for step in range(2) for rank in range(2)]) == alone[5:17]


def test_an_epoch_holds_every_training_window_once_and_no_other(droid: Path) -> None:
    config = config_of(droid)
    held_out = set(names(list(validation_batches(open_dataset(config), "validation", clips=1000, batch_size=1))))
    everything = {
        (info.id, start)
        for info in open_dataset(config).table
        for start in range(info.num_steps - config.clip_steps + 1)
    }
    epoch = names(take(len(everything - held_out), config, batch_size=1))
    assert held_out
    assert len(epoch) == len(set(epoch))
    assert set(epoch) == everything - held_out


def test_seeds_change_the_order(droid: Path) -> None:
    assert names(take(5, config_of(droid), seed=1)) != names(take(5, config_of(droid), seed=2))


def test_the_shards_change_neither_training_nor_validation(droid: Path, tmp_path: Path) -> None:
    other = config_of(write_synthetic_droid(tmp_path / "set", steps=range(12, 18), size=(48, 96), shards=5))
    config = config_of(droid)
    assert_same(take(9, other), take(9, config))
    chosen = [list(validation_batches(open_dataset(c), "validation", clips=5, batch_size=2)) for c in (config, other)]
    assert_same(*chosen)


def test_loading_does_not_draw_from_the_generator_of_dropout(droid: Path) -> None:
    before = torch.get_rng_state()
    take(2, config_of(droid))
    assert torch.equal(torch.get_rng_state(), before)


def test_validation_clips_are_few_distinct_and_from_all_held_out_episodes(droid: Path) -> None:
    config = config_of(droid, validation_share=0.6)
    batches = list(validation_batches(open_dataset(config), "validation", clips=7, batch_size=3))
    assert [len(batch.starts) for batch in batches] == [3, 3, 1]
    assert len(set(names(batches))) == 7
    everyone = {
        name for name, _ in names(list(validation_batches(open_dataset(config), "validation", clips=999, batch_size=9)))
    }
    assert len(everyone) > 1
    assert {name for name, _ in names(batches)} == everyone


def test_validation_without_held_out_episodes_says_so_at_once(droid: Path) -> None:
    config = config_of(droid, validation_share=0.0)
    with pytest.raises(InputError, match=r"no validation episodes among 6 .*Raise data\.validation_share"):
        validation_batches(open_dataset(config), "validation", clips=1, batch_size=1)


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_in_a_worker_is_the_error_the_user_reads(spoiled: Callable[..., Path], workers: int) -> None:
    def spoil(features: dict[str, tuple[Any, Any]]) -> None:
        features["steps/observation/exterior_image_1_left"][1][:] = [b"GIF89a"] * 12

    config = config_of(spoiled(spoil), workers=workers, validation_share=0.0)
    with pytest.raises(InputError, match="not a JPEG") as caught:
        take(60, config)
    assert type(caught.value) is InputError
    assert "tfrecord-00000-of-00002: record 0 at byte 0" in caught.value.where
    assert caught.value.needed == "a JPEG picture"
    exclude = tuple(json.loads(caught.value.fix.split("data.exclude: ")[1]))
    assert len(exclude) == 1
    assert exclude[0] not in {name for name, _ in names(take(60, config.model_copy(update={"exclude": exclude})))}


def test_a_clip_of_a_damaged_record_says_how_to_leave_it_out(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    shard = sorted(folder.glob("*.tfrecord-*"))[0]
    config = config_of(folder)
    whole = bytearray(shard.read_bytes())
    whole[index_records(shard)[0].end - 10] ^= 1
    shard.write_bytes(whole)
    dataset = open_dataset(config)
    with pytest.raises(InputError, match=r"CRC of the data.*add to data\.exclude: .*episode_0000"):
        clip_at(dataset, 0, 0)


RUN_THAT_DIES = """
import os, signal, sys
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import training_loader
if __name__ == "__main__":
    config = DataConfig(path=sys.argv[1], frames=3, stride=2, workers=1, validation_share=0.0, test_share=0.0)
    batches = training_loader(open_dataset(config), seed=0, batch_size=1)
    next(batches)
    if sys.argv[2] == "error":
        raise RuntimeError("boom")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("death", ["error", "kill"])
def test_workers_end_with_the_run_however_it_ends(droid: Path, tmp_path: Path, death: str) -> None:
    script = tmp_path / "run.py"
    script.write_text(RUN_THAT_DIES)
    with subprocess.Popen(
        [sys.executable, "-W", "always", str(script), str(droid), death],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as run:
        try:
            _, said = run.communicate(timeout=60)  # waits until no process holds the pipe any more
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            pytest.fail("a worker outlives the run")
    assert said.count("Traceback") == (death == "error")
    if death == "error":
        assert said.endswith("RuntimeError: boom\n")
        assert "Warning" not in said


def test_pictures_of_two_sizes_do_not_stack(droid: Path) -> None:
    config = config_of(droid)
    clip = clip_at(open_dataset(config), 0, 0)
    other = replace(clip, frames=clip.frames[:, :20], episode_id="the other")
    with pytest.raises(InputError, match=r"the other: pictures of 20x65.*48x65"):
        collate([clip, other])
