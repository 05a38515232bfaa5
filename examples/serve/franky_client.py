"""Drive a Franka arm through franky (`pip install franky-control`) with plans from a server.

    vjepa2-ac serve RUN --actions pose --goals goals --host ADDRESS --key-file key \
        planning.limits.xyz=[0.01,0.01,0.01] planning.limits.workspace=[[0.3,-0.3,0.2],[0.7,0.3,0.6]]
    python franky_client.py ARM SERVER KEY cup        # needs: pip install openpi-client typing_extensions scipy

Make `camera` return an RGB image with the size of the goal image (height x width x 3, uint8). Keep a hand on the
emergency stop. An error of the server or of the arm ends the loop, and the arm stops.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

SPEED_M_S, FORCE_N = 0.05, 20.0  # speed and force of the gripper


def drive(robot: Any, gripper: Any, policy: Any, camera: Callable[[], np.ndarray], goal: str, steps: int = 30) -> None:
    """Move the arm to a goal that is stored on the server, one model step at a time."""
    from franky import Affine, CartesianMotion

    for step in range(steps):
        tool = robot.state.F_T_EE  # the server plans for the flange, franky moves the tool
        reply = policy.infer(observe(camera(), robot.state.O_T_EE * tool.inverse, gripper) | goal_request(goal, step))
        x, y, z, *angles, gripper_position = reply["actions"][
            -1
        ]  # the target, within the server's limits and workspace
        print(f"{step}: {reply['why']}, energy {reply['energy']['now']}, to {x:.3f} {y:.3f} {z:.3f}")
        if reply["done"]:
            break
        flange = Affine([x, y, z], Rotation.from_euler("xyz", angles).as_quat())
        robot.move(CartesianMotion(flange * tool))  # returns when the arm has reached the pose
        grip(gripper, gripper_position)


def observe(image: np.ndarray, flange: Any, gripper: Any) -> dict[str, Any]:
    """Return the image and the measured state as fields of a request."""
    angles = Rotation.from_quat(flange.quaternion).as_euler("xyz")
    pose = np.concatenate([np.ravel(flange.translation), angles])
    closed = np.clip(1.0 - gripper.width / gripper.max_width, 0.0, 1.0)
    return {
        "observation/image": image,
        "observation/cartesian_position": pose,
        "observation/gripper_position": np.array([closed]),
    }


def goal_request(goal: str, step: int) -> dict[str, Any]:
    """Return the fields for the goal, and for the start of an episode at the first step."""
    return {"prompt": goal, "reset": step == 0}


def grip(gripper: Any, gripper_position: float) -> None:
    """Grasp, open, or leave the fingers unchanged if the change is small."""
    change = gripper_position - np.clip(1.0 - gripper.width / gripper.max_width, 0.0, 1.0)
    if change > 0.05:
        gripper.grasp(0.0, SPEED_M_S, FORCE_N, epsilon_outer=1.0)
    elif change < -0.05:
        gripper.move((1.0 - gripper_position) * gripper.max_width, SPEED_M_S)


def main(arm: str, server: str, key: str, goal: str) -> None:
    """Connect to the arm and the server, and run the control loop."""
    from franky import Gripper, Robot
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    robot = Robot(arm, relative_dynamics_factor=0.05)  # slow: 5 % of what the arm can do
    robot.recover_from_errors()
    drive(robot, Gripper(arm), WebsocketClientPolicy(f"ws://{server}", api_key=key), camera, goal)


def camera() -> np.ndarray:
    """Return what your camera sees."""
    raise NotImplementedError("put your camera here: an RGB image, height x width x 3, uint8")


if __name__ == "__main__":
    main(*sys.argv[1:5])
