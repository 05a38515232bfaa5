"""Disk space of a latent cache: how much is needed, and is it free? Checked before the first frame is encoded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import DataConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import free_bytes

GIGABYTE = 10**9
FRAMES_AT_ONCE = 64  # decoded in one go: a run of a video, and 180 MB of 720p at most
SMALL_FRAME_SIDE = 192  # pixels, at most, of the small frames for display


@dataclass(frozen=True)
class CacheSize:
    """The size of a cache, and of its part that is not written yet."""

    frames: int  # of the whole cache
    frames_left: int
    bytes_per_frame: int  # with its small frame
    hours: float  # of robot data that clips come from

    @property
    def bytes_left(self) -> int:
        """Of the part that is not written yet."""
        return self.frames_left * self.bytes_per_frame

    def __str__(self) -> str:
        gigabytes = self.frames * self.bytes_per_frame / GIGABYTE
        per_hour = gigabytes / self.hours if self.hours else 0.0
        return (
            f"{self.frames:,} frames, {gigabytes:.3g} GB"
            f" ({per_hour:.3g} GB per hour of robot data, of which there are {self.hours:.3g})"
        )


def small_frame_side(image_size: int) -> int:
    """Return height and width of the small frames of a model's frames."""
    return min(SMALL_FRAME_SIDE, image_size)


def small_frame_bytes(image_size: int) -> int:
    """Return the approximate size of a small frame as JPEG, with a share of the states."""
    return 1000 + small_frame_side(image_size) ** 2 // 3


def require_space(room: CacheSize, folder: Path, config: DataConfig) -> None:
    """Refuse to start if the disk has too little space.

    Args:
        room: What is to be written.
        folder: The folder to write to.
        config: The data, some knobs of which would reduce the size.

    Raises:
        InputError: Says how much is free, how much is needed, and what to do.
    """
    free = free_bytes(folder)
    if room.bytes_left <= free:
        return
    smaller = [] if config.cache_dtype == "int8" else ["data.cache_dtype: int8"]
    if config.start_every % config.model_stride:
        smaller.append(f"data.start_every: {config.model_stride}")
    fix = f"Set {', '.join(smaller)}; " if smaller else ""
    raise InputError(
        where=str(folder),
        found=f"{free / GIGABYTE:.4g} GB free on its disk",
        needed=f"{room.bytes_left / GIGABYTE:.4g} GB for the latents of {room.frames_left:,} frames"
        f" ({room.bytes_per_frame / 1e6:.3g} MB each)",
        fix=f"{fix}take fewer episodes (data.outcome, data.idle, data.exclude); or name a folder on a larger disk"
        " (data.cache_dir)",
    )
