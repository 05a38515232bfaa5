"""Synthetic demonstrations: smooth trajectories with drawn images, as DroidEpisode."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.simulation.droid_writer import CAMERAS, DroidEpisode, write_droid_rlds


def synthetic_states(steps: int, *, seed: int = 0) -> Float[np.ndarray, "steps 7"]:
    """Return a smooth measured trajectory (conventions: episode.py); roll and yaw cross pi (gripper down)."""
    generator = np.random.default_rng(seed)
    time = np.arange(steps)[:, None] / 15.0
    speed, phase = generator.uniform(0.5, 1.5, 7), generator.uniform(0, 2 * np.pi, 7)
    centre = np.array([0.5, 0.0, 0.35, np.pi, 0.0, np.pi, 0.5])
    reach = np.array([0.15, 0.25, 0.15, 0.3, 0.3, 0.4, 0.5])
    states = centre + reach * np.sin(speed * time + phase)
    states[:, 3:6] = (states[:, 3:6] + np.pi) % (2 * np.pi) - np.pi
    return states.astype(np.float32).astype(np.float64)  # RLDS stores float32


def draw_frame(
    state: Float[np.ndarray, " 7"], *, size: tuple[int, int] = (180, 320), camera: int = 0
) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image that shows the pose: a disc coloured by the gripper position, and a bar for the yaw."""
    height, width = size
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    frame = np.stack(
        [40 + 60 * rows / height, 60 + 60 * columns / width, np.full_like(rows, 50 + 50 * camera)], axis=-1
    )
    x, y, z, yaw, gripper = state[0], state[1], state[2], state[5], state[6]
    row, column = height * (1.0 - x / 0.9), width * (0.5 + (-y if camera == 1 else y))
    radius = height * (0.05 + 0.1 * z)
    down, right = rows - row, columns - column
    bar = (abs(down * np.cos(yaw) - right * np.sin(yaw)) < radius / 4) & (down**2 + right**2 < (3 * radius) ** 2)
    frame[bar] = (230, 230, 230)
    frame[down**2 + right**2 < radius**2] = (255 * gripper, 200, 255 * (1 - gripper))
    return frame.clip(0, 255).astype(np.uint8)


def synthetic_episode(
    number: int, *, steps: int = 40, size: tuple[int, int] = (180, 320), success: bool = True
) -> DroidEpisode:
    """Return a synthetic demonstration whose identity is determined by its number."""
    states = synthetic_states(steps + 1, seed=number)
    measured, target = states[:-1], states[1:]
    joints = np.sin(np.arange(steps)[:, None] / 15.0 + np.arange(7))
    folder = f"/data/LAB/{'success' if success else 'failure'}/2023-01-01/episode_{number:04d}"
    return DroidEpisode(
        file_path=f"{folder}/trajectory.h5",
        recording_folderpath=f"{folder}/recordings/MP4",
        arrays={
            "action": target,
            "action_dict/cartesian_position": target[:, :6],
            "action_dict/cartesian_velocity": (target - measured)[:, :6],
            "action_dict/gripper_position": target[:, 6:],
            "action_dict/gripper_velocity": (target - measured)[:, 6:],
            "action_dict/joint_position": joints,
            "action_dict/joint_velocity": np.gradient(joints, axis=0) if steps > 1 else np.zeros_like(joints),
            "observation/cartesian_position": measured[:, :6],
            "observation/gripper_position": measured[:, 6:],
            "observation/joint_position": joints,
        },
        images={
            name: [encode_jpeg(draw_frame(state, size=size, camera=camera)) for state in measured]
            for camera, name in enumerate(CAMERAS)
        },
        language_instruction=f"move to place {number}",
    )


def measured_states(episode: DroidEpisode) -> Float[np.ndarray, "steps 7"]:
    """Return the measured poses and gripper position of an episode."""
    measured = [episode.arrays[f"observation/{name}_position"] for name in ("cartesian", "gripper")]
    return np.concatenate(measured, axis=1)


def write_synthetic_droid(
    folder: str | Path,
    episodes: int = 6,
    steps: int | Sequence[int] = 40,
    shards: int = 2,
    size: tuple[int, int] = (180, 320),
    first: int = 0,
) -> Path:
    """Write synthetic demonstrations in DROID's schema, and return the folder; every third demonstration is a failure.

    `first` is the number of the first demonstration; data sets with other numbers have other demonstrations.
    """
    lengths = [steps] * episodes if isinstance(steps, int) else list(steps)
    drawn = (
        synthetic_episode(number, steps=length, size=size, success=number % 3 != 2)
        for number, length in enumerate(lengths, start=first)
    )
    return write_droid_rlds(folder, drawn, shards=shards)
