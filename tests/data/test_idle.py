"""Idle steps: the same ranges as in openpi; steps with motion are never idle; ranges are cached."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clips import open_memory_source
from gcs import Gcs
from memory_source import MemorySource
from paths import GOLDEN
from synthetic import synthetic_states
from vjepa2_ac.config import IdleConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.idle import find_idle_by_commands, find_idle_by_motion, find_moving_ranges
from vjepa2_ac.errors import InputError

COMMANDS = IdleConfig(rule="commands")
MOTION = IdleConfig(rule="motion")


def states_with_rests(steps: int, rests: list[tuple[int, int]], *, seed: int = 0) -> np.ndarray:
    """Return a trajectory in which nothing changes during the rests: step t equals step t - 1."""
    states = synthetic_states(steps, seed=seed)
    for start, end in rests:
        states[start:end] = states[start - 1]
    return states


def test_commands_rule_keeps_the_same_ranges_as_openpi() -> None:
    golden = np.load(GOLDEN / "idle_ranges.npz")
    for number in range(3):
        idle = find_idle_by_commands(golden[f"velocities_{number}"].astype(np.float64), COMMANDS)
        assert find_moving_ranges(idle, COMMANDS) == [tuple(pair) for pair in golden[f"ranges_{number}"].tolist()]


@pytest.mark.parametrize("number", range(7))
def test_translation_rotation_or_gripper_motion_is_not_idle(number: int) -> None:
    states = np.tile(np.array([0.5, 0.0, 0.3, np.pi, 0.0, 1.0, 0.5]), (30, 1))
    states[:, number] += np.linspace(0, 0.5, 30)
    assert not find_idle_by_motion(states, MOTION)[1:].any()
    assert find_idle_by_motion(states[:1].repeat(30, axis=0), MOTION)[1:].all()


def test_idle_steps_are_detected_where_roll_wraps() -> None:
    states = states_with_rests(60, [(20, 40)])
    states[20:40, 3] += np.where(np.arange(20) % 2, 2 * np.pi, 0)  # the same angle, plus 2 pi
    idle = find_idle_by_motion(states, MOTION)
    assert np.flatnonzero(idle).tolist() == list(range(20, 40))
    assert find_moving_ranges(idle, MOTION) == [(0, 10), (40, 50)]


def test_long_idle_runs_and_short_moves_are_removed() -> None:
    def ranges(rests: list[tuple[int, int]], **options: Any) -> list[tuple[int, int]]:
        idle = np.zeros(80, bool)
        for start, end in rests:
            idle[start:end] = True
        return find_moving_ranges(idle, IdleConfig(rule="motion", **options))

    assert ranges([(30, 36)]) == [(0, 70)]
    assert ranges([(30, 37)]) == [(0, 20), (37, 70)]
    assert ranges([(15, 30)]) == [(30, 70)], "15 steps are too short to keep"
    assert ranges([(16, 30)]) == [(0, 6), (30, 70)]
    assert ranges([(30, 37)], cut_last_steps=0) == [(0, 30), (37, 80)]
    assert ranges([(5, 80)], shortest_kept_steps=1) == [], "nothing is left of 5 steps without the last 10"
    assert ranges([(0, 80)]) == []


@settings(max_examples=60)
@given(idle=st.lists(st.booleans(), max_size=120))
def test_selected_ranges_are_disjoint_and_contain_no_long_idle_run(idle: list[bool]) -> None:
    ranges = find_moving_ranges(np.array(idle, bool), MOTION)
    edges = [edge for pair in ranges for edge in pair]
    assert edges == sorted(set(edges))
    assert all(0 <= edge <= len(idle) for edge in edges)
    for start, end in ranges:
        assert "1" * 7 not in "".join(str(int(is_idle)) for is_idle in idle[start:end])


# ---- ranges of a data set are computed once and cached ----


@pytest.fixture
def open_with(tmp_path: Path) -> Any:
    return partial(open_memory_source, path=str(tmp_path / "set"), disk_cache={"dir": str(tmp_path / "cache")})


def source_with_rests(lengths: list[int] | None = None, **options: Any) -> MemorySource:
    return MemorySource(
        lengths or [60, 40, 80],
        states=lambda index: states_with_rests((lengths or [60, 40, 80])[index], [(20, 35)]),
        **options,
    )


def starts(dataset: Dataset) -> set[tuple[int, int]]:
    windows = dataset.windows("train")
    return {windows[index] for index in range(len(windows))}


def test_clips_are_inside_the_selected_ranges(open_with: Any) -> None:
    dataset = open_with(source_with_rests(), idle=MOTION)
    assert [dataset.selected_steps.ranges_of(episode) for episode in range(3)] == [
        ((0, 10), (35, 50)),
        ((0, 10),),
        ((0, 10), (35, 70)),
    ]
    assert starts(dataset) == {
        (episode, start)
        for episode in range(3)
        for first, end in dataset.selected_steps.ranges_of(episode)
        for start in range(first, end - 4)
    }
    removal = {removed.name: removed for removed in dataset.removed}["idle"]
    assert (removal.episodes, removal.steps) == (0, 180 - 25 - 10 - 45)
    assert removal.windows == 56 + 36 + 76 - len(starts(dataset))


def test_idle_ranges_are_computed_once(open_with: Any) -> None:
    first, second, third = source_with_rests(), source_with_rests(), source_with_rests()
    ranges = open_with(first, idle=MOTION).selected_steps
    other_ranges = open_with(second, idle=MOTION, exclude=("episode 1",), stride=3).selected_steps
    assert [index for index, *_ in first.reads] == [0, 1, 2]
    assert second.reads == []
    assert other_ranges.ranges_of(2) == ranges.ranges_of(2)
    assert other_ranges.ranges_of(1) == ()
    open_with(third, idle=MOTION.model_copy(update={"cut_last_steps": 4}))
    assert len(third.reads) == 3, "another rule needs all episodes again"


def test_episode_that_fails_while_ranges_are_computed_is_broken(open_with: Any, caplog: Any) -> None:
    lengths = [60] * 200
    source = source_with_rests(lengths, unreadable=frozenset({7, 9}))
    with pytest.raises(InputError, match=r"memory: episode 7: damaged\. 1 more.*\[\"episode 7\", \"episode 9\"\]"):
        open_with(source, idle=MOTION)
    dataset = open_with(source, idle=MOTION, broken_episodes="skip")
    assert "2 of 200 episodes are broken and skipped: episode 7, episode 9" in caplog.text
    assert not dataset.is_selected[[7, 9]].any()
    assert {removal.name: removal.episodes for removal in dataset.removed}["broken"] == 2
    assert len(open_with(source, idle=MOTION, exclude=("episode 7", "episode 9")).broken) == 0


def test_wrong_idle_setting_raises_after_ten_episodes(open_with: Any) -> None:
    source = MemorySource([40] * 50)
    with pytest.raises(InputError, match="no commanded joint velocities"):
        open_with(source, idle=COMMANDS, broken_episodes="skip")
    assert len(source.reads) <= 14


# ---- ranges from a published list ----


def published(tmp_path: Path, content: object) -> dict[str, Any]:
    path = tmp_path / "ranges.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return {"idle": IdleConfig(rule="published", ranges=str(path))}


def test_published_ranges_are_matched_by_identity(open_with: Any, tmp_path: Path, caplog: Any, gcs: Gcs) -> None:
    ranges = {"episode 1": [[0, 12], [20, 40]], "elsewhere": [[0, 9999]], "episode 2": []}
    source = source_with_rests()
    dataset = open_with(source, **published(tmp_path, ranges))
    assert [dataset.selected_steps.ranges_of(episode) for episode in range(3)] == [(), ((0, 12), (20, 40)), ()]
    assert "lists 2 of the 3 episodes; the other 1 are treated as idle" in caplog.text
    assert source.reads == []
    assert starts(dataset) == {(1, start) for start in (*range(8), *range(20, 36))}
    other = open_with(source, **published(tmp_path, {"episode 1": [[0, 13]]}))
    assert other.selected_steps.ranges_of(1) == ((0, 13),), "a changed list is read again"
    url = gcs.put("robots/ranges.json", json.dumps({"episode 1": [[0, 13]]}).encode())
    assert open_with(source, idle=IdleConfig(rule="published", ranges=url)).selected_steps.ranges_of(1) == ((0, 13),)
    with pytest.raises(InputError, match=r"nowhere\.json: cannot be read"):
        open_with(source, idle=IdleConfig(rule="published", ranges=str(tmp_path / "nowhere.json")))


BAD_LISTS = {
    "of another set": (
        {"elsewhere": [[0, 3]]},
        r"none of the 3 episodes .*first entry is elsewhere.*episode 0",
    ),
    **{
        str(wrong): ({"episode 1": wrong}, r"ranges\.json: episode 1: .*pairs \[start, end\) of steps from 0 to 40")
        for wrong in ([[0, 41]], [[0, 9], [5, 12]], [[9, 3]], [1, 2], [[0, "9"]], None)
    },
    "not an object": ([1, 2], r"a JSON list"),
    "not JSON": ("{", r"invalid JSON"),
}


@pytest.mark.parametrize(("content", "message"), BAD_LISTS.values(), ids=BAD_LISTS.keys())
def test_mismatched_range_list_raises(open_with: Any, tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        open_with(source_with_rests(), **published(tmp_path, content))
    assert "ranges.json" in caught.value.where
