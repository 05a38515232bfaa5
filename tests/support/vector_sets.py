"""Synthetic recordings of a robot without poses: vectors of numbers, as .npz episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

FPS = 10.0


def vectors(steps: int, width: int, *, seed: int) -> Float[np.ndarray, "steps width"]:
    """Return smooth numbers of the order of 1, like joint angles."""
    generator = np.random.default_rng(seed)
    speed, phase = generator.uniform(0.5, 2.0, width), generator.uniform(0, 2 * np.pi, width)
    return np.sin(speed * np.arange(steps)[:, None] / FPS + phase)


def draw_vector(
    state: Float[np.ndarray, " width"], size: tuple[int, int] = (36, 48)
) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image with a bar for each number, whose height shows the number."""
    height, width = size
    frame = np.full((height, width, 3), 40, np.uint8)
    for number, value in enumerate(state):
        left, right = number * width // len(state), (number + 1) * width // len(state)
        top = int((1 - (value + 1) / 2) * (height - 1))
        frame[top:, left:right] = (200, 60 + 10 * number % 190, 220 - 12 * number % 200)
    return frame


def write_vectors(
    folder: Path, *, width: int, action_width: int | None = None, episodes: int = 8, steps: int = 24, **changes: Any
) -> Path:
    """Write synthetic episodes with states of `width` numbers, and with actions if `action_width` is given."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(episodes):
        states = vectors(steps, width, seed=number)
        arrays = {"states": states, "frames": np.stack([draw_vector(state) for state in states]), "fps_hz": FPS}
        if action_width is not None:
            arrays["actions"] = vectors(steps, action_width, seed=1000 + number)
        np.savez(folder / f"episode_{number:03d}.npz", **(arrays | changes))
    return folder
