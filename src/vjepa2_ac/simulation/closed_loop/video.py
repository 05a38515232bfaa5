"""Videos of closed-loop episodes: the camera image beside the goal image, step by step.

With a decoder there is a third image: what the planner imagined of this frame when it took the action before it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.media.video_writer import write_video
from vjepa2_ac.reports.figures.caption import side_by_side
from vjepa2_ac.simulation.closed_loop.result import ClosedLoopResult, EpisodeResult
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ

_HOLD = 4  # number of repetitions of the first and the last image of an episode


def write_film(path: str | Path, result: ClosedLoopResult) -> Path:
    """Write the stored frames of a policy as a video, in real time.

    Args:
        path: Of an MP4.
        result: One camera image beside the goal image.

    Raises:
        InputError: PyAV is not installed.
        ValueError: No frames were stored.
    """
    return write_video(path, film_frames(result), rate_hz=CONTROL_RATE_HZ / result.stride)


def film_frames(result: ClosedLoopResult) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield the frames of the video, one per model step, the first and last of an episode repeated."""
    for number, episode in enumerate(result.episodes, start=1):
        if episode.frames is None:
            return
        about = f"{result.task}, domain {result.domain}    episode {number} of {len(result.episodes)}"
        for step, (frame, distance_m) in enumerate(zip(episode.frames, episode.distances_m, strict=True)):
            outcome = ("   missed", "   reached")[episode.success] if step == result.steps else ""
            caption = f"{result.policy}:   {100 * distance_m:.1f} cm from the goal{outcome}"
            title = f"{about}    step {step} of {result.steps}"
            images, captions = [frame, episode.goal_image], [caption, "goal"]
            if any(one is not None for one in episode.imagined):
                images.append(_imagined(episode, step))
                captions.append(_about_imagined(episode, step))
            image = side_by_side(images, captions, title)
            yield from itertools.repeat(image, _HOLD if step in {0, result.steps} else 1)


def _imagined(episode: EpisodeResult, step: int) -> UInt8[np.ndarray, "height width 3"]:
    """Return what was imagined of this frame; white where nothing was."""
    found = episode.imagined[step - 1] if step else None
    return np.full_like(episode.goal_image, 255) if found is None else found


def _about_imagined(episode: EpisodeResult, step: int) -> str:
    if step and episode.imagined[step - 1] is None:
        return f"nothing imagined: {episode.whys[step - 1]}"
    return "imagined one step ago" if step else "imagined one step ago: nothing yet"
