"""Shared memory: a run whose workers may fill /dev/shm warns with sizes and fixes."""

import shutil
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from run_fixtures import set_up
from vjepa2_ac.config import Config
from vjepa2_ac.distributed.shared_memory import SHARED_MEMORY, small_shared_memory
from vjepa2_ac.training.loop import train

MB = 10**6


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[int | OSError], None]:
    """A function that sets how much shared memory is free on this machine."""
    real = shutil.disk_usage

    def set_to(free: int | OSError) -> None:
        def usage(path: Any) -> Any:
            if path != SHARED_MEMORY:
                return real(path)
            if isinstance(free, OSError):
                raise free
            return SimpleNamespace(free=free)

        monkeypatch.setattr(shutil, "disk_usage", usage)

    return set_to


def config_of(make_config: Any, **changes: Any) -> Config:
    return make_config(**{
        "data__workers": 4, "data__prefetch": 2, "training__batch_size": 8, "validation__clips": 64,
        "validation__batch_size": 5, **changes,
    })  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "processes", "needed"),
    [
        ({}, 1, 4 * 3 * 8 * 11.5),
        ({"data__workers": 1, "data__prefetch": 5}, 1, 1 * 6 * 8 * 11.5),
        ({"validation__clips": 256}, 1, 4 * 3 * (8 + 5) * 11.5),  # so many that workers read them, too
        ({}, 2, 2 * 4 * 3 * 8 * 11.5),
    ],
)
def test_what_the_workers_may_hold_is_counted(make_config, disk, changes: Any, processes: int, needed: float) -> None:
    config, clip = config_of(make_config, **changes), round(11.5 * MB)
    enough = round(needed * MB)
    disk(enough)
    assert small_shared_memory(config, clip, processes) is None
    disk(enough - 1000)
    assert small_shared_memory(config, clip, processes) is not None


def test_the_number_and_the_ways_out_are_told(make_config, disk) -> None:
    disk(64 * MB)
    said = small_shared_memory(config_of(make_config), round(11.5 * MB), 2)
    assert said == (
        f"{SHARED_MEMORY} has 0.064 GB free, and batches on their way from the loader's workers may take 2.21 GB:"
        " 2 processes x 4 workers x (2 prefetched + 1) x 8 clips of 11.5 MB. Where it is full, workers die of a bus"
        " error. Give a container more (docker run --shm-size=3g), or lower data.workers or data.prefetch"
    )


def test_a_system_without_shared_memory_is_not_asked_for_any(make_config, disk) -> None:
    disk(FileNotFoundError(SHARED_MEMORY))
    assert small_shared_memory(config_of(make_config), 10**15) is None


@pytest.fixture
def little(disk) -> None:
    """A machine with hardly any shared memory."""
    disk(1000)


def notes_of(reporter: Any) -> list[str]:
    return [note for note in reporter.notes if SHARED_MEMORY in note]


@pytest.mark.usefixtures("little")
def test_a_run_says_so_before_its_first_step_and_only_where_it_has_workers(make_config, reporter) -> None:
    set_up(make_config(), reporter)
    assert notes_of(reporter) == []
    set_up(make_config(data__workers=2), reporter)
    (said,) = notes_of(reporter)
    frames, numbers = 4 * 36 * 49 * 3, 4 * (4 * 7 + 3 * 7)
    assert f"2 workers x (2 prefetched + 1) x 2 clips of {(frames + numbers) / MB:.3g} MB" in said


@pytest.mark.usefixtures("little")
def test_cached_latents_count_as_what_they_are(make_config, reporter, tmp_path) -> None:
    config = make_config(data__cache="auto", data__cache_dir=str(tmp_path / "cache"), training__steps=1)
    train(config, reporter)
    assert notes_of(reporter) == []
    set_up(config.model_copy(update={"data": config.data.model_copy(update={"workers": 1})}), reporter)
    (said,) = notes_of(reporter)
    latents, numbers = 4 * 4 * 24 * 2, 4 * (4 * 7 + 3 * 7)  # 4 frames of 4 tokens of 24 numbers, bf16
    assert f"clips of {(latents + numbers) / MB:.3g} MB" in said
