"""Input checks: each component of a state and of a camera pose is checked, with tolerance for sensor noise."""

import math

import numpy as np
import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.input_checks import require_extrinsics, require_pose

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
        require_pose(changed(place, sign * wrong), where="state")
    for never in (math.nan, sign * math.inf):
        with pytest.raises(InputError, match=rf"{never}\b.* needed: 7 finite numbers") as caught:
            require_pose(changed(place, never), where="state")
        assert "degrees" not in str(caught.value)
    if place < 6:
        with pytest.raises(InputError, match=complaint):
            require_extrinsics(changed(place, sign * wrong)[:6], where="camera")


@pytest.mark.parametrize(
    ("place", "value"), [(6, 1.05), (6, -0.05), (6, 1.0), (5, -2 * math.pi), (3, math.pi), (0, 1.2), (2, -0.4)]
)
def test_what_a_robot_may_measure_is_taken(place: int, value: float) -> None:
    require_pose(changed(place, value), where="state")
    require_extrinsics(changed(place, value)[:6], where="camera")


@pytest.mark.parametrize("numbers", [5, 7])
def test_a_cameras_pose_has_six_numbers(numbers: int) -> None:
    with pytest.raises(InputError, match=f"{numbers} numbers"):
        require_extrinsics(np.zeros(numbers), where="camera")
