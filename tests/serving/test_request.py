"""Requests: the dialects of openpi's clients are one record, and what is missing is told by name."""

import numpy as np
import pytest

from served import STATE, image
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.request import read_request

OURS = {"observation/image": image(0), "observation/state": STATE}
GOALS = np.stack([image(1), image(2)])
RULED = {**OURS, "goal/images": GOALS}


def test_droid_and_roboarena_and_a_plain_client_say_the_same() -> None:
    pose = {"observation/cartesian_position": STATE[:6], "observation/gripper_position": STATE[6:]}
    others = {"observation/joint_position": np.zeros(7), "observation/wrist_image_left": image(9), "client": "theirs"}
    for message in (
        OURS,
        {"observation/exterior_image_1_left": image(0), **pose, **others},
        {"observation/exterior_image_0_left": image(0), **pose, **others, "endpoint": "infer", "session_id": "a"},
        {"observation/image": image(0), "observation/state": STATE.tolist()},
        {"observation/image": image(0), **pose, "observation/gripper_position": float(STATE[6])},
    ):
        found = read_request(message)
        np.testing.assert_array_equal(found.frame, image(0))
        np.testing.assert_array_equal(found.state, STATE)
        assert found.state.dtype == np.float64
        assert not found.begins
        assert found.goal is None


def test_the_picture_may_have_another_key() -> None:
    message = {"camera": image(3), **OURS}
    np.testing.assert_array_equal(read_request(message, ["camera"]).frame, image(3))
    with pytest.raises(InputError, match="the picture of the camera, as top"):
        read_request(OURS, ["top"])


def test_a_goal_is_a_picture_or_several_or_a_name_or_a_prompt() -> None:
    one = read_request({**OURS, "goal/image": image(1), "goal/mask": np.ones((48, 60), dtype=bool)}).goal
    assert ([rule(goal) for goal in one.goals], one.mask.shape) == ([(1, None, None, None)], (48, 60))
    for images in (GOALS, list(GOALS)):
        several = read_request({**OURS, "goal/images": images, "goal/rules": [{"at_most": 4}, {}]}).goal
        assert [rule(goal) for goal in several.goals] == [(1, 4, None, None), (1, None, None, None)]
    assert read_request({**OURS, "goal/name": "cup"}).goal.name == "cup"
    assert read_request({**OURS, "prompt": "cup"}).goal.name == "cup"
    assert read_request({**OURS, "goal/image": image(1), "prompt": "put it there"}).goal.goals


def rule(goal: SubGoal) -> tuple:
    return goal.at_least, goal.at_most, goal.share, goal.gripper


def test_goals_in_order_may_have_rules_of_their_own() -> None:
    rules = [{"name": "grasp", "at_least": 2, "at_most": 9, "share": 0.25, "gripper": "held"}, {"at_least": 3}]
    keys = {"goal/images": GOALS, "goal/rules": rules}
    found = read_request({**OURS, **keys}).goal
    assert [rule(goal) for goal in found.goals] == [(2, 9, 0.25, "held"), (3, None, None, None)]
    assert [goal.name for goal in found.goals] == ["grasp", "1"]
    one = read_request({**OURS, "goal/image": image(1), "goal/rules": [{"share": 0.5}]}).goal
    assert rule(one.goals[0]) == (1, None, 0.5, None)
    assert read_request({**OURS, **keys}).goal.fingerprint == found.fingerprint


def test_the_same_bytes_are_the_same_goal_and_others_are_another() -> None:
    def fingerprint(**keys: object) -> str:
        return read_request({**OURS, **{key.replace("_", "/"): value for key, value in keys.items()}}).goal.fingerprint

    first = fingerprint(goal_image=image(1))
    assert fingerprint(goal_image=image(1).copy()) == first
    mask = np.ones((48, 60), dtype=np.uint8)
    others = [
        fingerprint(goal_image=image(2)),
        fingerprint(goal_image=image(1), goal_mask=mask),
        fingerprint(goal_images=GOALS),
        fingerprint(goal_images=GOALS, goal_rules=[{"at_most": 2}, {}]),
        fingerprint(goal_image=image(1).reshape(60, 48, 3)),
        fingerprint(goal_name="1"),
    ]
    assert len({first, *others}) == 7


def test_an_episode_begins_by_a_reset_or_is_told_by_its_name() -> None:
    assert read_request({**OURS, "reset": True}).begins
    only = read_request({"endpoint": "reset", "session_id": "b"})
    assert only.begins
    assert only.frame is None
    assert only.episode == "b"
    assert read_request({**OURS, "session_id": "c"}).episode == "c"


WRONG = {
    "request: an empty map": {},
    "needed: the picture of the camera, as observation/exterior_image_1_left or": {"observation/state": STATE},
    "needed: the measured state, as observation/state, or as observation/cartesian": {"observation/image": image(0)},
    "observation/image: an array of shape \\(48, 60\\)": {**OURS, "observation/image": image(0)[..., 0]},
    "type float32. needed: an RGB image": {**OURS, "observation/image": image(0).astype(np.float32)},
    "observation/image: 'x'": {**OURS, "observation/image": "x"},
    "observation/state: 'home'. needed: a row of numbers": {**OURS, "observation/state": "home"},
    "observation/state: an array of shape \\(1, 7\\)": {**OURS, "observation/state": STATE[None]},
    "observation/state: an array of shape \\(7,\\) and type bool": {**OURS, "observation/state": STATE > 0},
    "observation/state: \\[True": {**OURS, "observation/state": [True] * 7},
    "5 and 1 numbers": {
        "observation/image": image(0), "observation/cartesian_position": STATE[:5], "observation/gripper_position": 0.5,
    },
    "endpoint: 'kill'. needed: infer or reset or score": {**OURS, "endpoint": "kill"},
    "policy/chunks: None. needed: floats": {**OURS, "endpoint": "score"},
    "policy/chunks: an array of shape \\(4, 7\\)": {**OURS, "policy/chunks": np.zeros((4, 7))},
    "policy/chunks: an array of shape \\(0, 4, 7\\)": {**OURS, "policy/chunks": np.zeros((0, 4, 7))},
    "1025, 4, 7.* up to 1024 chunks": {**OURS, "policy/chunks": np.zeros((1025, 4, 7))},
    "1, 257, 7.* up to 256 control steps": {**OURS, "policy/chunks": np.zeros((1, 257, 7))},
    "policy/chunks: an array .* int64": {**OURS, "policy/chunks": np.zeros((1, 4, 7), dtype=np.int64)},
    "policy/form: 'joints'. needed: targets or deltas or offsets": {**OURS, "policy/form": "joints"},
    "endpoint: an array": {**OURS, "endpoint": np.zeros(3)},
    "reset: 1. needed: True or False": {**OURS, "reset": 1},
    "session_id: 3. needed: a text": {**OURS, "session_id": 3},
    "request: 'goal/imge'": {**OURS, "goal/imge": image(1)},
    "goal: goal/image, goal/name. needed: one of": {**OURS, "goal/image": image(1), "goal/name": "cup"},
    "goal: goal/mask. needed: one of": {**OURS, "goal/mask": np.ones((48, 60), dtype=bool)},
    "needed: goal/name alone": {**OURS, "goal/name": "cup", "goal/mask": np.ones((48, 60), dtype=bool)},
    "goal/name: 3. needed: a text": {**OURS, "goal/name": 3},
    "prompt: b'cup'": {**OURS, "prompt": b"cup"},
    "goal/images: an array of shape \\(48, 60, 3\\)": {**OURS, "goal/images": image(1)},
    "goal/images: \\[\\]. needed: 1 to 32 images": {**OURS, "goal/images": []},
    "goal/images\\[1\\]: 3": {**OURS, "goal/images": [image(1), 3]},
    "goal/rules: \\[{}\\]. needed: a map for each of 2 images: name, at_least": {**RULED, "goal/rules": [{}]},
    "goal/rules: 'x'": {**RULED, "goal/rules": "x"},
    "goal/rules: \\[1, 2\\]": {**RULED, "goal/rules": [1, 2]},
    "goal/rules: \\[{'name': b": {**RULED, "goal/rules": [{"name": b"x"}, {}]},
    "goal/rules: \\[{'at_most': array": {**RULED, "goal/rules": [{"at_most": np.ones(2)}, {}]},
    "goal/rules\\[0\\]: at_most: .*found 1.5": {**RULED, "goal/rules": [{"at_most": 1.5}, {}]},
    "goal/rules\\[0\\]: at_most: .*10000": {**RULED, "goal/rules": [{"at_most": 2**64 - 1}, {}]},
    "goal/rules\\[0\\]: most: unknown": {**RULED, "goal/rules": [{"most": 1}, {}]},
    "goal/rules\\[1\\]: gripper: .* 'up'": {**RULED, "goal/rules": [{}, {"gripper": "up"}]},
    "at least 0": {**RULED, "goal/rules": [{"at_least": 0}, {}]},
    "share nan": {**RULED, "goal/rules": [{"share": np.nan}, {}]},
    "share 1.0": {**RULED, "goal/rules": [{"share": 1.0}, {}]},
    "at least 3 and at most 2 steps": {**RULED, "goal/rules": [{"at_least": 3, "at_most": 2}, {}]},
    "request: 'goal/durations'": {**RULED, "goal/durations": [1]},
    "goal/mask: an array of shape \\(48, 60, 3\\)": {**OURS, "goal/image": image(1), "goal/mask": image(1)},
}  # fmt: skip


@pytest.mark.parametrize("error", WRONG)
def test_what_cannot_be_used_is_told_by_its_key(error: str) -> None:
    with pytest.raises(InputError, match=error) as caught:
        read_request(WRONG[error])
    assert len(str(caught.value)) < 600
