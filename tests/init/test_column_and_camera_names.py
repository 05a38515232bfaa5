"""Pose, gripper and camera are recognised by names, or guessed by column widths; joints are not a pose."""

import pytest

from vjepa2_ac.init.dataset_properties import make_camera_names, make_camera_values, pick_camera
from vjepa2_ac.init.poses import Column, find_pose

JOINTS = Column(
    7, ("shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos", "wrist_flex.pos", "a.pos", "b.pos", "g.pos")
)


def test_droid_columns_are_recognised_without_a_guess() -> None:
    columns = {
        "action.cartesian_position": Column(6),
        "observation.state.joint_position": Column(7),
        "observation.state.cartesian_position": Column(6),
        "observation.state.gripper_position": Column(1),
    }
    pose = find_pose(columns)
    assert pose is not None
    assert pose["state"].value == ["observation.state.cartesian_position", "observation.state.gripper_position"]
    assert (pose["rotation"].value, pose["state"].is_guess, "select" in pose) == ("euler_xyz", False, False)


@pytest.mark.parametrize(
    ("columns", "rotation", "num_columns"),
    [
        ({"observation.ee_pose": 6, "observation.gripper": 1}, "euler_xyz", 2),
        ({"observation.tcp_pose": 7, "observation.gripper_width": 1}, "quaternion_xyzw", 2),
        ({"observation.state": 7}, "euler_xyz", 1),
        ({"observation.state": 8}, "quaternion_xyzw", 1),
    ],
)
def test_pose_recognised_by_width_is_a_guess(columns: dict[str, int], rotation: str, num_columns: int) -> None:
    pose = find_pose({name: Column(width) for name, width in columns.items()})
    assert pose is not None
    state = pose["state"]
    assert (pose["rotation"].value, len(state.value), state.is_guess) == (rotation, num_columns, True)
    assert "states: vector" in state.reason


@pytest.mark.parametrize(
    "columns",
    [
        {},
        {"observation.state": JOINTS},
        {"observation.state": Column(14)},
        {"observation.joint_position": Column(7), "observation.gripper_position": Column(1)},
        {"action": Column(7, ("x", "y", "z", "roll", "pitch", "yaw", "gripper"))},
    ],
)
def test_joints_and_commands_are_not_recognised_as_a_pose(columns: dict[str, Column]) -> None:
    assert find_pose(columns) is None


@pytest.mark.parametrize(
    ("cameras", "chosen"),
    [
        (["wrist", "front"], "front"),
        (["observation.images.wrist_left", "observation.images.exterior_2_left"], "observation.images.exterior_2_left"),
        (["cam_a", "cam_b"], "cam_a"),
        (["hand"], "hand"),
        (["image_3", "image_0"], "image_0"),
    ],
)
def test_exterior_camera_is_preferred(cameras: list[str], chosen: str) -> None:
    assert pick_camera(cameras) == chosen


@pytest.mark.parametrize(
    ("features", "names"),
    [
        (["observation.images.front left"], ["front_left"]),
        (["steps/observation/image_0", "steps/observation/image_1"], ["image_0", "image_1"]),
        (["steps/observation/front/rgb", "steps/observation/wrist/rgb"], ["front_rgb", "wrist_rgb"]),
        (["a.b.rgb", "a-b.rgb"], ["a_b_rgb", "a-b.rgb"]),
    ],
)
def test_camera_names_are_short_and_distinct(features: list[str], names: list[str]) -> None:
    camera_names = make_camera_names(features)
    assert list(camera_names) == features
    assert len(set(camera_names.values())) == len(features)
    if "-" not in features[-1]:
        assert list(camera_names.values()) == names


@pytest.mark.parametrize(
    ("feature", "comment"),
    [
        ("observation.images.front", ""),
        ("observation.images.wrist_left", "a camera on the hand; "),
        ("observation.images.cam1", "the name does not show the view; "),
    ],
)
def test_only_camera_that_is_not_an_exterior_camera_has_a_comment(feature: str, comment: str) -> None:
    camera, _ = make_camera_values([feature], [], "info.json")
    assert camera.reason.startswith(comment)
    assert bool(camera.reason) == bool(comment)
