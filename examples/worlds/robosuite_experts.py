"""Scripted experts of robosuite.py, which yield without end the next target of the hand, and distances to goals.

Each target is a place of the grip site, its orientation, both in the frame of the world, and a closedness.
"""

import numpy as np
from scipy.spatial.transform import Rotation

ABOVE, NEAR_M = np.array([0.0, 0.0, 0.10]), 0.012  # from where a thing is approached; what counts as being at it


def expert_of(world):
    expert = Expert(world)
    yield from expert.pull() if world.options.task == "Door" else expert.pick_and_put(*what_and_where(world))
    yield from expert.hold(world.state()[6], steps=100_000)


class Expert:
    def __init__(self, world):
        self.world, self.facing = world, world.hand()[1]

    def go(self, where, closedness, near=0.03):
        while np.linalg.norm(where() - self.world.hand()[0]) > near:
            yield where(), self.facing, closedness

    def hold(self, closedness, steps=8):
        yield from [(self.world.hand()[0], self.facing, closedness)] * steps

    def turn(self, angle):
        self.facing = Rotation.from_euler("z", angle) * self.facing

    def pick_and_put(self, body, place):
        at = self.world.data.body_xpos[body]  # follows the body
        yaw = Rotation.from_matrix(self.world.data.body_xmat[body].reshape(3, 3)).as_euler("zyx")[0]
        self.turn((yaw - self.facing.as_euler("zyx")[0] + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        yield from self.go(lambda: at + ABOVE, 0.0)
        yield from self.go(lambda: at, 0.0, NEAR_M)
        yield from self.hold(1.0)
        lifted, hand = at + ABOVE, place + self.world.hand()[0] - at
        yield from self.go(lambda: lifted, 1.0)
        if self.world.options.task != "Lift":
            yield from self.go(lambda: hand + ABOVE, 1.0)
            yield from self.go(lambda: hand, 1.0, NEAR_M)
            yield from self.hold(0.0)
            yield from self.go(lambda: hand + ABOVE, 0.0)

    def pull(self):
        """Put closed fingers between door and handle, and pull."""
        data, env = self.world.data, self.world.env
        out = -data.body_xmat[env.object_body_ids["door"]].reshape(3, 3)[:, 1]
        behind = data.site_xpos[env.door_handle_site_id] - 0.045 * out
        self.turn(np.arctan2(out[1], out[0]) - np.pi)  # the wrist on the robot's side
        for place in (behind + ABOVE * 1.5 + 0.1 * out, behind + ABOVE * 1.2, behind, behind + 0.3 * out):
            yield from self.go(lambda place=place: place, 1.0)


def what_and_where(world):
    """Return the body that is to be moved, and where it has to be now, in the frame of the world."""
    env, places = world.env, world.data.body_xpos
    if world.options.task == "Lift":
        height = env.model.mujoco_arena.table_offset[2] + 0.04
        return env.cube_body_id, np.maximum(places[env.cube_body_id], [-np.inf, -np.inf, height])
    if world.options.task == "Stack":
        return env.cubeA_body_id, places[env.cubeB_body_id] + [0.0, 0.0, 0.045]
    place = env.target_bin_placements[env.object_to_id["can"]]
    return env.obj_body_id["Can"], np.add(place, [-0.05, -0.05, 0.05])  # in its bin, and within reach


def left_m(world):
    """Return how far what the task moves is from where it has to be; of the door, how far its edge has to go."""
    if world.options.task == "Door":
        return 0.4 * (0.3 - world.data.qpos[world.env.hinge_qpos_addr])
    body, place = what_and_where(world)
    return np.linalg.norm(place - world.data.body_xpos[body])
