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


@pytest.mark.parametrize(("step_m", "labels"), [(0.01, ("1 to 2", "3 to 4", "5 to 6")), (1e-6, ("0.0001 to 0.0002",))])
def test_thirds_have_the_same_keys_for_all_data_and_show_their_range(step_m: float, labels: tuple[str, ...]) -> None:
    parts = strata_of(of(*([step_m * n, 0, 0, 0, 0, 0, 0] for n in range(1, 7))), POSE_CHANGE)
    thirds = [part for part in parts if part.key.startswith("action_size.")]
    assert [part.key for part in thirds] == [f"action_size.{size}" for size in ("small", "medium", "large")]
    for part, size, label in zip(thirds, ("small", "medium", "large"), labels, strict=False):
        assert part.label == f"{size}: {label} cm"


def test_empty_strata_are_left_out() -> None:
    still = strata_of(of([0.0] * 7, [0.0] * 7), POSE_CHANGE)
    assert [(part.label, int(part.steps.sum())) for part in still] == [("idle", 2), ("large: 0 to 0 cm", 2)]
