"""Demonstrations: what an episode of a recording is, and what the arm does in it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.geometry import apply_action
from vjepa2_ac.simulation.closed_loop.policies import oracle_for, shortened
from vjepa2_ac.simulation.closed_loop.rollout import put, ways_along
from vjepa2_ac.simulation.closed_loop.tasks import GRASP_M, TaskProblem, make_problem
from vjepa2_ac.simulation.world.arm import SimulatedArm
from vjepa2_ac.simulation.world.domains import Domain, DomainRanges, named_domain, sample_domain
from vjepa2_ac.simulation.world.motion import Motion, MotionRecipe, OutOfReachError, random_reaching

RecordedTask = Literal["push", "pick", "place"]

INSTRUCTIONS: dict[RecordedTask | None, str] = {
    None: "reach around over the table",
    "push": "push the block",
    "pick": "pick up the block",
    "place": "put the block on the mark",
}
"""Language instruction of an episode; None: random reaching, without a block."""


def default_steps(task: RecordedTask | None) -> int:
    """Return the control steps of an episode, enough for its task: the script of `place` releases the block late."""
    return 81 if task == "place" else 41


_NOISE_M = 0.008  # standard deviation of the noise on each axis of an oracle's step
_LOWEST_M, _HIGHEST_M = 0.155, 0.34  # of the flange while playing
_TO_BLOCK = 0.5  # probability that a step of play goes to the block, or through it
_AREA = np.array([[0.30, -0.28], [0.64, 0.28]])  # of the flange while playing, in the world


def play(
    arm: SimulatedArm,
    task: RecordedTask,
    steps: int,
    rng: np.random.Generator,
    *,
    script: bool,
    look: Callable[[SimulatedArm], None] | None = None,
) -> Motion:
    """Return a demonstration of `steps` control steps with an arm that touches the block.

    Afterwards arm and block are where control step `steps` would be measured; fewer steps are the beginning of more.

    Args:
        arm: From `arm_for` of this task.
        task: The problem at the start, and whether the gripper is used.
        steps: Control steps; 0: only the start is drawn.
        rng: The only source of randomness.
        script: Whether an oracle solves the problem, with noise; otherwise, random play.
        look: Called at every control step, at the time of its measurements.

    Raises:
        InputError: MuJoCo or OpenGL is missing.
    """
    recipe = MotionRecipe()
    problem = make_problem(task, arm.domain, int(rng.integers(2**31)), 0)
    limits = LimitsConfig(xyz=(recipe.reach_m,) * 3)
    oracle = oracle_for(task, limits, arm)
    put(arm, problem.start, problem.block_start, problem.mark)
    unseen = np.zeros((1, 1, 3), dtype=np.uint8)
    oracle.reset(problem, unseen)
    rows: list[tuple[np.ndarray, float, np.ndarray, float]] = []
    joints, grip = arm.joints, float(problem.start[6])
    for step in range(steps):
        if step % recipe.stride == 0:
            if script:
                exact = oracle.act(unseen, arm.state)
                noise = np.append(rng.normal(0.0, _NOISE_M, size=3), np.zeros(4))
                action = shortened(exact + noise, limits)
            else:
                action = _play_action(arm, problem, limits, rng)
            joints, grip = _sent(arm, action)
        rows.append((joints, grip, arm.joints, arm.closedness))
        if look:
            look(arm)
        arm.command_joints(joints, grip)
    commanded, commanded_grip, measured, measured_grip = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Motion(
        np.reshape(commanded, (-1, 7)),
        np.array(commanded_grip),
        np.reshape(measured, (-1, 7)),
        np.array(measured_grip),
    )


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
    for way in [target, *reversed(ways_along(arm.state, action)[:-1])]:
        with suppress(OutOfReachError):
            joints = arm.joints_for(way)
            break
    return joints, float(np.clip(target[6], 0.0, 1.0))


SUCCESS_SHARE = 0.9

_MOTION, _WORLD, _SUCCESS = range(3)  # random streams of an episode


@dataclass(frozen=True)
class RecordingSpec:
    """What an episode of a simulated data set is."""

    domain: str | Domain | DomainRanges  # or its name; ranges, or `random`: another world in every episode
    steps: int = 41  # control steps (15 per second); see `default_steps`
    seed: int = 0  # determines motion, outcome and worlds
    cameras: Literal[1, 3] = 1  # 1: the three images of a step are the same one; 3: one image per camera
    recipe: MotionRecipe | None = None  # ranges of the motion, without a task
    task: RecordedTask | None = None  # with a block: half of the episodes by script, half at random

    @property
    def worlds(self) -> Domain | DomainRanges:
        """The world of all episodes, or the ranges to draw each one's from.

        Raises:
            InputError: No domain has this name.
        """
        if not isinstance(self.domain, str):
            return self.domain
        return DomainRanges() if self.domain == "random" else named_domain(self.domain)


def world_of(index: int, spec: RecordingSpec) -> Domain:
    """Return the world of an episode.

    Raises:
        InputError: No domain has this name.
    """
    worlds = spec.worlds
    return worlds if isinstance(worlds, Domain) else sample_domain(_stream(index, spec, _WORLD), worlds)


def arm_of(index: int, spec: RecordingSpec) -> SimulatedArm:
    """Return an arm in the world of an episode; with a task it has contacts.

    Raises:
        InputError: MuJoCo or OpenGL is missing, or an unknown domain.
    """
    world = world_of(index, spec)
    if spec.task is None:
        return SimulatedArm(world)
    from vjepa2_ac.simulation.closed_loop.tasks import arm_for  # it imports torch, which random reaching does not need

    return arm_for(spec.task, world)


def carry_out(
    arm: SimulatedArm, index: int, spec: RecordingSpec, *, look: Callable[[SimulatedArm], None] | None = None
) -> Motion:
    """Carry out an episode, and return its motion.

    Args:
        arm: From `arm_of`; its pose does not matter.
        index: Number of the episode.
        spec: What an episode is.
        look: Called at every control step, at the time of its measurements.
    """
    rng = _stream(index, spec, _MOTION)
    if spec.task is not None:
        from vjepa2_ac.simulation.recording.demonstration import play

        return play(arm, spec.task, spec.steps, rng, script=index % 2 == 0, look=look)
    motion = random_reaching(arm.domain, spec.steps, rng, spec.recipe)
    for joints, closedness in zip(motion.joints, motion.gripper, strict=True):
        arm.set_joints(joints, float(closedness))
        if look:
            look(arm)
    return motion


def put_at(arm: SimulatedArm, index: int, spec: RecordingSpec, step: int) -> SimulatedArm:
    """Bring arm and block to a control step of an episode, as they were when it was measured.

    Args:
        arm: From `arm_of`; its pose does not matter.
        index: Number of the episode.
        spec: What an episode is.
        step: From 0 to the episode's last.
    """
    rng = _stream(index, spec, _MOTION)
    if spec.task is not None:  # contacts depend on all that happened before
        from vjepa2_ac.simulation.recording.demonstration import play

        play(arm, spec.task, step, rng, script=index % 2 == 0)
        return arm
    motion = random_reaching(arm.domain, spec.steps, rng, spec.recipe)
    arm.set_joints(motion.joints[step], float(motion.gripper[step]))
    return arm


def episode_folder(index: int, seed: int, domain_name: str) -> str:
    """Return the source folder stored in the episode; as in DROID, the only record of success or failure."""
    succeeded = np.random.default_rng([seed, index, _SUCCESS]).uniform() < SUCCESS_SHARE
    minute, hour, day = index % 60, index // 60 % 24, 1 + index // 1440 % 28
    place = f"{domain_name}_seed{seed}_{hour:02d}h{minute:02d}_{index:06d}"
    return f"/simulated/SIM/{'success' if succeeded else 'failure'}/2026-01-{day:02d}/{place}"


def _stream(index: int, spec: RecordingSpec, purpose: int) -> np.random.Generator:
    return np.random.default_rng([spec.seed, index, purpose])
