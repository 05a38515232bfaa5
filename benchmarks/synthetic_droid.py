"""Synthetic episodes with the length and size of DROID's, with noise as smooth as a camera image."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.simulation.droid_writer import CAMERAS, DroidEpisode


def draw_episodes(count: int = 12, steps: int = 290) -> Iterator[DroidEpisode]:
    """Yield episodes with 180x320 JPEGs of 10 to 25 KB, and say so."""
    generator = np.random.default_rng(0)
    pictures = [encode_jpeg(draw_picture(generator), quality=quality) for quality in range(78, 94) for _ in range(4)]
    sizes = sorted(len(picture) for picture in pictures)
    print(f"JPEGs of {sizes[0] / 1e3:.0f} to {sizes[-1] / 1e3:.0f} KB, {count} episodes of {steps} steps, 3 cameras")
    widths = {"cartesian": 6, "gripper": 1, "joint": 7}
    arrays = {"action": np.zeros((steps, 7))}
    for name, width in widths.items():
        for feature in (f"action_dict/{name}_position", f"action_dict/{name}_velocity", f"observation/{name}_position"):
            arrays[feature] = np.zeros((steps, width))
    for number in range(count):
        folder = f"/data/success/episode_{number}"
        yield DroidEpisode(
            file_path=f"{folder}/trajectory.h5",
            recording_folderpath=f"{folder}/recordings",
            arrays=arrays,
            images={
                camera: [pictures[place] for place in generator.integers(0, len(pictures), steps)] for camera in CAMERAS
            },
        )


def draw_picture(generator: np.random.Generator) -> np.ndarray:
    """Return a picture with detail of every size."""
    picture = np.full((180, 320, 3), 128.0)
    for cell in (1, 2, 4, 20, 60):
        noise = generator.normal(0, 3 + cell**0.7, (180 // cell + 1, 320 // cell + 1, 3))
        picture += noise.repeat(cell, axis=0).repeat(cell, axis=1)[:180, :320]
    return picture.clip(0, 255).astype(np.uint8)
