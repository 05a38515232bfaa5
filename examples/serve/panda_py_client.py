"""A Franka arm, moved by panda-py (`pip install panda-python`), and planned for by a server.

    vjepa2-ac serve RUN --actions pose --goals goals --host ADDRESS --key-file key \
        planning.limits.xyz=[0.01,0.01,0.01] planning.limits.workspace=[[0.3,-0.3,0.2],[0.7,0.3,0.6]]
    python panda_py_client.py ARM SERVER KEY cup      # beside: pip install openpi-client typing_extensions scipy

Make `camera` return an RGB image of the goal's size: height x width x 3, uint8. Keep a hand on the emergency stop. An
error of the server, or of the arm, ends the loop: the arm stays where it is.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

SPEED_M_S, FORCE_N, ARM_SPEED = 0.05, 20.0, 0.05  # of the gripper; of the arm a share of what it can do


def drive(panda: Any, gripper: Any, policy: Any, camera: Callable[[], np.ndarray], goal: str, steps: int = 30) -> None:
    """Let the server move the arm to a goal that it keeps, one model step at a time."""
    for step in range(steps):
        tool = np.reshape(panda.get_state().F_T_EE, (4, 4), order="F")  # the server plans for the flange
        answer = policy.infer(seen(camera(), panda.get_pose() @ np.linalg.inv(tool), gripper) | asked(goal, step))
        x, y, z, *angles, closedness = answer["actions"][-1]  # the target, within the server's limits and workspace
        print(f"{step}: {answer['why']}, energy {answer['energy']['now']}, to {x:.3f} {y:.3f} {z:.3f}")
        if answer["done"]:
            break
        flange = np.eye(4)
        flange[:3, :3], flange[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), (x, y, z)
        if not panda.move_to_pose(flange @ tool, speed_factor=ARM_SPEED):  # returns when the arm is there
            raise RuntimeError("the arm has not reached the target")
        grip(gripper, closedness)


def seen(image: np.ndarray, flange: np.ndarray, gripper: Any) -> dict[str, Any]:
    """Return the picture, and what was measured."""
    angles, fingers = Rotation.from_matrix(flange[:3, :3]).as_euler("xyz"), gripper.read_once()
    return {
        "observation/image": image,
        "observation/cartesian_position": np.concatenate([flange[:3, 3], angles]),
        "observation/gripper_position": np.clip([1.0 - fingers.width / fingers.max_width], 0.0, 1.0),
    }


def asked(goal: str, step: int) -> dict[str, Any]:
    """Return the goal, and that an episode begins with the first step."""
    return {"prompt": goal, "reset": step == 0}


def grip(gripper: Any, closedness: float) -> None:
    """Close around whatever is there, open, or leave the fingers alone."""
    fingers = gripper.read_once()
    change = closedness - np.clip(1.0 - fingers.width / fingers.max_width, 0.0, 1.0)
    if change > 0.05:
        gripper.grasp(0.0, SPEED_M_S, FORCE_N, epsilon_inner=0.005, epsilon_outer=1.0)
    elif change < -0.05:
        gripper.move((1.0 - closedness) * fingers.max_width, SPEED_M_S)


def main(arm: str, server: str, key: str, goal: str) -> None:
    """Connect to the arm and to the server, and drive."""
    from openpi_client.websocket_client_policy import WebsocketClientPolicy
    from panda_py import Panda, libfranka

    drive(Panda(arm), libfranka.Gripper(arm), WebsocketClientPolicy(f"ws://{server}", api_key=key), camera, goal)


def camera() -> np.ndarray:
    """Return what your camera sees."""
    raise NotImplementedError("put your camera here: an RGB image, height x width x 3, uint8")


if __name__ == "__main__":
    main(*sys.argv[1:5])
