"""The scripted expert of libero.py: it knows where things are, and yields what the hand is to do next, without end.

A target is a pose of the grip site in the frame of the robot's base, with a closedness. Things are grasped from above:
what is too wide for the fingers, such as a bowl, at its rim, where the gripper meets the fewest other things.
"""

import numpy as np
from scipy.spatial.transform import Rotation

CLEAR_M, NEAR_M = 0.10, 0.012  # height of what is carried over what it passes; closer than this it is there
FIT_M = 0.07  # the fingers hold no wider thing
WALL_M, DEEP_M, LOW_M = 0.015, 0.032, 0.011  # from the grip site to a rim, a top, what a thing lies on
DOWN = Rotation.from_euler("xyz", [np.pi, 0.0, np.pi / 2])  # the fingers close along y
SIDES = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
GRIPPER = np.array([[x, y, z] for x in np.linspace(-0.1, 0.1, 9) for y in (-0.03, 0.0, 0.03) for z in (-0.11, -0.03)]
                   + [[x, y, z] for x in (-0.064, -0.05, -0.04, 0.04, 0.05, 0.064) for y in (-0.01, 0.01)
                      for z in (-0.03, -0.01, 0.01)])  # fmt: skip
AHEAD_M = 0.05  # how far down a target is while something is lowered until it rests


def expert_of(world):
    return Expert(world).scripted()


def has_expert(world):
    """Return whether it is all pick and place: something movable, to a place that need not be opened first."""
    sites = world.env.object_sites_dict
    return all(
        len(goal) == 3 and goal[1] in world.env.objects_dict and not (goal[2] in sites and sites[goal[2]].joints)
        for goal in world.goals
    )


def left_m(world):
    """Return the distance that is left, summed over the goals; of joints radians where they turn."""
    return sum(_left_of(world, *goal) for goal in world.goals)


def _left_of(world, verb, name, target=None):
    if target:
        return np.linalg.norm(world.at(name) - world.at(target))
    site = world.env.object_sites_dict.get(name)
    thing = world.env.get_object(site.parent_name if site else name)
    low, high = thing.object_properties["articulation"][f"default_{verb}_ranges"]
    return min(max(low - at, at - high, 0.0) for at in map(world.sim.data.get_joint_qpos, (site or thing).joints))


class Expert:
    def __init__(self, world):
        self.world, self.turned = world, world.state()[3:6]

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
                if self.corners(name)[:, 2].min() > low + 0.03:  # it is held
                    yield from self.put(name, rest, falls=site is None)
        self.turned = self.world.state()[3:6]
        yield from self.grip(self.world.state()[6] > 0.1, steps=10_000)

    def corners(self, name):
        """Corners of the boxes around the parts of a thing."""
        model, data = self.world.sim.model, self.world.sim.data
        of_it = model.body_rootid[model.geom_bodyid] == self.world.env.obj_body_id[name]
        parts = np.flatnonzero(of_it & (model.geom_group == 0))
        boxes, turns = model.geom_aabb[parts, None], data.geom_xmat[parts].reshape(-1, 3, 3)
        turned = np.einsum("pij,pcj->pci", turns, boxes[..., :3] + SIDES * boxes[..., 3:])
        return (turned + data.geom_xpos[parts, None]).reshape(-1, 3) - self.world.base()

    def touched(self, points):
        """How many of the points are in things or near them: the walls of LIBERO's furniture are thin."""
        model, data = self.world.sim.model, self.world.sim.data
        robot = model.body_rootid[model.body_name2id("robot0_base")]
        parts = np.flatnonzero((model.geom_group == 0) & (model.body_rootid[model.geom_bodyid] != robot))
        turns, places = data.geom_xmat[parts].reshape(-1, 3, 3), data.geom_xpos[parts, None] - self.world.base()
        local = np.einsum("pji,pcj->pci", turns, points - places) - model.geom_aabb[parts, None, :3]
        return (np.abs(local) < model.geom_aabb[parts, None, 3:] + NEAR_M).all(-1).any(0).sum()

    def go(self, where, closedness, near=NEAR_M, most=60):
        """Yield the target pose until the hand is there or comes no further; what is to be reached may move."""
        hands = []
        for _ in range(most):
            hands.append(self.world.state()[:3])
            is_stuck = len(hands) > 5 and np.ptp(hands[-5:], axis=0).max() < 0.003
            if is_stuck or np.linalg.norm(where() - hands[-1]) < near:
                break
            yield np.array([*where(), *self.turned, closedness])

    def grip(self, closedness, steps=8):
        still = self.world.state()
        for _ in range(steps):
            yield np.array([*still[:3], *self.turned, closedness])

    def grasp(self, name, carry):
        """Where and how turned the open fingers, from above, come between the fewest things, here and on the way."""
        corners, choices = self.corners(name), []
        low, high = corners.min(axis=0)[2], corners.max(axis=0)[2]
        high_m = max(0.0, carry[2]) + CLEAR_M
        way = [np.zeros(3), carry, *([*(share * carry[:2]), high_m] for share in np.linspace(0.0, 1.0, 5))]
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
                hits = self.touched((turn.apply(GRIPPER) + place + np.array(way)[:, None]).reshape(-1, 3))
                choices.append((hits + effort + abs(degrees) / 30, *place, *turn.as_euler("xyz")))
        return np.split(np.array(min(choices)[1:]), 2)

    def pick(self, name, rest):
        """Grasp a thing and lift it over where it is to rest."""
        above, before = np.array([0.0, 0.0, CLEAR_M]), self.world.at(name)
        place, self.turned = self.grasp(name, rest - before)
        yield from self.go(lambda: place + above, 0.0)
        yield from self.go(lambda: place, 0.0, near=0.005)
        yield from self.grip(1.0)
        lifted = place + above * (1.0 + max(0.0, rest[2] - before[2]) / CLEAR_M)
        yield from self.go(lambda: lifted, 1.0)

    def put(self, name, rest, falls):
        """Carry what is held over where it is to rest, lower it, as far as it goes if it is not to fall, and leave."""
        above, low = np.array([0.0, 0.0, CLEAR_M]), rest - [0.0, 0.0, 0.0 if falls else 1.0]
        yield from self.go(lambda: self.world.state()[:3] + rest + above - self.world.at(name), 1.0)
        yield from self.go(lambda: self.world.state()[:3] + np.maximum(low - self.world.at(name), -AHEAD_M), 1.0)
        yield from self.grip(0.0)
        left = self.world.state()[:3] + above
        yield from self.go(lambda: left, 0.0)
