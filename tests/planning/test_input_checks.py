"""Input checks: each component of a state and of a camera pose is checked, with tolerance for sensor noise."""

import math

import numpy as np
import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import EXTRINSICS, POSE, vector_states

STATE = (0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2)


def changed(place: int, value: float) -> np.ndarray:
    state = np.array(STATE)
    state[place] = value
    return state


@pytest.mark.parametrize("place", range(7))
@pytest.mark.parametrize("sign", [1, -1])
def test_an_invalid_number_is_refused_at_any_position(place: int, sign: int) -> None:
    complaint = ["millimetres", "degrees", "0 for open"][place // 3]
    wrong = {0: 300.0, 1: 90.0, 2: 1.2 if sign > 0 else 0.2}[place // 3]
    with pytest.raises(InputError, match=complaint):
        POSE.require_state(changed(place, sign * wrong), "state")
    for never in (math.nan, sign * math.inf):
        with pytest.raises(InputError, match=rf"{never}\b.* needed: finite numbers") as caught:
            POSE.require_state(changed(place, never), "state")
        assert "degrees" not in str(caught.value)
    if place < 6:
        with pytest.raises(InputError, match=complaint):
            EXTRINSICS.require_state(changed(place, sign * wrong)[:6], "camera")


def test_what_a_robot_may_measure_is_taken() -> None:
    for place, value in ((6, 1.05), (6, -0.05), (6, 1.0), (5, -2 * math.pi), (3, math.pi), (0, 1.2), (2, -0.4)):
        POSE.require_state(changed(place, value), "state")
        EXTRINSICS.require_state(changed(place, value)[:6], "camera")


def test_a_pose_has_its_numbers_and_a_vector_any_that_are_finite() -> None:
    vector_states(2).require_state(np.array([300.0, -90.0]), "state")
    for numbers, space, complaint in (
        (np.zeros(5), EXTRINSICS, "5 numbers"),
        (np.zeros(7), EXTRINSICS, "7 numbers"),
        (np.zeros(3), vector_states(2), r"3 numbers .* needed: 2: state 0, state 1"),
        (np.array([0.0, math.nan]), vector_states(2), "needed: finite numbers"),
    ):
        with pytest.raises(InputError, match=complaint):
            space.require_state(numbers, "state")
