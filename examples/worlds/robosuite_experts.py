"""Scripted experts of robosuite.py, which yield targets of the hand without end, and distances to goals.

Each target has the position and the rotation of the grip site in the world frame, and a gripper position.
"""

import numpy as np
from scipy.spatial.transform import Rotation

ABOVE, NEAR_M = (
    np.array([0.0, 0.0, 0.10]),
    0.012,
)  # height from which objects are approached; distance below which a target is reached


def make_script(world):
    expert = Expert(world)
    yield from expert.pull() if world.options.task == "Door" else expert.pick_and_put(*get_body_and_goal(world))
    yield from expert.hold(world.state()[6], steps=100_000)


class Expert:
    def __init__(self, world):
        self.world, self.rotation = world, world.hand()[1]

    def go(self, position, gripper_position, near=0.03):
        while np.linalg.norm(position() - self.world.hand()[0]) > near:
            yield position(), self.rotation, gripper_position

    def hold(self, gripper_position, steps=8):
        yield from [(self.world.hand()[0], self.rotation, gripper_position)] * steps

    def turn(self, angle):
        self.rotation = Rotation.from_euler("z", angle) * self.rotation

    def pick_and_put(self, body, goal):
        position = self.world.data.body_xpos[body]  # a view, which follows the body
        yaw = Rotation.from_matrix(self.world.data.body_xmat[body].reshape(3, 3)).as_euler("zyx")[0]
        self.turn((yaw - self.rotation.as_euler("zyx")[0] + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        yield from self.go(lambda: position + ABOVE, 0.0)
        yield from self.go(lambda: position, 0.0, NEAR_M)
        yield from self.hold(1.0)
        lifted, hand = position + ABOVE, goal + self.world.hand()[0] - position
        yield from self.go(lambda: lifted, 1.0)
        if self.world.options.task != "Lift":
            yield from self.go(lambda: hand + ABOVE, 1.0)
            yield from self.go(lambda: hand, 1.0, NEAR_M)
            yield from self.hold(0.0)
            yield from self.go(lambda: hand + ABOVE, 0.0)

    def pull(self):
        """Move the closed fingers between the door and its handle, and pull."""
        data, env = self.world.data, self.world.env
        out = -data.body_xmat[env.object_body_ids["door"]].reshape(3, 3)[:, 1]
        behind = data.site_xpos[env.door_handle_site_id] - 0.045 * out
        self.turn(np.arctan2(out[1], out[0]) - np.pi)  # the wrist on the robot's side
        for position in (behind + ABOVE * 1.5 + 0.1 * out, behind + ABOVE * 1.2, behind, behind + 0.3 * out):
            yield from self.go(lambda position=position: position, 1.0)


def get_body_and_goal(world):
    """Return the body that the task moves, and its goal position in the world frame."""
    env, places = world.env, world.data.body_xpos
    if world.options.task == "Lift":
        height = env.model.mujoco_arena.table_offset[2] + 0.04
        return env.cube_body_id, np.maximum(places[env.cube_body_id], [-np.inf, -np.inf, height])
    if world.options.task == "Stack":
        return env.cubeA_body_id, places[env.cubeB_body_id] + [0.0, 0.0, 0.045]
    bin_position = env.target_bin_placements[env.object_to_id["can"]]
    return env.obj_body_id["Can"], np.add(bin_position, [-0.05, -0.05, 0.05])  # a point in the bin within reach


def compute_distance_m(world):
    """Return the distance of the moved body from its goal; for the door, the remaining path of its edge."""
    if world.options.task == "Door":
        return 0.4 * (0.3 - world.data.qpos[world.env.hinge_qpos_addr])
    body, goal = get_body_and_goal(world)
    return np.linalg.norm(goal - world.data.body_xpos[body])
