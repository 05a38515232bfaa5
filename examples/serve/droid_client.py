"""A robot of the DROID platform (`RobotEnv` of github.com/droid-dataset/droid), planned for by a server.

    vjepa2-ac serve RUN --actions pose --goals goals --host ADDRESS --key-file key \
        planning.limits.xyz=[0.075,0.075,0.075] planning.limits.l1=0.075 \
        planning.limits.workspace=[[0.3,-0.4,0.1],[0.7,0.4,0.6]]
    python droid_client.py CAMERA SERVER KEY cup      # beside: pip install openpi-client typing_extensions

CAMERA is the name of an image in `env.get_observation()["image"]`: the left image of an exterior camera. Its images and
the goals are of one size. An error of the server, or of the robot, ends the loop: the arm stays where it is.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np


def drive(env: Any, policy: Any, camera: str, goal: str, steps: int = 30) -> None:
    """Let the server move the arm to a goal that it keeps, one model step at a time."""
    for step in range(steps):
        answer = policy.infer(seen(env.get_observation(), camera) | {"prompt": goal, "reset": step == 0})
        target = np.asarray(answer["actions"][-1])  # x, y, z, roll, pitch, yaw, closedness: DROID's own numbers
        print(f"{step}: {answer['why']}, energy {answer['energy']['now']}, to {target[:3].round(3)}")
        if answer["done"]:
            break
        env.update_robot(target, action_space="cartesian_position", gripper_action_space="position", blocking=True)


def seen(observation: dict[str, Any], camera: str) -> dict[str, Any]:
    """Return the picture in RGB, and what was measured: DROID's cameras give BGR, or BGRA."""
    state = observation["robot_state"]
    return {
        "observation/image": np.ascontiguousarray(observation["image"][camera][..., 2::-1]),
        "observation/cartesian_position": np.asarray(state["cartesian_position"], dtype=np.float64),
        "observation/gripper_position": np.array([state["gripper_position"]], dtype=np.float64),
    }


def main(camera: str, server: str, key: str, goal: str) -> None:
    """Connect to the robot and to the server, and drive."""
    from droid.robot_env import RobotEnv
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    env = RobotEnv(action_space="cartesian_position", gripper_action_space="position")
    drive(env, WebsocketClientPolicy(f"ws://{server}", api_key=key), camera, goal)


if __name__ == "__main__":
    main(*sys.argv[1:5])
