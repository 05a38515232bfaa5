"""States of other robots: `init` selects the pose and its format, or makes a guess that lists unused numbers."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from synthetic import synthetic_states
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.poses import convert_poses
from vjepa2_ac.init.draft_values import DraftValue, list_guesses, plain_values
from vjepa2_ac.init.poses import Column, find_pose, guess_gripper_values

STATE = "observation.state"
EPISODES = [synthetic_states(80, seed=seed) for seed in range(8)]

Numbers = Float[np.ndarray, "steps _"]


def convert_states(states: Numbers, rotation: str) -> Numbers:
    """Return states with the rotation in another format."""
    turned = Rotation.from_euler("xyz", states[:, 3:6])
    numbers = {
        "euler_xyz": states[:, 3:6],
        "euler_xyz_degrees": np.rad2deg(states[:, 3:6]),
        "rotation_vector": turned.as_rotvec(),
        "quaternion_xyzw": turned.as_quat(),
        "quaternion_wxyz": turned.as_quat(scalar_first=True),
    }[rotation]
    return np.concatenate([states[:, :3], numbers, states[:, 6:]], axis=1)


def propose_pose(names: str, numbers: list[Numbers] | None) -> dict[str, DraftValue]:
    columns = {STATE: Column(len(names.split()), tuple(names.split()))}
    pose = find_pose(columns, None if numbers is None else {STATE: numbers})
    assert pose is not None
    return pose


def max_rotation_error_deg(pose: dict[str, DraftValue], numbers: Numbers, states: Numbers) -> float:
    """Return the largest angle between the true rotations and those that are read with a proposed pose, in degrees."""
    values = {"run_dir": "none", "data": {"source": "lerobot", "path": "none", "lerobot": plain_values(pose)}}
    config = parse_config({**values, "model": {"base": "builtin:sim-tiny"}}, where="init").data
    assert isinstance(config, LeRobotData)
    fields = config.lerobot
    selected = numbers if fields.select is None else numbers[:, list(fields.select)]
    read = convert_poses(selected, fields, "episode", section="data.lerobot")
    assert np.allclose(read[:, :3], states[:, :3])
    errors = Rotation.from_euler("xyz", read[:, 3:6]) * Rotation.from_euler("xyz", states[:, 3:6]).inv()
    return float(np.rad2deg(errors.magnitude()).max())


@pytest.mark.parametrize(
    ("names", "rotation", "is_guess"),
    [
        ("x y z roll pitch yaw gripper", "euler_xyz", False),
        ("x y z euler_x euler_y euler_z gripper", "euler_xyz", False),
        ("x y z roll_deg pitch_deg yaw_deg gripper", "euler_xyz_degrees", False),
        ("x y z rx ry rz rw gripper", "quaternion_xyzw", False),
        ("x y z qx qy qz qw gripper", "quaternion_xyzw", False),
        ("x y z qw qx qy qz gripper", "quaternion_wxyz", False),
        ("ee.pos.x ee.pos.y ee.pos.z ee.rot.w ee.rot.x ee.rot.y ee.rot.z gripper.pos", "quaternion_wxyz", False),
        ("eef_x eef_y eef_z eef_quat_x eef_quat_y eef_quat_z eef_quat_w gripper_width", "quaternion_xyzw", False),
        ("x y z orientation_x orientation_y orientation_z orientation_w gripper", "quaternion_xyzw", False),
        ("x y z quat_0 quat_1 quat_2 quat_3 gripper", "quaternion_xyzw", True),
        ("ee.x ee.y ee.z ee.wx ee.wy ee.wz ee.gripper_pos", "rotation_vector", False),
        ("x y z axis_angle1 axis_angle2 axis_angle3 gripper", "rotation_vector", False),
        ("x y z rotvec_x rotvec_y rotvec_z gripper", "rotation_vector", False),
        ("pos_0 pos_1 pos_2 axis_angle_0 axis_angle_1 axis_angle_2 gripper", "rotation_vector", False),
        ("tcp.x tcp.y tcp.z tcp.rx tcp.ry tcp.rz gripper.pos", "rotation_vector", True),
        ("tcp.x tcp.y tcp.z tcp.rx tcp.ry tcp.rz gripper.pos", "euler_xyz", True),
        ("x y z rot_x rot_y rot_z gripper", "rotation_vector", True),
    ],
)
def test_rotation_format_is_recognised(names: str, rotation: str, is_guess: bool) -> None:
    numbers = [convert_states(states, rotation) for states in EPISODES]
    pose = propose_pose(names, numbers)
    assert max_rotation_error_deg(pose, numbers[0], EPISODES[0]) < 0.1
    assert pose["rotation"].is_guess == is_guess
    assert not pose["state"].is_guess


@pytest.mark.parametrize(
    ("names", "rotation"),
    [("x y z roll pitch yaw gripper", "rotation_vector"), ("x y z wx wy wz gripper", "euler_xyz")],
)
def test_values_override_contradicting_column_names_as_a_guess(names: str, rotation: str) -> None:
    numbers = [convert_states(states, rotation) for states in EPISODES]
    pose = propose_pose(names, numbers)
    assert (pose["rotation"].value, pose["rotation"].is_guess) == (rotation, True)
    assert "which the names suggest" in pose["rotation"].reason


def test_rotation_vector_with_quaternion_names_and_two_fingers_is_a_guess() -> None:
    fingers = [np.stack([0.04 * (1 - states[:, 6]), -0.04 * (1 - states[:, 6])], axis=1) for states in EPISODES]
    poses = [convert_states(states, "rotation_vector")[:, :6] for states in EPISODES]
    numbers = [np.concatenate([pose, finger_pair], axis=1) for pose, finger_pair in zip(poses, fingers, strict=True)]
    pose = propose_pose("x y z rx ry rz rw gripper", numbers)
    assert (pose["rotation"].value, pose["select"].value) == ("rotation_vector", [0, 1, 2, 3, 4, 5, 6])
    assert pose["state"].is_guess
    values = plain_values({"gripper": guess_gripper_values("gripper", (0.0, 0.04))})["gripper"]
    assert values == {"gripper_open": 0.04, "gripper_closed": 0.0}


def test_named_pose_with_gripper_column_is_not_a_guess() -> None:
    columns = {STATE: Column(6, tuple(ONE_ARM)), "observation.gripper_open": Column(1)}
    pose = find_pose(columns)
    assert pose is not None
    assert pose["state"].value == list(columns)
    assert not pose["state"].is_guess


def test_degrees_and_millimetres_are_recognised_by_magnitude() -> None:
    numbers = [convert_states(states, "euler_xyz_degrees") * [1000, 1000, 1000, 1, 1, 1, 1] for states in EPISODES]
    pose = propose_pose("x y z roll pitch yaw gripper", numbers)
    assert (pose["rotation"].value, pose["position_unit"].value) == ("euler_xyz_degrees", "mm")
    assert "position_unit" in list_guesses(pose)
    assert "too large for radians" in pose["rotation"].reason
    assert max_rotation_error_deg(pose, numbers[0], EPISODES[0]) < 0.1


def test_guess_without_sampled_values_states_that_values_were_not_read() -> None:
    rotation = propose_pose("x y z rot_x rot_y rot_z gripper", None)["rotation"]
    assert rotation.is_guess
    assert "rotation_vector" in rotation.reason
    assert "not read" in rotation.reason


ONE_ARM = ["x", "y", "z", "roll", "pitch", "yaw"]


@pytest.mark.parametrize(
    ("names", "chosen", "left_out"),
    [
        ([f"{side}_{name}" for side in ("left", "right") for name in (*ONE_ARM, "gripper")], "left", "right_x"),
        (
            [f"{side}_{name}" for side in ("left", "right") for name in ONE_ARM] + ["right_gripper", "left_gripper"],
            "left",
            "right_x",
        ),
        ([f"arm{arm}.{name}" for arm in (0, 1) for name in (*ONE_ARM, "gripper")], "arm0", "arm1.x"),
        ([f"robot{arm}_{name}" for name in (*ONE_ARM, "gripper") for arm in (0, 1)], "robot0", "robot1_x"),
        (["target.x", "target.y", "target.z", *ONE_ARM, "gripper"], "", "target.x"),
        (["base_x", "base_y", "base_z", *(f"ee_{name}" for name in ONE_ARM), "gripper"], "ee", "base_x"),
        ([*ONE_ARM, "gripper", *ONE_ARM, "gripper"], "", "x"),
    ],
)
def test_first_of_two_arms_is_guessed_and_unused_numbers_are_listed(
    names: list[str], chosen: str, left_out: str
) -> None:
    pose = propose_pose(" ".join(names), None)
    selected_names = [names[index] for index in pose["select"].value]
    parts = [name.removeprefix(chosen).strip("._") for name in selected_names]
    assert parts == [*ONE_ARM, "gripper"], selected_names
    assert pose["state"].is_guess
    assert left_out in pose["state"].reason.split("Unused:")[1]
    assert "states: vector" in pose["state"].reason


def test_columns_of_two_arms_are_not_mixed() -> None:
    columns = {
        "observation.left_ee_pose": 6, "observation.right_ee_pose": 6,
        "observation.right_gripper": 1, "observation.left_gripper": 1,
    }  # fmt: skip
    pose = find_pose({name: Column(width) for name, width in columns.items()})
    assert pose is not None
    assert pose["state"].value == ["observation.left_ee_pose", "observation.left_gripper"]
    assert "observation.right_ee_pose" in pose["state"].reason


@pytest.mark.parametrize("rotation", ["quaternion_xyzw", "rotation_vector"])
def test_eight_unnamed_numbers_are_split_by_quaternion_norm(rotation: str) -> None:
    numbers = [convert_states(states, rotation) for states in EPISODES]
    numbers = [states if states.shape[1] == 8 else np.concatenate([states, -states[:, 6:]], 1) for states in numbers]
    pose = find_pose({STATE: Column(8)}, {STATE: numbers})
    assert pose is not None
    assert (pose["rotation"].value, pose["state"].is_guess) == (rotation, True)
    assert plain_values(pose).get("select") == (None if rotation.startswith("quaternion") else [0, 1, 2, 3, 4, 5, 6])


@pytest.mark.parametrize(
    ("name", "ranges", "expected", "is_guess"),
    [
        ("gripper", (0.0, 1.0), (0.0, 1.0), True),
        ("gripper_closed", (0.0, 1.0), (0.0, 1.0), False),
        ("gripper_open", (0.0, 1.0), (1.0, 0.0), False),
        ("gripper_width", (0.0, 0.08), (0.08, 0.0), True),
        ("finger", (-0.04, 0.0), (-0.04, 0.0), True),
        ("gripper", (-1.0, 1.0), (-1.0, 1.0), True),
        ("gripper", (0.0, 85.0), (85.0, 0.0), True),
        ("gripper", None, (0.0, 1.0), True),
        ("gripper_closed", (0.0, 255.0), (0.0, 255.0), True),
        ("gripper_open", (-1.0, 1.0), (1.0, -1.0), True),
        ("gripper_closed", (0.0, 0.1), (0.0, 0.1), True),
    ],
)
def test_gripper_values_follow_from_range_and_name(
    name: str, ranges: tuple[float, float] | None, expected: tuple[float, float], is_guess: bool
) -> None:
    values = guess_gripper_values(name, ranges)
    assert tuple(plain_values(values).values()) == expected
    assert bool(list_guesses(values)) == is_guess


def select_names(names: str) -> list[str]:
    """Return the names of the numbers that are selected as the pose; empty: no pose is recognised."""
    all_names = tuple(names.split())
    pose = find_pose({STATE: Column(len(all_names), all_names)})
    if pose is None:
        return []
    return [all_names[index] for index in (pose["select"].value if "select" in pose else range(len(all_names)))]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("x y z qx qy qz qw vx vy vz wx wy wz gripper", "x y z qx qy qz qw gripper"),
        ("x y z rx ry rz vx vy vz wx wy wz gripper", "x y z rx ry rz gripper"),
        ("x y z wx wy wz vx vy vz gripper", ""),  # an angular velocity is not a rotation
        ("x y z wx wy wz roll pitch yaw gripper", "x y z roll pitch yaw gripper"),
        ("theta_1 theta_2 theta_3 x y z rx ry rz gripper", "x y z rx ry rz gripper"),
        ("angle1 angle2 angle3 x y z gripper", ""),
        ("x y z r1 r2 r3 r4 r5 r6 gripper", ""),  # six numbers of a rotation matrix
        ("fx fy fz tx ty tz x y z roll pitch yaw gripper", "x y z roll pitch yaw gripper"),
        ("x y yaw ee_x ee_y ee_z ee_roll ee_pitch ee_yaw gripper", "ee_x ee_y ee_z ee_roll ee_pitch ee_yaw gripper"),
        ("x.pos y.pos z.pos roll.pos pitch.pos yaw.pos gripper.pos",) * 2,
        ("j_0 j_1 cube_x cube_y cube_z cube_roll cube_pitch cube_yaw gripper", ""),
        ("gripper_vel x y z roll pitch yaw gripper", "x y z roll pitch yaw gripper"),
        ("gripper x y z roll pitch yaw", "x y z roll pitch yaw gripper"),
        ("j0 j1 x y z qx qy qz qw finger_joint", "x y z qx qy qz qw finger_joint"),
    ],
)
def test_other_quantities_are_not_recognised_as_the_pose(names: str, expected: str) -> None:
    assert select_names(names) == expected.split()


@pytest.mark.parametrize(
    ("columns", "chosen", "is_guess"),
    [
        (["observation.left.cartesian_position", "observation.right.cartesian_position"], 0, True),
        (["observation.target.cartesian_position", "observation.robot_state.cartesian_position"], 1, True),
        (["observation.target_tcp_pose", "observation.current_tcp_pose"], 1, True),
        (["observation.demo_start_pose", "observation.ee_pose"], 1, True),
        (["observation.leader_ee_pose", "observation.follower_ee_pose"], 1, True),
        (["observation.object_pose", "observation.ee_pose"], 1, True),
        (["observation.prev_tcp_pose"], 0, True),
        (["observation.ee_pose_in_camera", "observation.ee_pose_in_base"], 1, True),
    ],
)
def test_measured_end_effector_pose_is_preferred(columns: list[str], chosen: int, is_guess: bool) -> None:
    pose = find_pose({**{name: Column(6) for name in columns}, "observation.gripper_position": Column(1)})
    assert pose is not None
    assert (pose["state"].value[0], pose["state"].is_guess) == (columns[chosen], is_guess)


@pytest.mark.parametrize("name", ["object_pose", "camera_pose", "head_pose", "cube_pose"])
def test_pose_of_an_object_is_not_recognised_as_the_robots(name: str) -> None:
    assert find_pose({f"observation.{name}": Column(6), "observation.gripper": Column(1)}) is None


def test_robosuite_columns_are_recognised() -> None:
    samples = {
        "observation.robot0_eef_pos": [states[:, :3] for states in EPISODES],
        "observation.robot0_eef_quat": [convert_states(states, "quaternion_xyzw")[:, 3:7] for states in EPISODES],
        "observation.robot0_gripper_qpos": [np.stack([0.04 * (1 - states[:, 6])] * 2, axis=1) for states in EPISODES],
        "observation.robot0_joint_pos": list(EPISODES),
        "observation.robot0_gripper_qvel": [states[:, :2] for states in EPISODES],
    }
    pose = find_pose({name: Column(episodes[0].shape[1]) for name, episodes in samples.items()}, samples)
    assert pose is not None
    assert pose["state"].value == list(samples)[:3]
    assert pose["select"].value == [0, 1, 2, 3, 4, 5, 6, 7]
    assert pose["gripper_closed"].value == 0.0
