"""Options of metaworld.py, and Meta-World's own scripted expert of a task."""

import argparse
import sys

import numpy as np
from metaworld.policies import ENV_POLICY_MAP as EXPERTS

REACH_M, SURE = 0.1, 3  # targets are no farther; after so many steps of success it holds still: many would undo it


class Expert:
    def __init__(self, task):
        self.policy = EXPERTS[task]()  # it calls `move`, which would make an action of a place and a gain
        sys.modules[self.policy.__module__].move = lambda hand, to_xyz, p: setattr(self, "aim", (to_xyz, p)) or hand
        self.solved = 0

    def act(self, observation, closing):
        """Return the target that it holds, the place and gain that it pulls to, and how it closes."""
        if self.solved < SURE:
            closing = float(self.policy.get_action(observation.copy())[3])
        hand = observation[:3]
        return hand + np.clip(self.aim[0] - hand, -REACH_M, REACH_M), self.aim, closing

    def watch(self, hand, is_done):
        self.solved = self.solved + 1 if is_done else 0
        if self.solved == SURE:
            self.aim = hand, 10.0


def read_options(description):
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=EXPERTS)
    parser.add_argument("--camera", default="corner4", help="corner, corner2, corner3, topview, behindGripper")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image, at most 480")
    return parser.parse_args()
