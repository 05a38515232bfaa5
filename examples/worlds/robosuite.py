"""robosuite as a world for `vjepa2-ac simulate --world`: Lift, Stack, PickPlaceCan and Door, each with an expert.

    python3 -m venv worlds/robosuite && worlds/robosuite/bin/pip install robosuite==1.5.2 mujoco==3.9.0
    vjepa2-ac simulate RUN --world "worlds/robosuite/bin/python examples/worlds/robosuite.py Lift"

State and targets: the grip site in the frame of the robot's base: metres, extrinsic xyz Euler angles in radians,
closedness of the gripper from 0 (open) to 1. Every arm has the Panda's gripper; the door has no latch.
docs/worlds.md has the protocol.
"""

import argparse
import base64
import json
import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")
sys.path.append(sys.path.pop(0))  # this folder last: its robosuite.py is no library
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what libraries print is no answer

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import robosuite  # noqa: E402
from robosuite.controllers import load_composite_controller_config  # noqa: E402
from robosuite_experts import expert_of  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

TASKS = {  # in words, control steps, degrees: field of view of the camera, and how far up it is turned
    "Lift": ("lift the cube", 60, 42, 7),
    "Stack": ("put the red cube on the green one", 100, 42, 7),
    "PickPlaceCan": ("put the can into its bin", 120, 36, -6),
    "Door": ("open the door", 80, 60, 0),
}
RATE_HZ, MOST_M, MOST_RAD = 15, 0.05, 0.5  # the controller's largest change in a control step


class World:
    def __init__(self, options):
        self.options, more = options, {"use_latch": False} if options.task == "Door" else {}
        controller = load_composite_controller_config(controller="BASIC", robot=options.robot)
        self.env = robosuite.make(
            options.task, robots=options.robot, gripper_types="PandaGripper", controller_configs=controller, **more,
            control_freq=RATE_HZ, ignore_done=True, has_renderer=False, use_camera_obs=False, hard_reset=False, seed=0,
        )  # fmt: skip
        self.data, self.robot, model = self.env.sim.data, self.env.robots[0], self.env.sim.model
        camera, base = model.camera_name2id("agentview"), model.body_name2id("robot0_base")
        orbit, self.mount = (Rotation.from_euler("z", angle, degrees=True) for angle in (options.camera, options.mount))
        model.cam_pos[camera], model.cam_fovy[camera] = orbit.apply(model.cam_pos[camera]), TASKS[options.task][2]
        pose = Rotation.from_quat(model.cam_quat[camera], scalar_first=True)
        pose = orbit * pose * Rotation.from_euler("x", TASKS[options.task][3], degrees=True)
        model.cam_quat[camera] = pose.as_quat(scalar_first=True)
        model.body_quat[base], self.origin = self.mount.as_quat(scalar_first=True), model.body_pos[base].copy()
        model.light_castshadow[:], model.light_type[:] = True, 1  # a lamp far above: shadows tell how high a hand is
        model.light_dir[:], model.light_diffuse[:], model.vis.headlight.diffuse[:] = (0.15, 0.1, -1.0), 0.5, 0.3
        model.vis.quality.shadowsize = 1024
        screen = self.env.sim._render_context_offscreen
        screen.update_offscreen_size(options.size, options.size)
        screen.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0  # of the floor: a fifth of the time
        if options.look == "dusk":
            model.light_dir[:], model.light_diffuse[:] = (-0.6, 0.3, -1.0), (0.35, 0.25, 0.2)
            model.mat_texid[:], model.mat_rgba[:, :3] = -1, model.mat_rgba[:, :3] * (0.4, 0.55, 0.5)

    def reset(self, seed):
        self.env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
        self.env.reset()
        first = self.robot._ref_joint_pos_indexes[0]  # turned back: the hand begins where it does without `mount`
        self.data.qpos[first] -= np.deg2rad(self.options.mount)
        self.env.sim.forward()
        self.env.update_state()
        self.closing, self.script = -1.0, expert_of(self)
        return self.seen()

    def move(self, target, steps):
        for _ in range(steps):
            state = self.state()
            if abs(target[6] - state[6]) > 0.1:  # else as before: a thing that is held stays held
                self.closing = np.sign(target[6] - state[6])
            turn = Rotation.from_euler("xyz", target[3:6]) * Rotation.from_euler("xyz", state[3:6]).inv()
            change = [(np.array(target[:3]) - state[:3]) / MOST_M, turn.as_rotvec() / MOST_RAD, [self.closing]]
            self.env.step(np.clip(np.concatenate(change), -1.0, 1.0))
        return self.seen()

    def expert(self, steps, offset):
        for _ in range(steps):
            place, facing, closedness = next(self.script)
            target = [*self.pose_in_base(place + offset, facing), float(closedness)]
            answer = self.move(target, 1)
        return {**answer, "target": target}

    def seen(self):
        image = self.env.sim.render(camera_name="agentview", width=self.options.size, height=self.options.size)[::-1]
        pixels = {"height": len(image), "width": len(image[0]), "rgb": base64.b64encode(image.tobytes()).decode()}
        done = {"success": bool(self.env._check_success()), "distance_m": float(max(0.0, self.left_m()))}
        return {"image": pixels, "state": self.state().tolist(), **done}

    def state(self):
        fingers = self.data.qpos[self.robot._ref_gripper_joint_pos_indexes["right"]]
        return np.array([*self.pose_in_base(*self.hand()), np.clip(1.0 - np.abs(fingers).mean() / 0.04, 0.0, 1.0)])

    def hand(self):
        site = self.robot.eef_site_id["right"]
        return self.data.site_xpos[site].copy(), Rotation.from_matrix(self.data.site_xmat[site].reshape(3, 3))

    def pose_in_base(self, place, facing):
        turn = self.mount.inv()
        return [*turn.apply(place - self.origin), *(turn * facing).as_euler("xyz")]

    def left_m(self):
        if self.options.task == "Door":  # how far its edge has to go until it is open
            return 0.4 * (0.3 - self.data.qpos[self.env.hinge_qpos_addr])
        body, place = self.what_and_where()
        return np.linalg.norm(place - self.data.body_xpos[body])

    def what_and_where(self):
        """Return the body that is to be moved, and where it has to be now, in the frame of the world."""
        env, places = self.env, self.data.body_xpos
        if self.options.task == "Lift":
            height = env.model.mujoco_arena.table_offset[2] + 0.04
            return env.cube_body_id, np.maximum(places[env.cube_body_id], [-np.inf, -np.inf, height])
        if self.options.task == "Stack":
            return env.cubeA_body_id, places[env.cubeB_body_id] + [0.0, 0.0, 0.045]
        place = env.target_bin_placements[env.object_to_id["can"]]
        return env.obj_body_id["Can"], np.add(place, [-0.05, -0.05, 0.05])  # in its bin, and within reach


def say(answer):
    print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--robot", default="Panda", help="Panda, Sawyer, IIWA, UR5e, Kinova3")
    parser.add_argument("--camera", type=float, default=0.0, help="degrees by which it is turned about the table")
    parser.add_argument("--mount", type=float, default=0.0, help="degrees by which the arm is mounted turned")
    parser.add_argument("--look", choices=["day", "dusk"], default="day", help="light and colours")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image")
    options = parser.parse_args()
    world, (words, steps, *_) = World(options), TASKS[options.task]
    about = {"world": f"robosuite {robosuite.__version__}", "task": options.task, "instruction": words}
    say({**about, "rate_hz": RATE_HZ, "steps": steps, "expert": True})
    for line in sys.stdin:
        request = json.loads(line)
        say(getattr(world, request.pop("do"))(**request))
