"""Meta-World as a world for `vjepa2-ac simulate --world`: 50 tasks of a Sawyer arm, each with a scripted expert.

    python3 -m venv worlds/metaworld && worlds/metaworld/bin/pip install metaworld==3.1.1 mujoco==3.3.0 packaging
    vjepa2-ac simulate RUN --world "worlds/metaworld/bin/python examples/worlds/metaworld.py push-v3"

It imports nothing of vjepa2-ac; docs/worlds.md has the protocol. State and targets: the hand in the frame of the
robot's base: metres, extrinsic xyz Euler angles in radians (ignored in targets), closedness from 0 (open) to 1.
"""

import argparse
import base64
import difflib
import importlib.metadata
import json
import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")
sys.path.pop(0)  # this folder: `import metaworld` would find this file
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what libraries print is no answer

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE as ENVIRONMENTS  # noqa: E402
from metaworld.policies import ENV_POLICY_MAP as EXPERTS  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

RATE_HZ, ENV_STEPS, STEPS = 16, 5, 60  # environment steps of a control step; control steps that suffice
GAIN, DAMPING, LEAD_M = 20.0, 2.0, 0.1  # the last: how far the point that pulls the hand may be ahead of it
NEAR_M, REACH_M, TRAVEL_M = 0.01, 0.1, 0.07  # there; the expert's targets are no farther; travel of both fingers
SURE = 3  # after so many environment steps of success the expert holds still: many go on, and undo it
DOWN = Rotation.from_euler("y", np.pi / 2)  # of the hand: angles count from there, far from their singularity
MOVED = {"assembly-v3": ("site", "RoundNut"), "disassemble-v3": ("site", "RoundNut"),
         "box-close-v3": ("body", "top_link"), "door-open-v3": ("geom", "handle"), "hammer-v3": ("body", "nail_link"),
         "lever-pull-v3": ("site", "leverStart")}  # what is moved, where Meta-World tells no distance  # fmt: skip


class World:
    def __init__(self, options):
        self.options, self.env = options, ENVIRONMENTS[f"{options.task}-goal-observable"]()
        self.env._freeze_rand_vec, self.env.seeded_rand_vec, self.env.max_path_length = False, True, np.inf
        self.env.model.vis.quality.shadowsize = 1024  # of 4096: by software the same picture in half the time
        self.renderer = mujoco.Renderer(self.env.model, options.size, options.size)
        self.policy = EXPERTS[options.task]()  # it calls `move`, which would make an action of a place and a gain
        sys.modules[self.policy.__module__].move = lambda hand, to_xyz, p: setattr(self, "aim", (to_xyz, p)) or hand

    def reset(self, seed):
        self.env.seed(seed)
        self.env.reset()
        mujoco.mj_forward(self.env.model, self.env.data)  # Meta-World leaves some places as they were before
        self.observation, self.solved, self.closing = self.env._get_obs(), 0, -1.0
        self.info = self.env.evaluate_state(self.observation, np.zeros(4))[1]
        return self.seen()

    def state(self):
        turn = Rotation.from_matrix(self.env.data.body("hand").xmat.reshape(3, 3)) * DOWN.inv()
        travel = self.env.data.joint("r_close").qpos - self.env.data.joint("l_close").qpos
        return np.concatenate([self.env.get_endeff_pos(), turn.as_euler("xyz"), np.clip(travel / TRAVEL_M, 0.0, 1.0)])

    def step(self, place, gain):  # of the environment
        hand, scale = self.env.get_endeff_pos(), self.env.action_scale
        ahead, way = self.env.data.mocap_pos[0] - hand, scale * np.clip(gain * (place - hand), -1.0, 1.0)
        way = np.clip(ahead + way, -LEAD_M, LEAD_M) - ahead
        self.observation, _, _, _, self.info = self.env.step(np.append(way / scale, self.closing))
        self.solved = self.solved + 1 if self.info["success"] else 0
        if self.solved == SURE:
            self.aim = self.observation[:3], 10.0

    def move(self, target, steps):
        for left in range(steps * ENV_STEPS, 0, -1):
            change = target - self.state()
            is_there = np.linalg.norm(change[:3]) < NEAR_M or left <= ENV_STEPS
            if is_there and abs(change[6]) > 0.1:  # less: as before, so that a held thing stays held
                self.closing = np.sign(change[6])
            self.step(target[:3] - DAMPING * (self.observation[:3] - self.observation[18:21]), GAIN)
        return self.seen()

    def expert(self, steps, offset=(0.0, 0.0, 0.0)):
        for _ in range(steps * ENV_STEPS):
            hand, acts = self.observation[:3], self.solved < SURE
            if acts:
                self.closing = float(self.policy.get_action(self.observation.copy())[3])
            target = hand + np.clip(self.aim[0] - hand, -REACH_M, REACH_M)
            self.step(self.aim[0] + acts * np.array(offset), self.aim[1])
        return {**self.seen(), "target": [*target, *self.state()[3:6], float(self.closing > 0)]}

    def seen(self):
        camera, left_m = self.options.camera, self.info["obj_to_target"]
        self.renderer.update_scene(self.env.data, camera)
        turned = -1 if self.env.data.cam(camera).xmat[7] < 0 else 1  # some of the cameras hang upside down
        image = self.renderer.render()[::turned, ::turned]
        if self.options.task in MOVED:
            kind, name = MOVED[self.options.task]
            left_m = np.linalg.norm(getattr(self.env.data, kind)(name).xpos - self.env._target_pos)
        return {
            "image": {"height": len(image), "width": len(image), "rgb": base64.b64encode(image.tobytes()).decode()},
            "state": self.state().tolist(), "success": bool(self.info["success"]), "distance_m": float(left_m),
        }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?")
    parser.add_argument("--list", action="store_true", help="print the tasks")
    parser.add_argument("--camera", default="corner4", help="corner, corner2, corner3, topview, behindGripper")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image, at most 480")
    options = parser.parse_args()
    if options.list:
        parser.exit(print(*EXPERTS, sep="\n", file=answers))
    if options.task not in EXPERTS:
        near = difflib.get_close_matches(str(options.task), EXPERTS, cutoff=0.0)
        parser.exit(2, f"There is no task {options.task!r}: {', '.join(near)} are near, and --list prints all.\n")
    world, words = World(options), options.task.removesuffix("-v3").replace("-", " ")
    about = {"world": "Meta-World " + importlib.metadata.version("metaworld"), "rate_hz": RATE_HZ, "steps": STEPS}
    print(json.dumps({**about, "task": options.task, "instruction": words, "expert": True}), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(getattr(world, request.pop("do"))(**request)), file=answers, flush=True)
