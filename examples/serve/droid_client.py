"""Drive a robot of the DROID platform (`RobotEnv` of github.com/droid-dataset/droid) with plans from a server.

    vjepa2-ac serve RUN --actions pose --goals goals --host ADDRESS --key-file key \
        planning.limits.xyz=[0.075,0.075,0.075] planning.limits.l1=0.075 \
        planning.limits.workspace=[[0.3,-0.4,0.1],[0.7,0.4,0.6]]
    python droid_client.py CAMERA SERVER KEY cup      # needs: pip install openpi-client typing_extensions

CAMERA is the name of an image in `env.get_observation()["image"]`: the left image of an exterior camera. Its images
must have the size of the goal images. An error of the server or of the robot ends the loop, and the arm stops.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np


def drive(env: Any, policy: Any, camera: str, goal: str, steps: int = 30) -> None:
    """Move the arm to a goal that is stored on the server, one model step at a time."""
    for step in range(steps):
        reply = policy.infer(make_request(env.get_observation(), camera) | {"prompt": goal, "reset": step == 0})
        target = np.asarray(reply["actions"][-1])  # x, y, z, roll, pitch, yaw, gripper position, as in DROID
        print(f"{step}: {reply['why']}, energy {reply['energy']['now']}, to {target[:3].round(3)}")
        if reply["done"]:
            break
        env.update_robot(target, action_space="cartesian_position", gripper_action_space="position", blocking=True)


def make_request(observation: dict[str, Any], camera: str) -> dict[str, Any]:
    """Return the image in RGB and the measured state. DROID's cameras return BGR or BGRA."""
    state = observation["robot_state"]
    return {
        "observation/image": np.ascontiguousarray(observation["image"][camera][..., 2::-1]),
        "observation/cartesian_position": np.asarray(state["cartesian_position"], dtype=np.float64),
        "observation/gripper_position": np.array([state["gripper_position"]], dtype=np.float64),
    }


def main(camera: str, server: str, key: str, goal: str) -> None:
    """Connect to the robot and the server, and run the control loop."""
    from droid.robot_env import RobotEnv
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    env = RobotEnv(action_space="cartesian_position", gripper_action_space="position")
    drive(env, WebsocketClientPolicy(f"ws://{server}", api_key=key), camera, goal)


if __name__ == "__main__":
    main(*sys.argv[1:5])
