"""Demonstrations: what an episode of a recording is, and what the arm does in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vjepa2_ac.simulation.world.arm import SimulatedArm
from vjepa2_ac.simulation.world.domains import Domain, DomainRanges, named_domain, sample_domain
from vjepa2_ac.simulation.world.motion import Motion, MotionRecipe, random_reaching

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
        from vjepa2_ac.simulation.recording.scripted_play import play  # imports torch

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
        from vjepa2_ac.simulation.recording.scripted_play import play  # imports torch

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
