"""Recording of a simulated data set: random reaching, filmed, written as RLDS in DROID's schema."""

from __future__ import annotations

import itertools
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.data.sources.rlds.writing.droid_writer import (
    CAMERAS,
    DroidCommands,
    DroidEpisode,
    DroidMeasurements,
    write_droid_rlds,
)
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.jpeg import encode_jpeg
from vjepa2_ac.simulation.world.arm import Renderer, SimulatedArm
from vjepa2_ac.simulation.world.domains import Domain, DomainRanges, named_domain, sample_domain
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ, Motion, MotionRecipe, random_reaching
from vjepa2_ac.simulation.world.scene import load_mujoco

SUCCESS_SHARE = 0.9
JPEG_QUALITY = 85  # some 11 KB an image, as in DROID
_INSTRUCTIONS = {None: "reach around over the table", "push": "push the block", "pick": "pick up the block"}
_SIMULATED_CAMERAS = dict(zip(CAMERAS, ("exterior_1", "exterior_2", "wrist"), strict=True))


@dataclass(frozen=True)
class RecordingSpec:
    """What an episode of a simulated data set is."""

    domain: str | Domain | DomainRanges  # or its name; ranges, or `random`: another world in every episode
    steps: int = 41  # control steps (15 per second)
    seed: int = 0  # determines motion, outcome and worlds
    cameras: Literal[1, 3] = 1  # 1: the three images of a step are the same one; 3: one image per camera
    renderer: Renderer = "rays"  # it works everywhere; `opengl` needs a working `MUJOCO_GL`
    recipe: MotionRecipe | None = None  # ranges of the motion, without a task
    task: Literal["push", "pick"] | None = None  # with a block: half of the episodes by script, half at random

    @property
    def worlds(self) -> Domain | DomainRanges:
        """The world of all episodes, or the ranges to draw each one's from.

        Raises:
            InputError: No domain has this name.
        """
        if not isinstance(self.domain, str):
            return self.domain
        return DomainRanges() if self.domain == "random" else named_domain(self.domain)


def record_dataset(
    folder: str | Path,
    spec: RecordingSpec,
    *,
    episodes: int,
    shards: int | None = None,
    workers: int = 1,
    progress: Progress = no_progress,
) -> Path:
    """Record episodes and write them as a data set; the same arguments give the same bytes, whatever `workers`.

    Other versions of MuJoCo, NumPy or the JPEG library may change last digits and bytes, not the episodes.

    Args:
        folder: The folder of the data set; must be new or empty.
        spec: What an episode is.
        episodes: Number of episodes.
        shards: TFRecord files; one for every 32 episodes by default.
        workers: Processes. More than one needs `if __name__ == "__main__":` in a script that calls this.
        progress: Called with (episodes done, episodes in total).

    Raises:
        InputError: MuJoCo or OpenGL is missing, an unknown domain, a number out of range, or a folder that is in use or
            cannot be written.
    """
    load_mujoco()
    if min(episodes, spec.steps - 1, workers, 1 if shards is None else shards, spec.seed + 1) < 1:
        raise InputError(
            where="simulate record",
            found=f"episodes {episodes}, steps {spec.steps}, shards {shards}, workers {workers}, seed {spec.seed}",
            needed="at least 1 episode, 2 steps, 1 shard, 1 worker, seed 0",
        )
    record = partial(record_episode, spec=replace(spec, domain=spec.worlds))

    def watched() -> Iterator[DroidEpisode]:
        for done, episode in enumerate(_recorded(record, episodes, workers), start=1):
            yield episode
            progress(done, episodes)

    return write_droid_rlds(folder, watched(), shards=shards or -(-episodes // 32))


def record_episode(index: int, spec: RecordingSpec) -> DroidEpisode:
    """Return one episode: a pure function of its arguments.

    Raises:
        InputError: MuJoCo or OpenGL is missing, or an unknown domain.
    """
    motion_rng, world_rng = (np.random.default_rng([spec.seed, index, purpose]) for purpose in range(2))
    worlds, task = spec.worlds, spec.task
    world = worlds if isinstance(worlds, Domain) else sample_domain(world_rng, worlds)
    images: dict[str, list[bytes]] = {}
    if task is None:
        motion = random_reaching(world, spec.steps, motion_rng, spec.recipe)
        arm = SimulatedArm(world, renderer=spec.renderer)
        for joints, closedness in zip(motion.joints, motion.gripper, strict=True):
            arm.set_joints(joints, float(closedness))
            _take(arm, images, spec.cameras)
    else:
        # They import torch, which random reaching does not need.
        from vjepa2_ac.simulation.closed_loop.tasks import arm_for
        from vjepa2_ac.simulation.recording.scripted_play import play

        arm = arm_for(task, world, renderer=spec.renderer)
        look = partial(_take, films=images, cameras=spec.cameras)
        motion = play(arm, task, spec.steps, motion_rng, script=index % 2 == 0, look=look)
    folder = episode_folder(index, spec.seed, world.name)
    return DroidEpisode(
        file_path=f"{folder}/trajectory.h5",
        recording_folderpath=f"{folder}/recordings/MP4",
        action=np.concatenate([motion.commanded_poses, motion.commanded_gripper[:, None]], axis=1),
        action_dict=_commands(motion),
        observation=DroidMeasurements(
            cartesian_position=motion.poses, gripper_position=motion.gripper[:, None], joint_position=motion.joints
        ),
        images={feature: images.get(feature, images[CAMERAS[0]]) for feature in CAMERAS},
        language_instruction=_INSTRUCTIONS[task],
    )


def episode_folder(index: int, seed: int, domain_name: str) -> str:
    """Return the source folder stored in the episode; as in DROID, the only record of success or failure."""
    succeeded = np.random.default_rng([seed, index, 2]).uniform() < SUCCESS_SHARE
    minute, hour, day = index % 60, index // 60 % 24, 1 + index // 1440 % 28
    place = f"{domain_name}_seed{seed}_{hour:02d}h{minute:02d}_{index:06d}"
    return f"/simulated/SIM/{'success' if succeeded else 'failure'}/2026-01-{day:02d}/{place}"


def _take(arm: SimulatedArm, films: dict[str, list[bytes]], cameras: int) -> None:
    """Append the current camera images to the films."""
    for feature in CAMERAS[:cameras]:
        image = arm.image(_SIMULATED_CAMERAS[feature])
        films.setdefault(feature, []).append(encode_jpeg(image, quality=JPEG_QUALITY))


def _commands(motion: Motion) -> DroidCommands:
    """Return DROID's `action_dict`; velocities are what the commands ask for, in units per second."""
    poses = motion.commanded_poses
    angles = np.concatenate([poses[:, :3], np.unwrap(poses[:, 3:], axis=0)], axis=1)
    gripper = motion.commanded_gripper[:, None]
    return DroidCommands(
        cartesian_position=poses,
        cartesian_velocity=_velocity(angles),
        gripper_position=gripper,
        gripper_velocity=_velocity(gripper),
        joint_position=motion.commanded_joints,
        joint_velocity=_velocity(motion.commanded_joints),
    )


def _velocity(positions: Float[np.ndarray, "steps dim"]) -> Float[np.ndarray, "steps dim"]:
    """Return the velocity that led to each position; the first equals the second."""
    ways = np.diff(positions, axis=0)
    return np.concatenate([ways[:1], ways]) * CONTROL_RATE_HZ


def _recorded(record: Callable[[int], DroidEpisode], episodes: int, workers: int) -> Iterator[DroidEpisode]:
    """Yield the episodes in order; a few are recorded in parallel."""
    if workers == 1:
        yield from map(record, range(episodes))
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        indices = iter(range(episodes))
        waiting = [pool.submit(record, index) for index in itertools.islice(indices, 3 * workers)]
        while waiting:
            yield waiting.pop(0).result()
            waiting += [pool.submit(record, index) for index in itertools.islice(indices, 1)]
