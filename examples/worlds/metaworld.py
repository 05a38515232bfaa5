"""Meta-World for `vjepa2-ac simulate --world`: 50 tasks of a Sawyer arm, each with its own scripted expert.

    python3 -m venv worlds/metaworld && worlds/metaworld/bin/pip install metaworld==3.1.1 mujoco==3.3.0 packaging
    vjepa2-ac simulate RUN --world "worlds/metaworld/bin/python examples/worlds/metaworld.py push-v3"

State and targets: the pose of the hand in the frame of the robot's base (metres, extrinsic xyz Euler angles in radians;
rotations of targets are ignored), and the gripper position from 0 (open) to 1. An unknown task prints the names of all
tasks.
"""

from serve_environment import get_versions, serve  # first: it moves this folder behind installed packages

# isort: split
import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE as ENVIRONMENTS
from metaworld_expert import Expert, read_options
from scipy.spatial.transform import Rotation

RATE_HZ, ENV_STEPS, STEPS = 16, 5, 60  # control rate; environment steps per control step; control steps per episode
GAIN, DAMPING, LEAD_M = 20.0, 2.0, 0.1  # of the position controller; largest distance of the mocap point from the hand
NEAR_M, TRAVEL_M = 0.01, 0.07  # distance below which a target is reached; travel of both fingers
DOWN = Rotation.from_euler("y", np.pi / 2)  # reference rotation of the hand, which keeps Euler angles off gimbal lock


class World:
    def __init__(self, options):
        self.options, self.env = options, ENVIRONMENTS[f"{options.task}-goal-observable"]()
        self.env._freeze_rand_vec, self.env.seeded_rand_vec, self.env.max_path_length = False, True, np.inf
        self.env.model.vis.quality.shadowsize = 1024  # instead of 4096: the same image in half the time
        self.renderer = mujoco.Renderer(self.env.model, options.size, options.size)
        self.expert = Expert(options.task)

    def reset(self, seed):
        self.env.seed(seed)
        self.env.reset()
        mujoco.mj_forward(self.env.model, self.env.data)  # a reset of Meta-World does not update all positions
        self.observation, self.closing, self.expert.solved = self.env._get_obs(), -1.0, 0
        self.result = self.env.evaluate_state(self.observation, np.zeros(4))[1]
        return self.state(), self.info()

    def state(self):
        turn = Rotation.from_matrix(self.env.data.body("hand").xmat.reshape(3, 3)) * DOWN.inv()
        travel = self.env.data.joint("r_close").qpos - self.env.data.joint("l_close").qpos
        return np.concatenate([self.env.get_endeff_pos(), turn.as_euler("xyz"), np.clip(travel / TRAVEL_M, 0.0, 1.0)])

    def pull(self, position, gain):  # one step of the environment towards a position
        hand, scale = self.env.get_endeff_pos(), self.env.action_scale
        lead, change = self.env.data.mocap_pos[0] - hand, scale * np.clip(gain * (position - hand), -1.0, 1.0)
        change = np.clip(lead + change, -LEAD_M, LEAD_M) - lead
        self.observation, _, _, _, self.result = self.env.step(np.append(change / scale, self.closing))
        self.expert.watch(self.observation[:3], self.result["success"])

    def step(self, target):
        for remaining in range(ENV_STEPS, 0, -1):
            if target is None:
                reported, aim, self.closing = self.expert.act(self.observation, self.closing)
                reported = [*reported, *self.state()[3:6], self.closing > 0]
                self.pull(*aim)
                continue
            reported, change = target, target - self.state()
            is_reached = np.linalg.norm(change[:3]) < NEAR_M or remaining == 1
            # Small changes are ignored, so that a grasped object is not dropped.
            if is_reached and abs(change[6]) > 0.1:
                self.closing = np.sign(change[6])
            self.pull(target[:3] - DAMPING * (self.observation[:3] - self.observation[18:21]), GAIN)
        return self.state(), 0.0, False, False, self.info() | {"target": reported}

    def info(self):
        return {"success": self.result["success"], "distance_m": self.result["obj_to_target"]}

    def render(self):
        self.renderer.update_scene(self.env.data, self.options.camera)
        direction = -1 if self.env.data.cam(self.options.camera).xmat[7] < 0 else 1  # some cameras are upside down
        return self.renderer.render()[::direction, ::direction]


if __name__ == "__main__":
    options = read_options(__doc__)
    versions, words = get_versions("metaworld", "mujoco", "numpy"), options.task.removesuffix("-v3")
    name = f"Meta-World {versions['metaworld']} with MuJoCo {versions['mujoco']}"
    serve(World(options), world=name, task=options.task, instruction=words.replace("-", " "), rate_hz=RATE_HZ,
          steps=STEPS, expert=True, versions=versions)  # fmt: skip
