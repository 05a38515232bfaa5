"""Requests: all formats of openpi's clients are parsed to one record; errors name the key."""

import numpy as np
import pytest

from served import STATE, image
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.request import read_request

MESSAGE = {"observation/image": image(0), "observation/state": STATE}
GOALS = np.stack([image(1), image(2)])
MESSAGE_WITH_GOALS = {**MESSAGE, "goal/images": GOALS}


def test_droid_roboarena_and_generic_messages_are_parsed_equally() -> None:
    pose = {"observation/cartesian_position": STATE[:6], "observation/gripper_position": STATE[6:]}
    ignored_keys = {
        "observation/joint_position": np.zeros(7),
        "observation/wrist_image_left": image(9),
        "client": "theirs",
    }
    for message in (
        MESSAGE,
        {"observation/exterior_image_1_left": image(0), **pose, **ignored_keys},
        {"observation/exterior_image_0_left": image(0), **pose, **ignored_keys, "endpoint": "infer", "session_id": "a"},
        {"observation/image": image(0), "observation/state": STATE.tolist()},
        {"observation/image": image(0), **pose, "observation/gripper_position": float(STATE[6])},
    ):
        parsed = read_request(message)
        np.testing.assert_array_equal(parsed.frame, image(0))
        np.testing.assert_array_equal(parsed.state, STATE)
        assert parsed.state.dtype == np.float64
        assert not parsed.is_new_episode
        assert parsed.goal is None


def test_image_key_can_be_configured() -> None:
    message = {"camera": image(3), **MESSAGE}
    np.testing.assert_array_equal(read_request(message, ["camera"]).frame, image(3))
    with pytest.raises(InputError, match="the camera image under the key top"):
        read_request(MESSAGE, ["top"])


def test_goal_is_one_image_several_images_a_name_or_a_prompt() -> None:
    single = read_request({**MESSAGE, "goal/image": image(1), "goal/mask": np.ones((48, 60), dtype=bool)}).goal
    assert ([rule(goal) for goal in single.goals], single.mask.shape) == ([(1, None, None, None)], (48, 60))
    for images in (GOALS, list(GOALS)):
        sequence = read_request({**MESSAGE, "goal/images": images, "goal/rules": [{"at_most": 4}, {}]}).goal
        assert [rule(goal) for goal in sequence.goals] == [(1, 4, None, None), (1, None, None, None)]
    assert read_request({**MESSAGE, "goal/name": "cup"}).goal.name == "cup"
    assert read_request({**MESSAGE, "prompt": "cup"}).goal.name == "cup"
    assert read_request({**MESSAGE, "goal/image": image(1), "prompt": "put it there"}).goal.goals


def rule(goal: SubGoal) -> tuple:
    return goal.at_least, goal.at_most, goal.share, goal.gripper


def test_each_goal_of_a_sequence_has_its_own_rule() -> None:
    rules = [{"name": "grasp", "at_least": 2, "at_most": 9, "share": 0.25, "gripper": "held"}, {"at_least": 3}]
    keys = {"goal/images": GOALS, "goal/rules": rules}
    parsed = read_request({**MESSAGE, **keys}).goal
    assert [rule(goal) for goal in parsed.goals] == [(2, 9, 0.25, "held"), (3, None, None, None)]
    assert [goal.name for goal in parsed.goals] == ["grasp", "1"]
    single = read_request({**MESSAGE, "goal/image": image(1), "goal/rules": [{"share": 0.5}]}).goal
    assert rule(single.goals[0]) == (1, None, 0.5, None)
    assert read_request({**MESSAGE, **keys}).goal.fingerprint == parsed.fingerprint


def test_goal_fingerprint_is_equal_only_for_equal_goals() -> None:
    def fingerprint(**keys: object) -> str:
        return read_request(
            {**MESSAGE, **{key.replace("_", "/"): value for key, value in keys.items()}}
        ).goal.fingerprint

    first = fingerprint(goal_image=image(1))
    assert fingerprint(goal_image=image(1).copy()) == first
    mask = np.ones((48, 60), dtype=np.uint8)
    other_fingerprints = [
        fingerprint(goal_image=image(2)),
        fingerprint(goal_image=image(1), goal_mask=mask),
        fingerprint(goal_images=GOALS),
        fingerprint(goal_images=GOALS, goal_rules=[{"at_most": 2}, {}]),
        fingerprint(goal_image=image(1).reshape(60, 48, 3)),
        fingerprint(goal_name="1"),
    ]
    assert len({first, *other_fingerprints}) == 7


def test_reset_or_new_session_id_starts_an_episode() -> None:
    assert read_request({**MESSAGE, "reset": True}).is_new_episode
    reset = read_request({"endpoint": "reset", "session_id": "b"})
    assert reset.is_new_episode
    assert reset.frame is None
    assert reset.episode == "b"
    assert read_request({**MESSAGE, "session_id": "c"}).episode == "c"


INVALID_MESSAGES = {
    "request: an empty map": {},
    "the camera image under the key observation/exterior_image_1_left or": {"observation/state": STATE},
    "the measured state under the key observation/state, or under observation/cart": {"observation/image": image(0)},
    "observation/image: an array of shape \\(48, 60\\)": {**MESSAGE, "observation/image": image(0)[..., 0]},
    "type float32.*an RGB image": {**MESSAGE, "observation/image": image(0).astype(np.float32)},
    "observation/image: 'x'": {**MESSAGE, "observation/image": "x"},
    "observation/state: 'home'.*a one-dimensional array of numbers": {**MESSAGE, "observation/state": "home"},
    "observation/state: an array of shape \\(1, 7\\)": {**MESSAGE, "observation/state": STATE[None]},
    "observation/state: an array of shape \\(7,\\) and type bool": {**MESSAGE, "observation/state": STATE > 0},
    "observation/state: \\[True": {**MESSAGE, "observation/state": [True] * 7},
    "5 and 1 numbers": {
        "observation/image": image(0), "observation/cartesian_position": STATE[:5], "observation/gripper_position": 0.5,
    },
    "endpoint: 'kill'.*infer or reset or score": {**MESSAGE, "endpoint": "kill"},
    "policy/chunks: None.*a float array": {**MESSAGE, "endpoint": "score"},
    "policy/chunks: an array of shape \\(4, 7\\)": {**MESSAGE, "policy/chunks": np.zeros((4, 7))},
    "policy/chunks: an array of shape \\(0, 4, 7\\)": {**MESSAGE, "policy/chunks": np.zeros((0, 4, 7))},
    "1025, 4, 7.*chunks up to 1024": {**MESSAGE, "policy/chunks": np.zeros((1025, 4, 7))},
    "1, 257, 7.*control steps up to 256": {**MESSAGE, "policy/chunks": np.zeros((1, 257, 7))},
    "policy/chunks: an array .* int64": {**MESSAGE, "policy/chunks": np.zeros((1, 4, 7), dtype=np.int64)},
    "policy/form: 'joints'.*targets or deltas or offsets": {**MESSAGE, "policy/form": "joints"},
    "endpoint: an array": {**MESSAGE, "endpoint": np.zeros(3)},
    "reset: 1.*True or False": {**MESSAGE, "reset": 1},
    "session_id: 3.*a string": {**MESSAGE, "session_id": 3},
    "request: 'goal/imge'": {**MESSAGE, "goal/imge": image(1)},
    "goal: goal/image, goal/name.*exactly one of": {**MESSAGE, "goal/image": image(1), "goal/name": "cup"},
    "goal: goal/mask.*exactly one of": {**MESSAGE, "goal/mask": np.ones((48, 60), dtype=bool)},
    "only goal/name": {**MESSAGE, "goal/name": "cup", "goal/mask": np.ones((48, 60), dtype=bool)},
    "goal/name: 3.*a string": {**MESSAGE, "goal/name": 3},
    "prompt: b'cup'": {**MESSAGE, "prompt": b"cup"},
    "goal/images: an array of shape \\(48, 60, 3\\)": {**MESSAGE, "goal/images": image(1)},
    "goal/images: \\[\\].*1 to 32 images": {**MESSAGE, "goal/images": []},
    "goal/images\\[1\\]: 3": {**MESSAGE, "goal/images": [image(1), 3]},
    "goal/rules: \\[{}\\].*a map with the keys name.*for each of 2 images": {**MESSAGE_WITH_GOALS, "goal/rules": [{}]},
    "goal/rules: 'x'": {**MESSAGE_WITH_GOALS, "goal/rules": "x"},
    "goal/rules: \\[1, 2\\]": {**MESSAGE_WITH_GOALS, "goal/rules": [1, 2]},
    "goal/rules: \\[{'name': b": {**MESSAGE_WITH_GOALS, "goal/rules": [{"name": b"x"}, {}]},
    "goal/rules: \\[{'at_most': array": {**MESSAGE_WITH_GOALS, "goal/rules": [{"at_most": np.ones(2)}, {}]},
    "goal/rules\\[0\\]: at_most: .*found 1.5": {**MESSAGE_WITH_GOALS, "goal/rules": [{"at_most": 1.5}, {}]},
    "goal/rules\\[0\\]: at_most: .*10000": {**MESSAGE_WITH_GOALS, "goal/rules": [{"at_most": 2**64 - 1}, {}]},
    "goal/rules\\[0\\]: most: unknown": {**MESSAGE_WITH_GOALS, "goal/rules": [{"most": 1}, {}]},
    "goal/rules\\[1\\]: gripper: .* 'up'": {**MESSAGE_WITH_GOALS, "goal/rules": [{}, {"gripper": "up"}]},
    "at least 0": {**MESSAGE_WITH_GOALS, "goal/rules": [{"at_least": 0}, {}]},
    "share nan": {**MESSAGE_WITH_GOALS, "goal/rules": [{"share": np.nan}, {}]},
    "share 1.0": {**MESSAGE_WITH_GOALS, "goal/rules": [{"share": 1.0}, {}]},
    "at least 3 and at most 2 steps": {**MESSAGE_WITH_GOALS, "goal/rules": [{"at_least": 3, "at_most": 2}, {}]},
    "request: 'goal/durations'": {**MESSAGE_WITH_GOALS, "goal/durations": [1]},
    "goal/mask: an array of shape \\(48, 60, 3\\)": {**MESSAGE, "goal/image": image(1), "goal/mask": image(1)},
}  # fmt: skip


@pytest.mark.parametrize("error", INVALID_MESSAGES)
def test_invalid_message_raises_and_names_the_key(error: str) -> None:
    with pytest.raises(InputError, match=error) as caught:
        read_request(INVALID_MESSAGES[error])
    assert len(str(caught.value)) < 600
