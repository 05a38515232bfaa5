"""robosuite for `vjepa2-ac simulate --world`: Lift, Stack, PickPlaceCan and Door, each with a scripted expert.

    python3 -m venv worlds/robosuite && worlds/robosuite/bin/pip install robosuite==1.5.2 mujoco==3.9.0
    vjepa2-ac simulate RUN --world "worlds/robosuite/bin/python examples/worlds/robosuite.py Lift"

State and targets: the pose of the grip site in the frame of the robot's base (metres, extrinsic xyz Euler angles in
radians), and the gripper position from 0 (open) to 1. All arms have the Panda gripper; the door has no latch.
"""

from serve_environment import get_versions, serve  # first: it moves this folder behind installed packages

# isort: split
import numpy as np
import robosuite
from robosuite.controllers import load_composite_controller_config
from robosuite_experts import compute_distance_m, make_script
from robosuite_view import TASKS, read_options, set_view
from scipy.spatial.transform import Rotation

RATE_HZ, REACH_M, REACH_RAD = 15, 0.05, 0.5  # control rate; the controller's largest changes per control step


class World:
    def __init__(self, options):
        self.options, latch = options, {"use_latch": False} if options.task == "Door" else {}
        controller = load_composite_controller_config(controller="BASIC", robot=options.robot)
        self.env = robosuite.make(
            options.task, robots=options.robot, gripper_types="PandaGripper", controller_configs=controller, **latch,
            control_freq=RATE_HZ, ignore_done=True, has_renderer=False, use_camera_obs=False, hard_reset=False, seed=0,
        )  # fmt: skip
        self.data, self.robot = self.env.sim.data, self.env.robots[0]
        self.mount = Rotation.from_euler("z", options.mount, degrees=True)
        self.origin = set_view(self.env.sim, options, self.mount)

    def reset(self, seed):
        self.env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
        self.env.reset()
        first = self.robot._ref_joint_pos_indexes[
            0
        ]  # compensates `mount`, so that the hand starts at the same position
        self.data.qpos[first] -= np.deg2rad(self.options.mount)
        self.env.sim.forward()
        self.env.update_state()
        self.closing, self.script = -1.0, make_script(self)
        return self.state(), self.info()

    def step(self, target):
        if target is None:
            position, rotation, gripper_position = next(self.script)
            target = [*self.pose_in_base(position, rotation), gripper_position]
        state = self.state()
        if abs(target[6] - state[6]) > 0.1:  # smaller changes are ignored, so that a grasped object is not dropped
            self.closing = np.sign(target[6] - state[6])
        turn = Rotation.from_euler("xyz", target[3:6]) * Rotation.from_euler("xyz", state[3:6]).inv()
        change = [(np.array(target[:3]) - state[:3]) / REACH_M, turn.as_rotvec() / REACH_RAD, [self.closing]]
        self.env.step(np.clip(np.concatenate(change), -1.0, 1.0))
        return self.state(), 0.0, False, False, self.info() | {"target": target}

    def render(self):
        return self.env.sim.render(camera_name="agentview", width=self.options.size, height=self.options.size)[::-1]

    def info(self):
        return {"success": self.env._check_success(), "distance_m": max(0.0, compute_distance_m(self))}

    def state(self):
        fingers = self.data.qpos[self.robot._ref_gripper_joint_pos_indexes["right"]]
        return [*self.pose_in_base(*self.hand()), np.clip(1.0 - np.abs(fingers).mean() / 0.04, 0.0, 1.0)]

    def hand(self):
        site = self.robot.eef_site_id["right"]
        return self.data.site_xpos[site].copy(), Rotation.from_matrix(self.data.site_xmat[site].reshape(3, 3))

    def pose_in_base(self, position, rotation):
        turn = self.mount.inv()
        return [*turn.apply(position - self.origin), *(turn * rotation).as_euler("xyz")]


if __name__ == "__main__":
    options = read_options(__doc__)
    instruction, steps, *_ = TASKS[options.task]
    versions = get_versions("robosuite", "mujoco", "numpy")
    name = f"robosuite {versions['robosuite']} with MuJoCo {versions['mujoco']}"
    serve(World(options), world=name, task=options.task, instruction=instruction, rate_hz=RATE_HZ, steps=steps,
          expert=True, versions=versions)  # fmt: skip
