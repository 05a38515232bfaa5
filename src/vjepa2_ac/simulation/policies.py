"""Reference policies for a planner that use no images: zero actions, random actions, scripted experts."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.simulation.arm import Block, SimulatedArm, State, StepCallback
from vjepa2_ac.simulation.motion import Motion, MotionRecipe, OutOfReachError
from vjepa2_ac.simulation.rollout import Action, Image, Observation, Trial, set_scene, states_along
from vjepa2_ac.simulation.tasks import GRASP_M, RELEASED, TaskName, TaskProblem, make_problem
from vjepa2_ac.spaces import apply_action

_ROUNDING_MARGIN = 1 - 1e-9  # factor that keeps actions within a limit despite rounding


class ZeroActions:
    """Returns the zero action. Base class of the reference policies.

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
        return shorten_to_limits(self._change(observation), self._limits)

    def _change(self, observation: Observation) -> State:
        """Return the desired change of the state, before it is shortened to the limits."""
        return np.zeros_like(observation.state)


class RandomActions(ZeroActions):
    """Draws actions uniformly within the limits; the same trial gets the same actions.

    Args:
        limits: The allowed actions: `xyz`, `rotation` and `gripper` of each axis.
        seed: Seed of the actions, combined with that of the trial.
    """

    name, why = "random", "random"

    def __init__(self, limits: LimitsConfig, seed: int = 0) -> None:
        super().__init__(limits)
        self._seed = seed

    def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
        """Seed the generator for this trial."""
        self._rng = np.random.default_rng([self._seed, trial.seed])

    def _change(self, observation: Observation) -> State:
        return np.asarray(self._rng.uniform(-1.0, 1.0, size=len(observation.state)) * largest_action(self._limits))


class Oracle(ZeroActions):
    """A scripted policy that uses the goal state and the pose of the block, and moves as fast as the limits allow.

    It does not rotate the hand.
    """

    name, why = "oracle", "scripted"

    def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
        """Set the problem to solve.

        Raises:
            ValueError: The trial belongs to another environment than the simulated arm.
        """
        if trial.problem is None:
            raise ValueError(f"trial {trial.seed} has no problem of the simulated arm. Use the policy Expert")
        self._problem = trial.problem

    def _change(self, observation: Observation) -> State:
        script, state, block = _SCRIPTS.get(self._problem.task), observation.state, observation.block
        if script is None or block is None:
            return _reach_change(self._problem, state)
        return script(self._problem, state, block)


class Expert:
    """A policy that lets the scripted expert of an environment act."""

    name, why = "expert", "scripted"

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Start an episode."""

    def act(self, observation: Observation) -> Action | None:  # noqa: ARG002
        """Return None, with which the environment's expert acts."""
        return None


def largest_action(limits: LimitsConfig) -> Float[np.ndarray, " 7"]:
    """Return the largest absolute value of each number of an action; 0 if the number is fixed."""
    gripper = 0.0 if limits.gripper_mode == "held" else limits.gripper
    return np.array([*limits.xyz_m, *[limits.rotation] * 3, gripper])


def shorten_to_limits(change: Float[np.ndarray, " 7"], limits: LimitsConfig) -> Float[np.ndarray, " 7"]:
    """Shorten a change of the state to the limits of one model step, without changing its direction.

    Position, rotation and gripper are scaled independently. Fixed axes are set to zero.
    """
    reach = largest_action(limits)
    change = np.where(reach > 0, change, 0.0)
    for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
        beyond = np.abs(change[part]) / np.where(reach[part] > 0, reach[part], 1.0)
        change[part] *= min(1.0, _ROUNDING_MARGIN / max(float(beyond.max()), 1e-12))
    return change


_PUSH_M = 0.035  # longest step while pushing; a block that is hit faster keeps sliding
_NEAR_M = 0.006  # a block closer to its goal than this is not pushed
_OVER_M = 0.012  # the fingers close if the flange is closer to the grasp position than this
_CLEAR_M = 0.065  # height above the grasp position at which the fingers pass over the block
_PLACED_M, _LOW_M = 0.02, 0.01  # a block closer to the centre of the mark and to the table is released
_CARRY_M, _LIFTED_M = 0.08, 0.03  # height above the table of a carried block, and the lowest height for carrying
_TO_MARK_M = 0.03  # a block closer to the centre of the mark than this is lowered


def _reach_change(problem: TaskProblem, state: State) -> State:
    """Move straight to the goal."""
    change: np.ndarray = problem.goal - state
    change[3:6] = 0.0
    return change


def _push_change(problem: TaskProblem, state: State, block: Block) -> State:
    """Push the block along the line to its goal, with the gripper straight behind it."""
    goal, change = problem.ends[1, :2], np.zeros_like(state)
    direction = goal - problem.ends[0, :2]
    direction = direction / np.linalg.norm(direction)
    if (goal - block[:2]) @ direction < _NEAR_M:  # at the goal, or past it
        return change
    to_block = block[:2] - state[:2]
    sideways = to_block - direction * (to_block @ direction)
    ahead = direction * ((problem.goal[:2] - state[:2]) @ direction)
    change[:2], change[2], change[6] = ahead + sideways, problem.goal[2] - state[2], 1.0 - state[6]
    change[:3] *= min(1.0, _PUSH_M / float(np.linalg.norm(change[:3])))
    return change


def _pick_change(problem: TaskProblem, state: State, block: Block) -> State:
    """Grasp the block and lift it."""
    if not _holds(state, block):
        return _grasp_change(state, block)
    change = np.zeros_like(state)
    change[:3], change[6] = problem.goal[:3] - state[:3], 1.0 - state[6]  # lift, and keep closing
    return change


def _place_change(problem: TaskProblem, state: State, block: Block) -> State:
    """Grasp the block, carry it over the mark, put it down, open the gripper, and move up."""
    goal, change = problem.ends[1], np.zeros_like(state)
    to_goal = goal[:3] - block[:3]
    if np.linalg.norm(to_goal[:2]) < _PLACED_M and -to_goal[2] < _LOW_M:
        change[6] = -state[6]
        if state[6] < RELEASED:
            change[:3] = problem.goal[:3] - state[:3]
        return change
    if not _holds(state, block):
        return _grasp_change(state, block)
    change[:3], change[6] = to_goal, 1.0 - state[6]
    if np.linalg.norm(to_goal[:2]) > _TO_MARK_M:
        change[2] += _CARRY_M
        change[:2] *= float(block[2] - goal[2] > _LIFTED_M)  # lift first
    return change


_SCRIPTS: dict[TaskName, Callable[[TaskProblem, np.ndarray, np.ndarray], np.ndarray]] = {
    "push": _push_change,
    "pick": _pick_change,
    "place": _place_change,
}


def _to_grasp(state: State, block: Block) -> Float[np.ndarray, " 3"]:
    return np.asarray(block[:3] + np.array([0.0, 0.0, GRASP_M]) - state[:3])


def _holds(state: State, block: Block) -> bool:
    return bool(np.linalg.norm(_to_grasp(state, block)) < _OVER_M * 1.5 and state[6] > RELEASED)


def _grasp_change(state: State, block: Block) -> State:
    """Move over the block, down, and close the gripper."""
    change, to_grasp = np.zeros_like(state), _to_grasp(state, block)
    if np.linalg.norm(to_grasp) < _OVER_M:
        change[6] = 1.0 - state[6]
    else:
        change[:3], change[6] = to_grasp, -state[6]
        if np.linalg.norm(to_grasp[:2]) > _OVER_M:
            change[2] = max(change[2], min(0.0, change[2] + _CLEAR_M))  # stays above the block while moving over it
    return change


# ---- demonstrations with a block: the oracle with noise, or random play ----

_NOISE_M = 0.008  # standard deviation of the noise on each axis of an oracle's action
_LOWEST_M, _HIGHEST_M = 0.155, 0.34  # bounds of the flange's height during random play
_TO_BLOCK = 0.5  # probability that an action of random play goes to the block, or through it
_AREA = np.array([[0.30, -0.28], [0.64, 0.28]])  # bounds of the flange's (x, y) during random play, in the world


def play(
    arm: SimulatedArm,
    task: TaskName,
    steps: int,
    rng: np.random.Generator,
    *,
    script: bool,
    on_step: StepCallback | None = None,
) -> Motion:
    """Carry out a demonstration of `steps` control steps with a block, and return its motion.

    Afterwards arm and block are in the state in which control step `steps` would be measured. A shorter demonstration
    equals the beginning of a longer one.

    Args:
        arm: The arm from `arm_for` for this task.
        task: A task with a block. It determines the start, and whether the gripper is used.
        steps: Number of control steps; 0: only set the start.
        rng: The only source of randomness.
        script: Whether an oracle with noise solves the problem; otherwise actions are random play.
        on_step: Called with the arm at every control step.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    recipe = MotionRecipe()
    problem = make_problem(task, arm.domain, int(rng.integers(2**31)), 0)
    limits = LimitsConfig(xyz=(recipe.reach_m,) * 3)
    oracle, unseen = Oracle(limits), np.zeros((1, 1, 3), dtype=np.uint8)
    set_scene(arm, problem.start, problem.block_start, problem.mark)
    oracle.reset(Trial(0, steps, recipe.stride, problem), unseen)
    motion = Motion(np.empty((steps, 7)), np.empty(steps), np.empty((steps, 7)), np.empty(steps))
    joints, grip = arm.joints, float(problem.start[6])
    for step in range(steps):
        if step % recipe.stride == 0:
            if script:
                noise = np.append(rng.normal(0.0, _NOISE_M, size=3), np.zeros(4))
                action = shorten_to_limits(oracle.act(Observation(unseen, arm.state, arm.block)) + noise, limits)
            else:
                action = _play_action(arm, problem, limits, rng)
            joints, grip = _command_of(arm, action)
        motion.commanded_joints[step], motion.commanded_gripper[step] = joints, grip
        motion.joints[step], motion.gripper[step] = arm.joints, arm.gripper_position
        if on_step:
            on_step(arm)
        arm.command_joints(joints, grip)
    return motion


def _play_action(arm: SimulatedArm, problem: TaskProblem, limits: LimitsConfig, rng: np.random.Generator) -> np.ndarray:
    """Return a random action, towards or through the block or anywhere; except for `push` the gripper may move, too."""
    state, block = arm.state, arm.block
    if block is None:
        raise ValueError("there is no block to play with")
    turn = arm.domain.base_pose()[:3, :3]
    change = np.zeros(ACTION_DIM)
    if rng.uniform() < _TO_BLOCK:
        height = GRASP_M if problem.task != "push" else problem.goal[2] - block[2]
        change[:3] = block[:3] - state[:3] + np.append(rng.normal(0.0, 0.03, size=2), height)
        change[:2] *= rng.uniform(0.6, 1.8)
    else:
        change[:3] = rng.uniform(-1.0, 1.0, size=3) * limits.xyz_m
    if problem.task != "push" and rng.uniform() < 0.25:
        change[6] = rng.choice([-1.0, 1.0]) * limits.gripper
    change = shorten_to_limits(change, limits)
    target = turn @ (state[:3] + change[:3])
    low, high = np.append(_AREA[0], _LOWEST_M), np.append(_AREA[1], _HIGHEST_M)
    change[:3] = turn.T @ np.clip(target, low, high) - state[:3]
    return shorten_to_limits(change, limits)


def _command_of(arm: SimulatedArm, action: Float[np.ndarray, " 7"]) -> tuple[np.ndarray, float]:
    """Return the commanded joints and gripper position for an action, or for its largest reachable part."""
    joints, target = arm.joints, apply_action(arm.state, action)
    for state in [target, *reversed(states_along(arm.state, action)[:-1])]:
        with suppress(OutOfReachError):
            joints = arm.joints_for(state)
            break
    return joints, float(np.clip(target[6], 0.0, 1.0))
