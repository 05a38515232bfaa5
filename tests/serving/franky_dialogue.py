"""A Franka arm that is simulated, moved by the real franky, asked for by the real openpi-client.

Run by test_franky_sim.py as `python franky_dialogue.py EXAMPLE URL`, where all three are installed; prints JSON.
"""

import json
import runpy
import sys

import franky
import numpy as np
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator
from openpi_client.websocket_client_policy import WebsocketClientPolicy


class Heard(WebsocketClientPolicy):
    """The client; keeps the answers."""

    def infer(self, obs):
        """Ask the server."""
        answer = super().infer(obs)
        answers.append(answer["actions"][-1].tolist())
        return answer


def flange(robot):
    """Return where the flange is."""
    state = robot.state
    return (state.O_T_EE * state.F_T_EE.inverse).translation.ravel().tolist()


if __name__ == "__main__":
    _, example, url = sys.argv
    answers = []
    picture = np.random.default_rng(3).integers(0, 256, (48, 60, 3), dtype=np.uint8)
    with MujocoSimulator(enable_visualization=False) as simulator:
        arm = simulator.add_robot()
        with SimulationServer(simulator) as server:
            server.run_async()
            robot = franky.Robot(
                arm.hostname, relative_dynamics_factor=0.2, realtime_config=franky.RealtimeConfig.Ignore
            )
            start = flange(robot)
            runpy.run_path(example)["drive"](robot, franky.Gripper(arm.hostname), Heard(url), lambda: picture, "cup", 4)
            end = flange(robot)
            sys.stdout.write("\n" + json.dumps({"start": start, "end": end, "answers": answers}))
            sys.stdout.flush()
