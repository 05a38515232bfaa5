"""State and action spaces: parts, units, plausibility checks and action semantics."""

import math

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.indexed_source import get_spaces, get_state_space
from vjepa2_ac.episode import POSE_WIDTHS, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import (
    CAMERA_POSE,
    EXTRINSICS,
    POSE,
    POSE_CHANGE,
    POSES,
    Spaces,
    make_vector_states,
    require_finite,
)

STATES = np.array([[0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2], [0.5, 0.1, 0.3, -3.1, 0.0, 0.2, 0.3]])


def test_rotations_are_composed_and_vectors_subtract() -> None:
    assert abs(POSE.compute_differences(STATES)[0, 3]) < 0.1, "angles jump at pi"
    np.testing.assert_array_equal(make_vector_states(7).compute_differences(STATES), np.diff(STATES, axis=0))


def test_implausible_state_raises_with_step_and_fix() -> None:
    implausible = STATES.copy()
    implausible[1, 1] = 400.0
    with pytest.raises(InputError, match=r"a\.h5: step 1: .*millimetres.*Check the fields"):
        POSE.require_plausible(implausible, "a.h5", fix="Check the fields")
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
def test_episode_in_other_units_names_the_likely_unit(scale: list[float], hints: list[str]) -> None:
    states = np.tile(STATES, (10, 1)) * scale
    with pytest.raises(InputError) as raised:
        POSE.require_plausible(states, "a.h5", fix="Check the fields")
    assert [sentence.split(":")[0] for sentence in raised.value.fix.split(". ")] == [
        *(f"The {hint}" for hint in hints), "Check the fields",
    ]  # fmt: skip


@pytest.mark.parametrize("column", [0, 4])
def test_single_outlier_does_not_suggest_another_unit(column: int) -> None:
    states = np.tile(STATES, (10, 1))
    states[7, column] = 300.0
    with pytest.raises(InputError, match=r"step 7") as raised:
        POSE.require_plausible(states, "a.h5", fix="Check the fields")
    assert raised.value.fix == "Check the fields"


def test_vectors_need_finite_numbers_and_at_least_one_step() -> None:
    require_finite(np.full((2, 3), 1e6), "here", fix="")
    with pytest.raises(InputError, match=r"here: step 1: .*finite numbers"):
        require_finite(np.array([[0.0], [np.inf]]), "here", fix="")
    with pytest.raises(InputError, match="no steps"):
        require_finite(np.zeros((0, 3)), "here", fix="")


@pytest.mark.parametrize(
    ("options", "widths", "effect"),
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
def test_action_semantics_follow_the_config(options: dict[str, object], widths: Widths, effect: str) -> None:
    spaces = get_spaces(DataConfig(path="d", source="npz", states="vector", **options), widths)
    assert (spaces.action.effect, spaces.widths) == (effect, widths)


def test_pose_frame_is_the_config_frame_and_reading_uses_the_base_frame() -> None:
    camera = DataConfig(path="d", source="npz", pose_frame="camera")
    assert get_spaces(DataConfig(path="d"), POSE_WIDTHS) == POSES
    assert get_spaces(camera, POSE_WIDTHS) == Spaces(CAMERA_POSE, POSE_CHANGE)
    assert get_state_space(camera, 7) == POSE


# Checks of the state to plan from


def changed(column: int, value: float) -> np.ndarray:
    state = STATES[0].copy()
    state[column] = value
    return state


@pytest.mark.parametrize("column", range(7))
@pytest.mark.parametrize("sign", [1, -1])
def test_invalid_number_raises_at_any_index(column: int, sign: int) -> None:
    message = ["millimetres", "degrees", "0 for open"][column // 3]
    wrong = {0: 300.0, 1: 90.0, 2: 1.2 if sign > 0 else 0.2}[column // 3]
    with pytest.raises(InputError, match=message):
        POSE.require_state(changed(column, sign * wrong), "state")
    for non_finite in (math.nan, sign * math.inf):
        with pytest.raises(InputError, match=rf"{non_finite}\b.* Expected finite numbers") as caught:
            POSE.require_state(changed(column, non_finite), "state")
        assert "degrees" not in str(caught.value)
    if column < 6:
        with pytest.raises(InputError, match=message):
            EXTRINSICS.require_state(changed(column, sign * wrong)[:6], "camera")


def test_plausible_states_are_accepted() -> None:
    for column, value in ((6, 1.05), (6, -0.05), (6, 1.0), (5, -2 * math.pi), (3, math.pi), (0, 1.2), (2, -0.4)):
        POSE.require_state(changed(column, value), "state")
        EXTRINSICS.require_state(changed(column, value)[:6], "camera")


def test_require_state_checks_width_and_finiteness() -> None:
    make_vector_states(2).require_state(np.array([300.0, -90.0]), "state")
    for numbers, space, message in (
        (np.zeros(5), EXTRINSICS, "5 numbers"),
        (np.zeros(7), EXTRINSICS, "7 numbers"),
        (np.zeros(3), make_vector_states(2), r"3 numbers .* Expected 2: state 0, state 1"),
        (np.array([0.0, math.nan]), make_vector_states(2), "Expected finite numbers"),
    ):
        with pytest.raises(InputError, match=message):
            space.require_state(numbers, "state")
