"""References for a planner, which look at no image: zero actions, random actions, and oracles."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.simulation.arm import Block, Look, SimulatedArm, State
from vjepa2_ac.simulation.motion import Motion, MotionRecipe, OutOfReachError
from vjepa2_ac.simulation.rollout import Action, Image, Observation, Trial, put, states_along
from vjepa2_ac.simulation.tasks import GRASP_M, RELEASED, TaskName, TaskProblem, make_problem
from vjepa2_ac.spaces import apply_action

_ALMOST = 1 - 1e-9  # of a limit: rounding must not exceed it


class ZeroActions:
    """Does not move the arm. Base class of the references.

    Args:
        limits: The allowed actions.
    """

    name, why = "zero action", "nothing"

    def __init__(self, limits: LimitsConfig | None = None) -> None:
        self._limits = limits or LimitsConfig()

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Start an episode."""

    def act(self, observation: Observation) -> State:
        """Return the next action, within the limits."""
        return shortened(self._way(observation), self._limits)

    def _way(self, observation: Observation) -> State:
        """Return the action before it is shortened."""
        return np.zeros_like(observation.state)


class RandomActions(ZeroActions):
    """Draws actions uniformly from the allowed ones; the same trial gets the same actions.

    Args:
        limits: The allowed actions: `xyz`, `rotation` and `gripper` of each axis.
        seed: Of the actions, with that of the trial.
    """

    name, why = "random", "random"

    def __init__(self, limits: LimitsConfig, seed: int = 0) -> None:
        super().__init__(limits)
        self._seed = seed

    def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
        """Seed the generator for this trial."""
        self._rng = np.random.default_rng([self._seed, trial.seed])

    def _way(self, observation: Observation) -> State:
        return np.asarray(self._rng.uniform(-1.0, 1.0, size=len(observation.state)) * farthest(self._limits))


class Oracle(ZeroActions):
    """Knows the goal state and observes the block, and does a task of the simulated arm as fast as allowed.

    It does not rotate.
    """

    name, why = "oracle", "scripted"

    def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
        """Set the goal.

        Raises:
            ValueError: It is a trial of another environment.
        """
        if trial.problem is None:
            raise ValueError(f"trial {trial.seed} is none of the simulated arm: use Expert")
        self._problem = trial.problem

    def _way(self, observation: Observation) -> State:
        way, state, block = _WAYS.get(self._problem.task), observation.state, observation.block
        return _reach_way(self._problem, state) if way is None or block is None else way(self._problem, state, block)


class Expert:
    """Lets the scripted expert of an environment act."""

    name, why = "expert", "scripted"

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Start an episode."""

    def act(self, observation: Observation) -> Action | None:  # noqa: ARG002
        """Leave the action to the environment."""
        return None


def farthest(limits: LimitsConfig) -> Float[np.ndarray, " 7"]:
    """Return the largest size of each component of an action; 0 where it is fixed."""
    gripper = 0.0 if limits.gripper_mode == "held" else limits.gripper
    return np.array([*limits.xyz_m, *[limits.rotation] * 3, gripper])


def shortened(way: Float[np.ndarray, " 7"], limits: LimitsConfig) -> Float[np.ndarray, " 7"]:
    """Return the displacement of a model step, in its direction, clipped to the limits.

    Position, rotation and gripper are scaled independently; a fixed axis is left out.
    """
    reach = farthest(limits)
    way = np.where(reach > 0, way, 0.0)
    for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
        beyond = np.abs(way[part]) / np.where(reach[part] > 0, reach[part], 1.0)
        way[part] *= min(1.0, _ALMOST / max(float(beyond.max()), 1e-12))
    return way


_PUSH_M = 0.035  # per model step: a block that is hit faster slides on
_NEAR_M = 0.006  # a block closer to its goal is not moved
_OVER_M = 0.012  # closer to the place of the grasp than this, fingers can close
_CLEAR_M = 0.065  # above the place of the grasp, fingers pass over the block
_PLACED_M, _LOW_M = 0.02, 0.01  # a block that is closer to the mark's middle and to the table is let go
_CARRY_M, _LIFTED_M = 0.08, 0.03  # height over the table of a carried block, and the least before it is carried
_TO_MARK_M = 0.03  # a block that is closer to the mark's middle goes down


def _reach_way(problem: TaskProblem, state: State) -> State:
    """Straight to the goal."""
    way: np.ndarray = problem.goal - state
    way[3:6] = 0.0
    return way


def _push_way(problem: TaskProblem, state: State, block: Block) -> State:
    """Push the block along the line to its goal: forwards, straight behind the block."""
    goal, way = problem.ends[1, :2], np.zeros_like(state)
    direction = goal - problem.ends[0, :2]
    direction = direction / np.linalg.norm(direction)
    if (goal - block[:2]) @ direction < _NEAR_M:  # the rest is too short, or it slid past
        return way
    to_block = block[:2] - state[:2]
    beside = to_block - direction * (to_block @ direction)
    ahead = direction * ((problem.goal[:2] - state[:2]) @ direction)
    way[:2], way[2], way[6] = ahead + beside, problem.goal[2] - state[2], 1.0 - state[6]
    way[:3] *= min(1.0, _PUSH_M / float(np.linalg.norm(way[:3])))
    return way


def _pick_way(problem: TaskProblem, state: State, block: Block) -> State:
    """Move over the block, down, close, and lift."""
    if not _holds(state, block):
        return _grasp_way(state, block)
    way = np.zeros_like(state)
    way[:3], way[6] = problem.goal[:3] - state[:3], 1.0 - state[6]  # lift, and keep closing
    return way


def _place_way(problem: TaskProblem, state: State, block: Block) -> State:
    """Pick the block up, carry it over the mark, put it down, open, and move up."""
    goal, way = problem.ends[1], np.zeros_like(state)
    to_goal = goal[:3] - block[:3]
    if np.linalg.norm(to_goal[:2]) < _PLACED_M and -to_goal[2] < _LOW_M:
        way[6] = -state[6]
        if state[6] < RELEASED:
            way[:3] = problem.goal[:3] - state[:3]
        return way
    if not _holds(state, block):
        return _grasp_way(state, block)
    way[:3], way[6] = to_goal, 1.0 - state[6]
    if np.linalg.norm(to_goal[:2]) > _TO_MARK_M:
        way[2] += _CARRY_M
        way[:2] *= float(block[2] - goal[2] > _LIFTED_M)  # first up
    return way


_WAYS: dict[TaskName, Callable[[TaskProblem, np.ndarray, np.ndarray], np.ndarray]] = {
    "push": _push_way,
    "pick": _pick_way,
    "place": _place_way,
}


def _to_grasp(state: State, block: Block) -> Float[np.ndarray, " 3"]:
    return np.asarray(block[:3] + np.array([0.0, 0.0, GRASP_M]) - state[:3])


def _holds(state: State, block: Block) -> bool:
    return bool(np.linalg.norm(_to_grasp(state, block)) < _OVER_M * 1.5 and state[6] > RELEASED)


def _grasp_way(state: State, block: Block) -> State:
    """Move over the block, down, and close."""
    way, to_place = np.zeros_like(state), _to_grasp(state, block)
    if np.linalg.norm(to_place) < _OVER_M:
        way[6] = 1.0 - state[6]
    else:
        way[:3], way[6] = to_place, -state[6]
        if np.linalg.norm(to_place[:2]) > _OVER_M:
            way[2] = max(way[2], min(0.0, way[2] + _CLEAR_M))  # not down on the block's edge
    return way


# ---- demonstrations with a block: the oracle with noise, or random play ----

_NOISE_M = 0.008  # standard deviation of the noise on each axis of an oracle's step
_LOWEST_M, _HIGHEST_M = 0.155, 0.34  # of the flange while playing
_TO_BLOCK = 0.5  # probability that a step of play goes to the block, or through it
_AREA = np.array([[0.30, -0.28], [0.64, 0.28]])  # of the flange while playing, in the world


def play(
    arm: SimulatedArm, task: TaskName, steps: int, rng: np.random.Generator, *, script: bool, look: Look | None = None
) -> Motion:
    """Return a demonstration of `steps` control steps with an arm that touches the block.

    Afterwards arm and block are where control step `steps` would be measured; fewer steps are the beginning of more.

    Args:
        arm: From `arm_for` of this task.
        task: One with a block: the problem at the start, and whether the gripper is used.
        steps: Control steps; 0: only the start is drawn.
        rng: The only source of randomness.
        script: Whether an oracle solves the problem, with noise; otherwise, random play.
        look: Called with the arm.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    recipe = MotionRecipe()
    problem = make_problem(task, arm.domain, int(rng.integers(2**31)), 0)
    limits = LimitsConfig(xyz=(recipe.reach_m,) * 3)
    oracle, unseen = Oracle(limits), np.zeros((1, 1, 3), dtype=np.uint8)
    put(arm, problem.start, problem.block_start, problem.mark)
    oracle.reset(Trial(0, steps, recipe.stride, problem), unseen)
    motion = Motion(np.empty((steps, 7)), np.empty(steps), np.empty((steps, 7)), np.empty(steps))
    joints, grip = arm.joints, float(problem.start[6])
    for step in range(steps):
        if step % recipe.stride == 0:
            if script:
                noise = np.append(rng.normal(0.0, _NOISE_M, size=3), np.zeros(4))
                action = shortened(oracle.act(Observation(unseen, arm.state, arm.block)) + noise, limits)
            else:
                action = _play_action(arm, problem, limits, rng)
            joints, grip = _sent(arm, action)
        motion.commanded_joints[step], motion.commanded_gripper[step] = joints, grip
        motion.joints[step], motion.gripper[step] = arm.joints, arm.closedness
        if look:
            look(arm)
        arm.command_joints(joints, grip)
    return motion


def _play_action(arm: SimulatedArm, problem: TaskProblem, limits: LimitsConfig, rng: np.random.Generator) -> np.ndarray:
    """Return a step to or through the block, or anywhere; but for `push`, sometimes the gripper opens or closes."""
    state, block = arm.state, arm.block
    if block is None:
        raise ValueError("there is no block to play with")
    turn = arm.domain.base_pose()[:3, :3]
    way = np.zeros(ACTION_DIM)
    if rng.uniform() < _TO_BLOCK:
        height = GRASP_M if problem.task != "push" else problem.goal[2] - block[2]
        way[:3] = block[:3] - state[:3] + np.append(rng.normal(0.0, 0.03, size=2), height)
        way[:2] *= rng.uniform(0.6, 1.8)
    else:
        way[:3] = rng.uniform(-1.0, 1.0, size=3) * limits.xyz_m
    if problem.task != "push" and rng.uniform() < 0.25:
        way[6] = rng.choice([-1.0, 1.0]) * limits.gripper
    way = shortened(way, limits)
    place = turn @ (state[:3] + way[:3])
    low, high = np.append(_AREA[0], _LOWEST_M), np.append(_AREA[1], _HIGHEST_M)
    way[:3] = turn.T @ np.clip(place, low, high) - state[:3]
    return shortened(way, limits)


def _sent(arm: SimulatedArm, action: Float[np.ndarray, " 7"]) -> tuple[np.ndarray, float]:
    """Return the joints and closedness of a step's command, as far along it as joint angles exist."""
    joints, target = arm.joints, apply_action(arm.state, action)
    for way in [target, *reversed(states_along(arm.state, action)[:-1])]:
        with suppress(OutOfReachError):
            joints = arm.joints_for(way)
            break
    return joints, float(np.clip(target[6], 0.0, 1.0))
