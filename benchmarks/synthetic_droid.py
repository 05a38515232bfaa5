"""Synthetic episodes with the length and image size of DROID's, whose JPEGs are as large as those of camera images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.simulation.droid_writer import CAMERAS, DroidEpisode


def draw_episodes(count: int = 12, steps: int = 290) -> Iterator[DroidEpisode]:
    """Print the sizes of the images, and yield episodes with 180x320 JPEGs of 10 to 25 KB."""
    generator = np.random.default_rng(0)
    images = [encode_jpeg(draw_image(generator), quality=quality) for quality in range(78, 94) for _ in range(4)]
    sizes = sorted(len(image) for image in images)
    print(f"JPEGs of {sizes[0] / 1e3:.0f} to {sizes[-1] / 1e3:.0f} KB, {count} episodes of {steps} steps, 3 cameras")
    widths = {"cartesian": 6, "gripper": 1, "joint": 7}
    arrays = {"action": np.zeros((steps, 7))}
    for part, width in widths.items():
        for feature in (f"action_dict/{part}_position", f"action_dict/{part}_velocity", f"observation/{part}_position"):
            arrays[feature] = np.zeros((steps, width))
    for number in range(count):
        folder = f"/data/success/episode_{number}"
        yield DroidEpisode(
            file_path=f"{folder}/trajectory.h5",
            recording_folderpath=f"{folder}/recordings",
            arrays=arrays,
            images={
                camera: [images[index] for index in generator.integers(0, len(images), steps)] for camera in CAMERAS
            },
        )


def draw_image(generator: np.random.Generator) -> np.ndarray:
    """Return an image of noise with details of several sizes in pixels."""
    image = np.full((180, 320, 3), 128.0)
    for size in (1, 2, 4, 20, 60):
        noise = generator.normal(0, 3 + size**0.7, (180 // size + 1, 320 // size + 1, 3))
        image += noise.repeat(size, axis=0).repeat(size, axis=1)[:180, :320]
    return image.clip(0, 255).astype(np.uint8)
