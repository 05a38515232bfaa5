"""Meta-World for `vjepa2-ac simulate --world`: 50 tasks of a Sawyer arm, each with its own scripted expert.

    python3 -m venv worlds/metaworld && worlds/metaworld/bin/pip install metaworld==3.1.1 mujoco==3.3.0 packaging
    vjepa2-ac simulate RUN --world "worlds/metaworld/bin/python examples/worlds/metaworld.py push-v3"

State and targets: the hand in the frame of the robot's base: metres, extrinsic xyz Euler angles in radians (ignored in
targets), closedness from 0 (open) to 1. A wrong task prints all.
"""

from serve_environment import serve  # first: it moves this folder behind installed packages

# isort: split
import importlib.metadata

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE as ENVIRONMENTS
from metaworld_expert import Expert, read_options
from scipy.spatial.transform import Rotation

RATE_HZ, ENV_STEPS, STEPS = 16, 5, 60  # environment steps of a control step; control steps that suffice
GAIN, DAMPING, LEAD_M = 20.0, 2.0, 0.1  # the last: how far the point that pulls the hand may be ahead of it
NEAR_M, TRAVEL_M = 0.01, 0.07  # there; travel of both fingers
DOWN = Rotation.from_euler("y", np.pi / 2)  # of the hand: angles count from there, far from their singularity


class World:
    def __init__(self, options):
        self.options, self.env = options, ENVIRONMENTS[f"{options.task}-goal-observable"]()
        self.env._freeze_rand_vec, self.env.seeded_rand_vec, self.env.max_path_length = False, True, np.inf
        self.env.model.vis.quality.shadowsize = 1024  # of 4096: by software the same picture in half the time
        self.renderer = mujoco.Renderer(self.env.model, options.size, options.size)
        self.expert = Expert(options.task)

    def reset(self, seed):
        self.env.seed(seed)
        self.env.reset()
        mujoco.mj_forward(self.env.model, self.env.data)  # Meta-World leaves some places as they were before
        self.observation, self.closing, self.expert.solved = self.env._get_obs(), -1.0, 0
        self.found = self.env.evaluate_state(self.observation, np.zeros(4))[1]
        return self.state(), self.info()

    def state(self):
        turn = Rotation.from_matrix(self.env.data.body("hand").xmat.reshape(3, 3)) * DOWN.inv()
        travel = self.env.data.joint("r_close").qpos - self.env.data.joint("l_close").qpos
        return np.concatenate([self.env.get_endeff_pos(), turn.as_euler("xyz"), np.clip(travel / TRAVEL_M, 0.0, 1.0)])

    def pull(self, place, gain):  # a step of the environment
        hand, scale = self.env.get_endeff_pos(), self.env.action_scale
        ahead, way = self.env.data.mocap_pos[0] - hand, scale * np.clip(gain * (place - hand), -1.0, 1.0)
        way = np.clip(ahead + way, -LEAD_M, LEAD_M) - ahead
        self.observation, _, _, _, self.found = self.env.step(np.append(way / scale, self.closing))
        self.expert.watch(self.observation[:3], self.found["success"])

    def step(self, target):
        for left in range(ENV_STEPS, 0, -1):
            if target is None:
                held, aim, self.closing = self.expert.act(self.observation, self.closing)
                held = [*held, *self.state()[3:6], self.closing > 0]
                self.pull(*aim)
                continue
            held, change = target, target - self.state()
            is_there = np.linalg.norm(change[:3]) < NEAR_M or left == 1
            if is_there and abs(change[6]) > 0.1:  # less: as before, so that a held thing stays held
                self.closing = np.sign(change[6])
            self.pull(target[:3] - DAMPING * (self.observation[:3] - self.observation[18:21]), GAIN)
        return self.state(), 0.0, False, False, self.info() | {"target": held}

    def info(self):
        return {"success": self.found["success"], "distance_m": self.found["obj_to_target"]}

    def render(self):
        self.renderer.update_scene(self.env.data, self.options.camera)
        turned = -1 if self.env.data.cam(self.options.camera).xmat[7] < 0 else 1  # some hang upside down
        return self.renderer.render()[::turned, ::turned]


if __name__ == "__main__":
    options = read_options(__doc__)
    name, words = "Meta-World " + importlib.metadata.version("metaworld"), options.task.removesuffix("-v3")
    serve(World(options), world=name, task=options.task, instruction=words.replace("-", " "), rate_hz=RATE_HZ,
          steps=STEPS, expert=True)  # fmt: skip
