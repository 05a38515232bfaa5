"""What does a robot look like that is no more than a spot? Stretches of episodes that move now fast, now slowly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.inspection.excerpts import Excerpt, convert_to_small_grey

STEPS, RATE_HZ = 48, 15.0
ROWS, COLUMNS = 24, 32


def spot_states(number: int, steps: int = STEPS) -> Float[np.ndarray, "steps 7"]:
    """Return poses on a path over the table, with a speed that changes continuously."""
    generator = np.random.default_rng(number)
    knots = np.arange(0, steps + 8, 4)
    speed = generator.uniform(0.0, 0.03, steps)  # metres a step
    heading = np.cumsum(generator.normal(0, 0.3, steps)) + generator.uniform(0, 2 * np.pi)
    states = np.zeros((steps, 7))
    states[:, 0] = 0.5 + np.cumsum(speed * np.cos(heading))
    states[:, 1] = np.cumsum(speed * np.sin(heading))
    states[:, 2] = 0.3 + 0.3 * np.cumsum(speed * np.sin(heading + 1))
    states[:, 3:6] = [np.pi, 0.0, 0.3] + 0.5 * np.cumsum(speed)[:, None] * [0.0, 0.0, 1.0]
    states[:, 6] = np.interp(np.arange(steps), knots, generator.integers(0, 2, len(knots)))
    return states


def spot_frames(states: Float[np.ndarray, "steps 7"]) -> UInt8[np.ndarray, "steps rows columns 3"]:
    """Return images of a bright spot at the pose, in front of a table that is more red than blue."""
    rows, columns = np.mgrid[0:ROWS, 0:COLUMNS]
    down, right = 12 - 12 * (states[:, 0] - 0.5), 16 + 12 * states[:, 1]
    distance = (rows - down[:, None, None]) ** 2 + (columns - right[:, None, None]) ** 2
    brightness = 160 * np.exp(-distance / (8 + 40 * states[:, 2, None, None] ** 2))
    return np.stack([70 + brightness, 60 + brightness, 20 + brightness], axis=-1).clip(0, 255).astype(np.uint8)


def spot_excerpt(
    name: int | str, states: Float[np.ndarray, "steps 7"], frames: UInt8[np.ndarray, "steps rows columns 3"]
) -> Excerpt:
    """Return the excerpt of an episode with these states and images."""
    return Excerpt(str(name), states, convert_to_small_grey(frames))


def write_spots(folder: Path, episodes: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    """Write states and images as .npz episodes."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (states, frames) in enumerate(episodes):
        np.savez(folder / f"{number:03d}.npz", states=states, frames=frames, fps_hz=RATE_HZ)
    return folder
