"""Actions as short text: what people would call them."""

import numpy as np
import pytest

from vjepa2_ac.reports.figures.film.action_text import action_text
from vjepa2_ac.spaces import vector_actions


@pytest.mark.parametrize(
    ("action", "text"),
    [
        ([0, 0, 0.02, 0, 0, 0, 0], "up 2.0 cm"),
        ([0, -0.011, -0.005, 0, 0, 0, 1], "right 1.1, down 0.5 cm, close"),
        ([0.01, 0.03, 0, 0, 0, 0, -0.6], "left 3.0, forward 1.0 cm, open"),
        ([-0.01, 0, 0, 0, 0, 0, 0.2], "back 1.0 cm, close 0.2"),
        ([0, 0, 0, 0, 0, np.deg2rad(-5), 0], "yaw -5°"),
        ([0.0004, 0, 0, 0.001, 0, 0, 0.01], "still"),
        ([0] * 7, "still"),
    ],
)
def test_a_pose_change_is_read_in_centimetres_degrees_and_grip(action: list[float], text: str) -> None:
    assert action_text(np.array(action, dtype=np.float64)) == text


def test_a_vector_is_its_first_numbers() -> None:
    assert action_text(np.array([0.5, -1.0]), vector_actions(2, "change")) == "+0.5 -1"
    assert action_text(np.arange(9.0), vector_actions(9, "unknown")) == "+0 +1 +2 +3 ..."


def test_an_action_of_another_width_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(6,\) in a space of 7"):
        action_text(np.zeros(6))
