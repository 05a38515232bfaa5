"""A step is moving if the hand moves, turns or grips enough; sizes are in centimetres."""

import numpy as np
import pytest

from vjepa2_ac.evaluation.evaluate import clips_of, strata_of
from vjepa2_ac.evaluation.result import Clips
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace, vector_actions


def of(*actions: list[float], space: ActionSpace = POSE_CHANGE) -> Clips:
    steps = np.array(actions)[None]
    return clips_of(steps, ("a",), (0,), space=space, seconds_per_step=0.5)


@pytest.mark.parametrize(
    ("action", "moves"),
    [
        ([0.0] * 7, False),
        ([0.009, 0, 0, 0, 0, 0, 0], False),  # 1.8 cm/s
        ([0.0, 0.008, 0.008, 0, 0, 0, 0], True),  # 2.26 cm/s
        ([0, 0, 0, 0, 0, 0.08, 0], False),  # 9.2 degrees/s
        ([0, 0, 0, 0.1, 0, 0, 0], True),  # 11.5 degrees/s
        ([0, 0, 0, 0, 0, 0, -0.06], True),
        ([0, 0, 0, 0, 0, 0, 0.04], False),
    ],
)
def test_a_step_moves_if_the_hand_goes_turns_or_grips(action: list[float], moves: bool) -> None:
    clips = of(action)
    assert clips.moving.tolist() == [[moves]]
    assert clips.action_size[0, 0] == pytest.approx(np.linalg.norm(action[:3]) * 100)


def test_vectors_move_beside_their_largest_ones() -> None:
    clips = of([1.0, 0.0], [0.05, 0.0], [0.0, 0.2], [0.0, 0.0], space=vector_actions(2, "change"))
    assert clips.moving.tolist() == [[True, False, True, False]]
    assert not of([0.0, 0.0], space=vector_actions(2, "change")).moving.any(), "nothing at all is no motion"


def test_thirds_are_named_by_their_range_and_what_is_empty_is_left_out() -> None:
    still = strata_of(of([0.0] * 7, [0.0] * 7), POSE_CHANGE)
    assert [(part.name, int(part.steps.sum())) for part in still] == [("idle", 2), ("0.0 to 0.0 cm", 2)]
    parts = strata_of(of(*([0.01 * n, 0, 0, 0, 0, 0, 0] for n in range(1, 7))), POSE_CHANGE)
    names = [part.name for part in parts if part.kind == "action size"]
    assert names == ["1.0 to 2.0 cm", "3.0 to 4.0 cm", "5.0 to 6.0 cm"]
