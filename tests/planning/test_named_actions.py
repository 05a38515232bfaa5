"""Named actions have the right direction and stay within the limits; action files are validated."""

from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.counterfactual import make_named_actions, read_actions
from vjepa2_ac.spaces import integrate_states

START = np.array([0.4, 0.1, 0.3, np.pi - 0.01, 0.02, -0.7, 0.4])
ROWS = np.array([[0.05, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0], [0.0, -0.02, 0.01, 0.0, 0.0, 0.0, -0.75]])


@pytest.mark.parametrize(
    ("name", "opposite_name"), [("up", "down"), ("left", "right"), ("forward", "back"), ("close", "open")]
)
def test_opposite_named_actions_sum_to_zero_and_move_along_one_axis(name: str, opposite_name: str) -> None:
    moves, opposite_moves = make_named_actions(name, 3), make_named_actions(opposite_name, 3)
    assert moves.any()
    assert not (moves + opposite_moves).any()
    last_states = [integrate_states(START, actions)[-1] for actions in (moves, opposite_moves)]
    axis = {"up": 2, "left": 1, "forward": 0, "close": 6}[name]
    assert last_states[0][axis] > START[axis] > last_states[1][axis]
    same = np.arange(7) != axis
    np.testing.assert_allclose(last_states[0][same], START[same], atol=1e-9)


def test_named_actions_have_the_requested_length_within_the_limits() -> None:
    taught = LimitsConfig(xyz=(0.03, 0.02, 0.0), gripper=0.5)
    assert make_named_actions("forward", 1)[0, 0] == 0.05
    assert make_named_actions("forward", 1, limits=taught)[0, 0] == 0.03
    assert make_named_actions("right", 1, limits=taught, size_m=0.01)[0, 1] == -0.01
    assert make_named_actions("open", 1, limits=taught)[0, 6] == -0.5
    with pytest.raises(InputError, match=r"planning\.limits\.xyz: 0, so that no action can move up"):
        make_named_actions("up", 1, limits=taught)
    with pytest.raises(InputError, match=r"planning\.limits\.gripper: 0"):
        make_named_actions("close", 1, limits=LimitsConfig(gripper=0.0))
    for name in ("close", "open"):
        with pytest.raises(
            InputError, match=rf"planning\.limits\.gripper_mode: held, so that no action can move {name}"
        ):
            make_named_actions(name, 1, limits=LimitsConfig(gripper_mode="held"))
    for size in (0.0, -0.01, float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"--size: .* cm per step"):
            make_named_actions("up", 1, size_m=size)
    with pytest.raises(InputError, match=r"true \(the actions of a recorded clip\), none, up, down"):
        make_named_actions("sideways", 1)
    with pytest.raises(ValueError, match="0 steps"):
        make_named_actions("up", 0)


def test_actions_are_read_from_arrays_and_tables(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS.astype(np.float32))
    lines = "\n".join(",".join(map(str, row)) for row in ROWS)
    (tmp_path / "a.csv").write_text(lines + "\n\n")
    (tmp_path / "named.csv").write_text("dx, dy, dz, droll, dpitch, dyaw, dgripper\n" + lines)
    for name in ("a.npy", "a.csv", "named.csv"):
        np.testing.assert_allclose(read_actions(tmp_path / name), ROWS, atol=1e-8)
    np.testing.assert_array_equal(read_actions(tmp_path / "a.csv", steps=1), ROWS[:1])
    with pytest.raises(InputError, match=r"a\.csv: 2 actions\. Expected 3"):
        read_actions(tmp_path / "a.csv", steps=3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "0,0,0,0,0,0\n", r"shape \(1, 6\)"),
        ("a.csv", "0,0,0,0,0,0,0\n\n0,0,up,0,0,0,0\n", "'up'"),
        ("a.csv", "0,0,0,0,0,0,nan\n", "action 0 is"),
        ("a.csv", "0,0,0,0,0,0,0\n50,0,0,0,0,0,0\n", "action 1 is .*metres"),
        ("a.csv", b"\xff\xfe\x00", "cannot be read"),
        ("a.npy", b"PK\x03\x04", "cannot be read"),
        ("a.npy", np.zeros((3, 6)), r"shape \(3, 6\)"),
        ("a.npy", np.array([[None] * 7]), "cannot be read"),
    ],
)
def test_invalid_action_files_raise(tmp_path: Path, name: str, content: str | bytes | np.ndarray, message: str) -> None:
    path = tmp_path / name
    if isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError, match=message):
        read_actions(path)
