"""The example clients move stubs of robots, which have the signatures of the real libraries."""
# ruff: noqa: ARG002 - the stubs keep the parameters of the real libraries

import contextlib
import runpy
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from paths import ROOT
from served import image, make_controller
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.session import Session, SessionOptions
from vjepa2_ac.serving.wire import pack, unpack

BOX = ((0.3, -0.2, 0.1), (0.6, 0.2, 0.5))
HAND = np.block(
    [[Rotation.from_euler("z", -45, degrees=True).as_matrix(), np.array([[0], [0], [0.1034]])], [0, 0, 0, 1]]
)


class Policy:
    """A replacement of openpi's WebsocketClientPolicy without a socket, which stores the replies."""

    def __init__(self, **options: Any) -> None:
        limits = LimitsConfig(workspace=BOX, xyz=(0.03, 0.03, 0.03), rotation=0.1, gripper_mode="free")
        self.session = Session(
            make_controller(limits=limits), {"cup": (SubGoal(image(50), "cup"),)}, SessionOptions("pose", **options)
        )
        self.replies: list[dict] = []
        self.max_replies = 100  # number of replies before the connection is lost

    def infer(self, obs: dict) -> dict:
        if len(self.replies) == self.max_replies:
            raise ConnectionError
        reply = self.session.reply_to(pack(obs))
        if isinstance(reply, str):
            raise RuntimeError(f"Error in inference server:\n{reply}")  # noqa: TRY004 - as in openpi
        self.replies.append(unpack(reply))
        return self.replies[-1]


class Gripper:
    """Stub of the grippers of franky and libfranka: `width`, `max_width`, `move`, `grasp`, `read_once`."""

    max_width = 0.08

    def __init__(self) -> None:
        self.width, self.calls = 0.06, []

    def read_once(self) -> "Gripper":
        return self

    def move(self, width: float, speed: float) -> bool:
        self.calls.append("move")
        self.width = width
        return True

    def grasp(
        self, width: float, speed: float, force: float, epsilon_inner: float = 0.005, epsilon_outer: float = 0.005
    ) -> bool:
        assert epsilon_outer == 1.0, "objects of any width may be grasped"
        self.calls.append("grasp")
        self.width = 0.03
        return True


class Affine:
    """Stub of franky's Affine, from a matrix, or from a translation and a quaternion (x, y, z, w)."""

    def __init__(self, first: Any, quaternion: Any = None) -> None:
        self.matrix = np.asarray(first, dtype=float)
        if quaternion is not None:
            self.matrix = np.eye(4)
            self.matrix[:3, :3], self.matrix[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), first

    def __mul__(self, other: "Affine") -> "Affine":
        return Affine(self.matrix @ other.matrix)

    @property
    def inverse(self) -> "Affine":
        return Affine(np.linalg.inv(self.matrix))

    @property
    def translation(self) -> np.ndarray:
        return self.matrix[:3, 3]

    @property
    def quaternion(self) -> np.ndarray:
        return Rotation.from_matrix(self.matrix[:3, :3]).as_quat()


class Franka:
    """Stub of franky's `Robot`, which reaches every target."""

    def __init__(self) -> None:
        self.flange, self.positions = np.eye(4), []
        self.flange[:3, :3] = Rotation.from_euler("xyz", [3.1, 0, 0.1]).as_matrix()
        self.flange[:3, 3] = 0.45, 0.0, 0.3

    def _go(self, tool: np.ndarray) -> None:
        self.flange = tool @ np.linalg.inv(HAND)
        self.positions.append(self.flange[:3, 3].copy())

    @property
    def state(self) -> Any:
        return types.SimpleNamespace(F_T_EE=Affine(HAND), O_T_EE=Affine(self.flange @ HAND))

    def move(self, motion: Any, asynchronous: bool = False) -> None:
        self._go(motion.target.matrix)


class CartesianMotion:
    def __init__(self, target: Affine) -> None:
        self.target = target


class RobotEnv:
    """Stub of the parts of DROID's `RobotEnv` that the client uses."""

    def __init__(self) -> None:
        self.state, self.positions = np.array([0.45, 0.0, 0.3, 3.1, 0.0, 0.1, 0.25]), []

    def get_observation(self) -> dict[str, Any]:
        bgra = np.concatenate([camera()[..., ::-1], np.full((48, 60, 1), 255, dtype=np.uint8)], axis=-1)
        pose = {"cartesian_position": self.state[:6].tolist(), "gripper_position": float(self.state[6])}
        return {"robot_state": pose, "image": {"left": bgra}}

    def update_robot(
        self,
        action: np.ndarray,
        action_space: str = "cartesian_velocity",
        gripper_action_space: str | None = None,
        blocking: bool = False,
    ) -> None:
        assert (action_space, gripper_action_space, blocking) == ("cartesian_position", "position", True)
        self.state = np.asarray(action)
        self.positions.append(self.state[:3])


def camera() -> np.ndarray:
    return image(3)


Drive = Callable[..., tuple[list[np.ndarray], Gripper | None]]


@pytest.fixture(params=["franky", "droid"])
def drive(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Drive:
    """Return a function that drives a stub for four steps and returns the flange positions and the gripper."""
    franky = types.SimpleNamespace(Affine=Affine, CartesianMotion=CartesianMotion)
    monkeypatch.setitem(sys.modules, "franky", franky)  # type: ignore[arg-type]
    client = runpy.run_path(str(ROOT / f"examples/serve/{request.param}_client.py"))["drive"]

    def drive_stub(policy: Policy, goal: str = "cup") -> tuple[list[np.ndarray], Gripper | None]:
        is_droid, gripper = request.param == "droid", Gripper()
        robot = RobotEnv() if is_droid else Franka()
        arguments = (robot, policy, "left") if is_droid else (robot, gripper, policy, camera)
        with contextlib.suppress(ConnectionError):
            client(*arguments, goal, 4)
        return robot.positions, None if is_droid else gripper

    return drive_stub


def test_example_client_sends_the_measured_state_and_moves_to_the_targets(drive: Drive) -> None:
    policy = Policy()
    positions, gripper = drive(policy)
    assert len(positions) == len(policy.replies) == 4
    targets = np.array([reply["actions"][-1] for reply in policy.replies])
    np.testing.assert_allclose(positions, targets[:, :3], atol=1e-7)
    assert (abs(np.diff([[0.45, 0.0, 0.3], *positions], axis=0)) <= 0.03 + 1e-6).all()
    assert [reply["goal"]["name"] for reply in policy.replies] == ["cup"] * 4
    assert policy.session.counts.episodes == 1
    moved = abs(np.diff([0.25, *targets[:, 6]])) > 0.05
    assert gripper is None or bool(gripper.calls) == bool(moved.any())


def test_example_client_does_not_move_after_an_error_or_in_a_dry_run(drive: Drive) -> None:
    policy = Policy()
    with pytest.raises(RuntimeError, match="unknown goal"):
        drive(policy, goal="plate")
    assert not policy.replies
    policy.max_replies = 1
    positions, _ = drive(policy)
    assert len(positions) == 1, "one motion before the error, none after it"
    positions, gripper = drive(Policy(dry_run=True))
    np.testing.assert_allclose(positions, np.tile([0.45, 0.0, 0.3], (4, 1)), atol=1e-9)
    assert gripper is None or not gripper.calls
