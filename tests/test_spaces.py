"""Spaces say what each number is; whoever asks for a position, a rotation or a gripper gets that of the space."""

import math

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.indexed_source import measured_space, spaces_of
from vjepa2_ac.episode import POSE_WIDTHS, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import (
    CAMERA_POSE,
    POSE,
    POSE_CHANGE,
    POSES,
    Spaces,
    require_finite,
    vector_states,
)

STATES = np.array([[0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2], [0.5, 0.1, 0.3, -3.1, 0.0, 0.2, 0.3]])


def test_rotations_are_composed_and_vectors_subtract() -> None:
    assert abs(POSE.differences(STATES)[0, 3]) < 0.1, "angles jump at pi"
    np.testing.assert_array_equal(vector_states(7).differences(STATES), np.diff(STATES, axis=0))


@pytest.mark.parametrize(
    ("place", "value", "complaint"),
    [
        (1, 400.0, "millimetres"), (4, 90.0, "degrees"), (6, 1.3, "0 for open"), (6, -0.2, "0 for open"),
        (2, math.nan, "finite"),
    ],
)  # fmt: skip
def test_what_no_robot_measures_is_named_with_its_step_and_what_it_looks_like(
    place: int, value: float, complaint: str
) -> None:
    spoiled = STATES.copy()
    spoiled[1, place] = value
    with pytest.raises(InputError, match=rf"a\.h5: step 1: .*{complaint}"):
        POSE.require_plausible(spoiled, "a.h5")
    with pytest.raises(InputError, match=f"{complaint}.*Check the fields"):
        POSE.require_plausible(spoiled, "a.h5", fix="Check the fields")
    POSE.require_plausible(STATES, "a.h5")


@pytest.mark.parametrize(
    ("scale", "hints"),
    [
        ([1000, 1000, 1000, 57.3, 57.3, 57.3, 1], ["positions look like millimetres", "angles look like degrees"]),
        ([100, 100, 100, 1, 1, 1, 1], ["positions look like centimetres"]),
        ([1, 1, 1, 57.3, 57.3, 57.3, 1], ["angles look like degrees"]),
        ([1e6, 1e6, 1e6, 1, 1, 1, 1], []),
        ([1, 1, 1, 1e3, 1e3, 1e3, 1], []),
    ],
    ids=["millimetres and degrees", "centimetres", "degrees", "no length", "no angles"],
)
def test_a_whole_episode_in_other_units_is_said_to_look_like_them(scale: list[float], hints: list[str]) -> None:
    states = np.tile(STATES, (10, 1)) * scale
    with pytest.raises(InputError) as raised:
        POSE.require_plausible(states, "a.h5", fix="Check the fields")
    assert [sentence.split(":")[0] for sentence in raised.value.fix.split(". ")] == [
        *(f"The {hint}" for hint in hints), "Check the fields",
    ]  # fmt: skip


@pytest.mark.parametrize("place", [0, 4])
def test_a_single_outlier_is_not_said_to_be_another_unit(place: int) -> None:
    states = np.tile(STATES, (10, 1))
    states[7, place] = 300.0
    with pytest.raises(InputError, match=r"step 7") as raised:
        POSE.require_plausible(states, "a.h5", fix="Check the fields")
    assert raised.value.fix == "Check the fields"


def test_any_finite_numbers_may_be_a_vector_and_an_episode_has_steps() -> None:
    require_finite(np.full((2, 3), 1e6), "here", fix="")
    with pytest.raises(InputError, match=r"here: step 1: .*finite numbers"):
        require_finite(np.array([[0.0], [np.inf]]), "here", fix="")
    with pytest.raises(InputError, match="no steps"):
        require_finite(np.zeros((0, 3)), "here", fix="")


@pytest.mark.parametrize(
    ("knobs", "widths", "follows"),
    [
        ({}, Widths(8, 8), "change"),
        ({"actions": "recorded", "join_actions": "sum"}, Widths(8, 8), "change"),
        ({"actions": "recorded", "join_actions": "last"}, Widths(8, 8), "target"),
        ({"actions": "recorded", "stride": 1}, Widths(8, 8), "unknown"),
        ({"actions": "recorded", "stride": 1, "join_actions": "last"}, Widths(8, 8), "target"),
        ({"actions": "recorded", "join_actions": "mean"}, Widths(8, 8), "unknown"),
        ({"actions": "recorded", "join_actions": "sum"}, Widths(8, 7), "unknown"),
    ],
)
def test_which_state_follows_from_an_action_is_what_the_config_says_of_it(
    knobs: dict[str, object], widths: Widths, follows: str
) -> None:
    spaces = spaces_of(DataConfig(path="d", source="npz", states="vector", **knobs), widths)
    assert (spaces.action.follows, spaces.widths) == (follows, widths)


def test_poses_are_in_the_frame_of_the_config_and_read_in_that_of_the_base() -> None:
    camera = DataConfig(path="d", source="npz", pose_frame="camera")
    assert spaces_of(DataConfig(path="d"), POSE_WIDTHS) == POSES
    assert spaces_of(camera, POSE_WIDTHS) == Spaces(CAMERA_POSE, POSE_CHANGE)
    assert measured_space(camera, 7) == POSE
