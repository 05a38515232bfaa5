"""The scripted expert of libero.py, which uses the true positions of objects and yields targets without end.

A target is a pose of the grip site in the frame of the robot's base, and a gripper position. Objects are grasped from
above. An object that is too wide for the fingers, such as a bowl, is grasped at its rim, where the gripper has the
fewest collisions.
"""

import numpy as np
from scipy.spatial.transform import Rotation

CLEAR_M, NEAR_M = 0.10, 0.012  # height of a carried object over others; distance below which a target is reached
FIT_M = 0.07  # largest width of an object between the fingers
WALL_M, DEEP_M, LOW_M = 0.015, 0.032, 0.011  # distances of the grip site from a rim, from the top, from the support
DOWN = Rotation.from_euler("xyz", [np.pi, 0.0, np.pi / 2])  # the fingers close along y
SIDES = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
GRIPPER = np.array([[x, y, z] for x in np.linspace(-0.1, 0.1, 9) for y in (-0.03, 0.0, 0.03) for z in (-0.11, -0.03)]
                   + [[x, y, z] for x in (-0.064, -0.05, -0.04, 0.04, 0.05, 0.064) for y in (-0.01, 0.01)
                      for z in (-0.03, -0.01, 0.01)])  # fmt: skip
AHEAD_M = 0.05  # largest distance of a target below an object that is lowered until it rests


def make_script(world):
    return Expert(world).scripted()


def has_expert(world):
    """Return whether all goals are pick and place of movable objects, to targets that need not be opened first."""
    sites = world.env.object_sites_dict
    return all(
        len(goal) == 3 and goal[1] in world.env.objects_dict and not (goal[2] in sites and sites[goal[2]].joints)
        for goal in world.goals
    )


def compute_distance_m(world):
    """Return the sum of the distances to all goals; for hinges, radians are added to metres."""
    return sum(_distance_to(world, *goal) for goal in world.goals)


def _distance_to(world, verb, name, target=None):
    if target:
        return np.linalg.norm(world.at(name) - world.at(target))
    site = world.env.object_sites_dict.get(name)
    item = world.env.get_object(site.parent_name if site else name)
    low, high = item.object_properties["articulation"][f"default_{verb}_ranges"]
    positions = map(world.sim.data.get_joint_qpos, (site or item).joints)
    return min(max(low - position, position - high, 0.0) for position in positions)


class Expert:
    def __init__(self, world):
        self.world, self.rotation = world, world.state()[3:6]

    def scripted(self):
        for goal in self.world.goals:
            while not self.world.env._eval_predicate(goal):
                (_, name, target), env = goal, self.world.env
                site = env.object_sites_dict.get(target)
                under = site.parent_name if site else target
                top = self.corners(under)[:, 2].max() if under in env.obj_body_id else self.world.at(target)[2]
                low = self.corners(name)[:, 2].min()
                rest = np.array([*self.world.at(target)[:2], top + self.world.at(name)[2] - low])
                yield from self.pick(name, rest)
                if self.corners(name)[:, 2].min() > low + 0.03:  # the grasp succeeded
                    yield from self.put(name, rest, falls=site is None)
        self.rotation = self.world.state()[3:6]
        yield from self.grip(self.world.state()[6] > 0.1, steps=10_000)

    def corners(self, name):
        """Return the corners of the bounding boxes of an object's parts."""
        model, data = self.world.sim.model, self.world.sim.data
        is_part = model.body_rootid[model.geom_bodyid] == self.world.env.obj_body_id[name]
        parts = np.flatnonzero(is_part & (model.geom_group == 0))
        boxes, turns = model.geom_aabb[parts, None], data.geom_xmat[parts].reshape(-1, 3, 3)
        turned = np.einsum("pij,pcj->pci", turns, boxes[..., :3] + SIDES * boxes[..., 3:])
        return (turned + data.geom_xpos[parts, None]).reshape(-1, 3) - self.world.base()

    def count_hits(self, points):
        """Return how many points are inside objects or near them, because the walls of LIBERO's furniture are thin."""
        model, data = self.world.sim.model, self.world.sim.data
        robot = model.body_rootid[model.body_name2id("robot0_base")]
        parts = np.flatnonzero((model.geom_group == 0) & (model.body_rootid[model.geom_bodyid] != robot))
        turns, places = data.geom_xmat[parts].reshape(-1, 3, 3), data.geom_xpos[parts, None] - self.world.base()
        local = np.einsum("pji,pcj->pci", turns, points - places) - model.geom_aabb[parts, None, :3]
        return (np.abs(local) < model.geom_aabb[parts, None, 3:] + NEAR_M).all(-1).any(0).sum()

    def go(self, position, gripper_position, near=NEAR_M, max_steps=60):
        """Yield targets until the hand is at `position()`, which may change, or does not move any more."""
        hands = []
        for _ in range(max_steps):
            hands.append(self.world.state()[:3])
            is_stuck = len(hands) > 5 and np.ptp(hands[-5:], axis=0).max() < 0.003
            if is_stuck or np.linalg.norm(position() - hands[-1]) < near:
                break
            yield np.array([*position(), *self.rotation, gripper_position])

    def grip(self, gripper_position, steps=8):
        state = self.world.state()
        for _ in range(steps):
            yield np.array([*state[:3], *self.rotation, gripper_position])

    def grasp(self, name, carry):
        """Return the position and rotation of a grasp from above with the fewest collisions, also on the way.

        Args:
            name: The object.
            carry: The displacement of the object after the grasp.
        """
        corners, choices = self.corners(name), []
        low, high = corners.min(axis=0)[2], corners.max(axis=0)[2]
        high_m = max(0.0, carry[2]) + CLEAR_M
        path = [np.zeros(3), carry, *([*(share * carry[:2]), high_m] for share in np.linspace(0.0, 1.0, 5))]
        for degrees in range(-90, 91, 15):
            turn = Rotation.from_euler("z", degrees, degrees=True) * DOWN
            local = turn.inv().apply(corners)
            first, last = local.min(axis=0), local.max(axis=0)
            middle = (first + last) / 2
            rims = [first[0] + WALL_M, last[0] - WALL_M]
            width = last[0] - first[0]
            for along, effort in [(middle[0], 100 * width)] if width < FIT_M else [(rim, 20) for rim in rims]:
                place = turn.apply([along, middle[1], 0.0])
                place[2] = max(high - DEEP_M, low + LOW_M)
                hits = self.count_hits((turn.apply(GRIPPER) + place + np.array(path)[:, None]).reshape(-1, 3))
                choices.append((hits + effort + abs(degrees) / 30, *place, *turn.as_euler("xyz")))
        return np.split(np.array(min(choices)[1:]), 2)

    def pick(self, name, rest):
        """Grasp an object and lift it above the height of `rest`, the position where it will be put down."""
        above, before = np.array([0.0, 0.0, CLEAR_M]), self.world.at(name)
        place, self.rotation = self.grasp(name, rest - before)
        yield from self.go(lambda: place + above, 0.0)
        yield from self.go(lambda: place, 0.0, near=0.005)
        yield from self.grip(1.0)
        lifted = place + above * (1.0 + max(0.0, rest[2] - before[2]) / CLEAR_M)
        yield from self.go(lambda: lifted, 1.0)

    def put(self, name, rest, falls):
        """Carry the object above its rest position, lower it (until it rests, unless `falls`), and release it."""
        above, low = np.array([0.0, 0.0, CLEAR_M]), rest - [0.0, 0.0, 0.0 if falls else 1.0]
        yield from self.go(lambda: self.world.state()[:3] + rest + above - self.world.at(name), 1.0)
        yield from self.go(lambda: self.world.state()[:3] + np.maximum(low - self.world.at(name), -AHEAD_M), 1.0)
        yield from self.grip(0.0)
        retreat = self.world.state()[:3] + above
        yield from self.go(lambda: retreat, 0.0)
