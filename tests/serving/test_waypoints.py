"""Waypoints: even steps that end at the target."""

import numpy as np
import pytest

from vjepa2_ac.serving.session import waypoints
from vjepa2_ac.spaces import actions_from_states, apply_action

STATE = np.array([0.4, 0.1, 0.3, np.pi - 0.02, 0.1, -1.2, 0.5])
ACTION = np.array([0.02, -0.01, 0.03, 0.3, -0.2, 0.4, 0.25])


@pytest.mark.parametrize("steps", [1, 4, 7])
def test_they_are_even_and_the_last_one_is_the_target(steps: int) -> None:
    found = waypoints(STATE, ACTION, steps)
    np.testing.assert_array_equal(found[-1], apply_action(STATE, ACTION))
    changes = actions_from_states(np.concatenate([STATE[None], found]))
    np.testing.assert_allclose(changes, np.broadcast_to(changes[0], changes.shape), atol=1e-9)
    np.testing.assert_allclose(changes[:, :3].sum(axis=0), ACTION[:3], atol=1e-12)


def test_no_action_stays_where_it_is_and_a_gripper_is_between_open_and_closed() -> None:
    np.testing.assert_allclose(waypoints(STATE, np.zeros(7), 3), np.tile(STATE, (3, 1)), atol=1e-12)
    closing = np.array([0, 0, 0, 0, 0, 0, 1.0])
    assert waypoints(STATE, closing, 4)[:, 6].tolist() == [0.75, 1.0, 1.0, 1.0]
