"""Broken episodes: how many may be skipped; every fix that an error names works."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clips import open_memory_source
from memory_source import MemorySource
from vjepa2_ac.config.sources import NpzData
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index import EpisodeProblem
from vjepa2_ac.data.loader import read_batches
from vjepa2_ac.data.selection import max_broken
from vjepa2_ac.errors import InputError

Use = Callable[..., Dataset]  # opens a data set with the given config values, and reads it


@pytest.mark.parametrize(
    ("episodes", "allowed"),
    [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2), (5, 2), (6, 3), (20, 3), (100, 3), (399, 3), (400, 4), (95_658, 956)],
)
def test_broken_episode_limit_is_three_or_one_percent_and_half_of_small_sets(episodes: int, allowed: int) -> None:
    assert max_broken(episodes) == allowed


# ---- every fix that an error names works, for broken episodes of each origin ----


def broken_in_the_index(episodes: int, broken: int, _folder: Path) -> Use:
    problems = [EpisodeProblem(f"bad {number}", f"record {number}", "all zeros") for number in range(broken)]
    return lambda **values: open_memory_source(MemorySource([20] * (episodes - broken), problems=problems), **values)


def broken_in_idle_filter(episodes: int, broken: int, folder: Path) -> Use:
    options = {"idle": {"rule": "motion"}, "disk_cache": {"dir": str(folder)}}
    source = MemorySource([60] * episodes, unreadable=frozenset(range(episodes - broken, episodes)))
    return lambda **values: open_memory_source(source, **options, **values)


def broken_in_a_clip(episodes: int, broken: int, _folder: Path) -> Use:
    source = MemorySource([6] * episodes, pictureless=frozenset(range(broken)))

    def use(**values: Any) -> Dataset:
        dataset = open_memory_source(source, **values)
        windows = dataset.windows("train")
        list(read_batches(dataset, [windows[index] for index in range(len(windows))], batch_size=2))
        return dataset

    return use


def duplicate_identities(episodes: int, broken: int, _folder: Path) -> Use:
    names = ["same"] * (broken + 1) + [f"episode {number}" for number in range(episodes - broken - 1)]
    return lambda **values: open_memory_source(MemorySource([20] * episodes, names=names), **values)


def broken_files(episodes: int, broken: int, folder: Path) -> Use:
    steps = np.arange(30)[:, None]
    for number in range(episodes):
        states = np.tile((steps * 0.01 + number * 0.001) % 1, 7)
        states[5] = np.nan if number < broken else states[5]
        frames = np.zeros((30, 8, 8, 3), np.uint8)
        np.savez(folder / f"{number:03d}.npz", states=states, frames=frames, fps_hz=4.0)
    shares = {"validation_share": 0.0, "test_share": 0.0, "disk_cache": {"dir": str(folder / "cache")}}
    return lambda **values: open_dataset(NpzData(path=str(folder), **shares, **values))


def parse_fixes(error: InputError) -> dict[str, Mapping[str, Any]]:
    """Return the config values that a fix names, by the name of the option."""
    fixes: dict[str, Mapping[str, Any]] = {}
    if "data.broken_episodes: skip" in error.fix:
        fixes["skip"] = {"broken_episodes": "skip"}
    if match := re.search(r"to data\.exclude: (\[.*\])", error.fix):
        fixes["exclude"] = {"exclude": tuple(json.loads(match[1]))}
    return fixes


def follow_exclusions(use: Use, **values: Any) -> None:
    """Exclude the episodes that each error names until no error remains; fail if an error names no new episode."""
    excluded: tuple[str, ...] = ()
    while True:
        try:
            use(exclude=excluded, **values)
        except InputError as error:
            new_names = parse_fixes(error)["exclude"]["exclude"]
            assert not set(new_names) & set(excluded)
            excluded += new_names
        else:
            return


SIZES = [  # numbers of all episodes and of broken episodes
    (1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (4, 2), (4, 3), (6, 3), (6, 4), (20, 1), (20, 12), (100, 4), (400, 4),
]  # fmt: skip
CASES = [
    (make, episodes, broken)
    for make in (
        broken_in_the_index,
        broken_in_idle_filter,
        broken_in_a_clip,
        duplicate_identities,
        broken_files,
    )
    for episodes, broken in (SIZES if make is not broken_files else SIZES[:-2])
    if make is not duplicate_identities or broken < episodes
]


@pytest.mark.parametrize(("make", "episodes", "broken"), CASES)
def test_each_fix_in_a_broken_episode_error_works(
    make: Callable[..., Use], episodes: int, broken: int, tmp_path: Path
) -> None:
    use = make(episodes, broken, tmp_path)
    with pytest.raises(InputError) as caught:
        use()
    fixes = parse_fixes(caught.value)
    num_reported = 1 if make is broken_in_a_clip else broken  # broken episodes that are known when the error is raised
    may_be_skipped = num_reported <= max_broken(episodes) and make is not duplicate_identities
    has_other_episodes = num_reported < (episodes - 1 if make is duplicate_identities else episodes)
    assert list(fixes) == ["skip"] * may_be_skipped + ["exclude"] * has_other_episodes
    if "exclude" in fixes and broken < episodes:
        follow_exclusions(use)
    if broken <= max_broken(episodes) and "skip" in fixes:
        assert len(use(**fixes["skip"]).broken) == broken
    elif make is not duplicate_identities and broken < episodes:
        with pytest.raises(InputError, match=rf"of {episodes} episodes are broken.* at most") as caught:
            use(broken_episodes="skip")
        assert list(parse_fixes(caught.value)) == ["exclude"]
        follow_exclusions(use, broken_episodes="skip")
