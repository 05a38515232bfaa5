"""Options of metaworld.py, and Meta-World's own scripted expert of a task."""

import argparse
import sys

import numpy as np
from metaworld.policies import ENV_POLICY_MAP as EXPERTS

REACH_M = 0.1  # largest distance of a target from the hand
SUCCESS_STEPS = 3  # after this many successful steps the expert holds still, because many policies would undo the task


class Expert:
    def __init__(self, task):
        self.policy = EXPERTS[task]()
        # The policy passes a position and a gain to `move`, which computes an action. Both are stored instead.
        sys.modules[self.policy.__module__].move = lambda hand, to_xyz, p: setattr(self, "aim", (to_xyz, p)) or hand
        self.solved = 0

    def act(self, observation, closing):
        """Return the target position, the position and gain of the controller, and the action of the gripper."""
        if self.solved < SUCCESS_STEPS:
            closing = float(self.policy.get_action(observation.copy())[3])
        hand = observation[:3]
        return hand + np.clip(self.aim[0] - hand, -REACH_M, REACH_M), self.aim, closing

    def watch(self, hand, is_done):
        self.solved = self.solved + 1 if is_done else 0
        if self.solved == SUCCESS_STEPS:
            self.aim = hand, 10.0


def read_options(description):
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=EXPERTS)
    parser.add_argument("--camera", default="corner4", help="corner, corner2, corner3, topview, behindGripper")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image, at most 480")
    return parser.parse_args()
