"""Key frames of synthetic demonstrations: gripper changes, stops, and every n-th frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vjepa2_ac.goals.key_frames import (
    MODEL_STEP_RULE,
    KeyFrame,
    Timing,
    add_frames_between,
    find_gripper_key_frames,
    make_sub_goals,
    select_every_nth_frame,
)


def make_states(*parts: tuple[int, float, float]) -> np.ndarray:
    """Return states that change linearly in each part (frames, change of x, change of gripper position)."""
    x, grip = [0.4], [0.0]
    for frames, metres, closes in parts:
        x += (x[-1] + metres * np.arange(1, frames + 1) / frames).tolist()
        grip += (grip[-1] + closes * np.arange(1, frames + 1) / frames).tolist()
    states = np.zeros((len(x), 7))
    states[:, 0], states[:, 3], states[:, 6] = x, np.pi, grip
    return states


def find_frames_and_names(states: np.ndarray) -> list[tuple[int, str]]:
    return [(key.frame, key.name) for key in find_gripper_key_frames(states)]


GO, LIFT = (10, 0.2, 0), (9, 0.2, 0)  # motions without a change of the gripper
CASES = {
    "a grasp and a lift": (
        (GO, (5, 0, 0.5), GO), [(10, "before closing"), (15, "closed"), (25, "end")],
    ),
    "a long stop": ((GO, (6, 0, 0), GO), [(10, "stop"), (26, "end")]),
    "a short stop": ((GO, (3, 0, 0), GO), [(23, "end")]),
    "a rest at the start": (((6, 0, 0), GO), [(16, "end")]),
    "a rest at the end": ((GO, (20, 0, 0)), [(10, "end")]),
    "a rest at the end after a grasp": ((GO, (4, 0, 0.4), (20, 0, 0)), [(10, "before closing"), (14, "closed")]),
    "stops next to a grasp": (
        (GO, (2, 0, 0), (5, 0, 0.5), (3, 0, 0), LIFT), [(12, "before closing"), (17, "closed"), (29, "end")],
    ),
    "a grasp at the start": (((5, 0, 0.5), GO), [(5, "closed"), (15, "end")]),
    "the arm leaves while the fingers still close slowly": (
        (GO, (4, 0, 0.25), (2, 0.04, 0.1), LIFT), [(10, "before closing"), (14, "closed"), (25, "end")],
    ),
    "a grasp without a stop": ((GO, (6, 0.12, 0.6), LIFT), [(10, "before closing"), (16, "closed"), (25, "end")]),
    "a pause of the fingers within a grasp": (
        (LIFT, (2, 0, 0.2), (2, 0, 0), (2, 0, 0.2), LIFT), [(9, "before closing"), (15, "closed"), (24, "end")],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("parts", "keys"), CASES.values(), ids=CASES)
def test_key_frames_are_gripper_changes_and_stops(parts: tuple, keys: list) -> None:
    assert find_frames_and_names(make_states(*parts)) == keys


@given(
    st.lists(
        st.tuples(st.integers(1, 12), st.sampled_from([0.0, 0.1, -0.2]), st.sampled_from([0.0, 0.0, 0.5])), min_size=1
    )
)
def test_key_frames_are_ascending_few_and_exclude_the_start(parts: list) -> None:
    states = make_states(*parts)
    states[:, 6] = np.abs((states[:, 6] + 1) % 2 - 1)  # alternating between 0 and 1
    for rule in (None, MODEL_STEP_RULE):
        frames = [key.frame for key in find_gripper_key_frames(states, rule)]
        assert frames == sorted(set(frames))
        assert 0 < frames[0] <= frames[-1] < len(states)


@given(st.integers(2, 60), st.integers(1, 20))
def test_every_nth_frame_ends_with_the_last_frame(frames: int, step: int) -> None:
    frame_numbers = [key.frame for key in select_every_nth_frame(frames, step)]
    gaps = np.diff([0, *frame_numbers])
    assert frame_numbers[-1] == frames - 1
    assert (gaps[:-1] == step).all()
    assert step / 2 <= gaps[-1] < 1.5 * step or len(frame_numbers) == 1


@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), st.integers(1, 6))
def test_added_frames_keep_the_key_frames_and_are_about_one_step_apart(gaps: list[int], step: int) -> None:
    keys = [KeyFrame(int(frame), f"key {frame}") for frame in np.cumsum(gaps)]
    extended = add_frames_between(keys, step)
    assert [key for key in extended if key.name != "on the way"] == keys
    distances = np.diff([0, *(key.frame for key in extended)])
    assert (distances >= 1).all()
    assert (distances < 1.5 * step).all() if step > 1 else (distances == 1).all()


def test_goals_have_durations_and_gripper_modes_of_the_demonstration() -> None:
    states = make_states((10, 0.2, 0), (5, 0, 0.5), (21, 0.2, 0))
    keys = find_gripper_key_frames(states)
    images = [np.full((16, 16, 3), number, np.uint8) for number in range(len(keys))]
    goals = make_sub_goals(images, keys, Timing(stride=4, slack=2, share=0.5), states)
    assert [(goal.at_least, goal.at_most) for goal in goals] == [(1, 5), (1, 4), (4, None)]
    assert [goal.gripper for goal in goals] == ["held", "close", "held"]
    assert [goal.share for goal in goals] == [0.5, 0.5, None]
    assert [goal.name for goal in goals] == ["before closing", "closed", "end"]
    assert [goal.gripper for goal in make_sub_goals(images, keys, Timing())] == [None] * 3
