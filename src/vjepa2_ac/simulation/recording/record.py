"""Recording of a simulated data set: demonstrations, filmed, written as RLDS in DROID's schema."""

from __future__ import annotations

import itertools
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.data.sources.rlds.droid_writer import (
    CAMERAS,
    DroidCommands,
    DroidEpisode,
    DroidMeasurements,
    write_droid_rlds,
)
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.simulation.recording.demonstration import INSTRUCTIONS, RecordingSpec, arm_of, carry_out, episode_folder
from vjepa2_ac.simulation.recording.simulation_file import SIMULATION_FILE, simulation_text
from vjepa2_ac.simulation.world.arm import SimulatedArm
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ, Motion
from vjepa2_ac.simulation.world.scene import load_mujoco

__all__ = ["RecordingSpec", "episode_folder", "record_dataset", "record_episode"]

JPEG_QUALITY = 85  # some 11 KB an image, as in DROID
_SIMULATED_CAMERAS = dict(zip(CAMERAS, ("exterior_1", "exterior_2", "wrist"), strict=True))


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

    notes = {SIMULATION_FILE: simulation_text(spec, episodes)}
    return write_droid_rlds(folder, watched(), shards=shards or -(-episodes // 32), notes=notes)


def record_episode(index: int, spec: RecordingSpec) -> DroidEpisode:
    """Return one episode: a pure function of its arguments.

    Raises:
        InputError: MuJoCo or OpenGL is missing, or an unknown domain.
    """
    arm = arm_of(index, spec)
    images: dict[str, list[bytes]] = {}
    motion = carry_out(arm, index, spec, look=partial(_take, films=images, cameras=spec.cameras))
    folder = episode_folder(index, spec.seed, arm.domain.name)
    return DroidEpisode(
        file_path=f"{folder}/trajectory.h5",
        recording_folderpath=f"{folder}/recordings/MP4",
        action=np.concatenate([motion.commanded_poses, motion.commanded_gripper[:, None]], axis=1),
        action_dict=_commands(motion),
        observation=DroidMeasurements(
            cartesian_position=motion.poses, gripper_position=motion.gripper[:, None], joint_position=motion.joints
        ),
        images={feature: images.get(feature, images[CAMERAS[0]]) for feature in CAMERAS},
        language_instruction=INSTRUCTIONS[spec.task],
    )


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
