"""Videos of closed-loop episodes: the camera image beside the goal image, step by step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.media.video_writer import write_video
from vjepa2_ac.reports.figures.caption import side_by_side
from vjepa2_ac.simulation.closed_loop.result import ClosedLoopResult, EpisodeResult
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ

_HOLD = 4  # number of repetitions of the first and the last image of an episode


def write_film(path: str | Path, results: Sequence[ClosedLoopResult]) -> Path:
    """Write the stored frames of policies that solved the same problems as a video, in real time.

    Args:
        path: Of an MP4.
        results: One camera image for each, side by side, the goal image last.

    Raises:
        InputError: PyAV is not installed.
        ValueError: No frames were stored.
    """
    return write_video(path, film_frames(results), rate_hz=CONTROL_RATE_HZ / results[0].stride)


def film_frames(results: Sequence[ClosedLoopResult]) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield the frames of the video, one per model step, the first and last of an episode repeated."""
    for index, episodes in enumerate(zip(*(result.episodes for result in results), strict=True)):
        if any(episode.frames is None for episode in episodes):
            return
        for step in range(results[0].steps + 1):
            frame = _frame(results, episodes, index, step)
            for _ in range(_HOLD if step in {0, results[0].steps} else 1):
                yield frame


def _frame(
    results: Sequence[ClosedLoopResult], episodes: Sequence[EpisodeResult], index: int, step: int
) -> UInt8[np.ndarray, "_ _ 3"]:
    first = results[0]
    title = (
        f"{first.task}, domain {first.domain}    episode {index + 1} of {len(first.episodes)}"
        f"    step {step} of {first.steps}"
    )
    captions = [_caption(result, episode, step) for result, episode in zip(results, episodes, strict=True)]
    frames = [episode.frames[step] for episode in episodes if episode.frames is not None]
    return side_by_side([*frames, episodes[0].goal_image], [*captions, "goal"], title)


def _caption(result: ClosedLoopResult, episode: EpisodeResult, step: int) -> str:
    outcome = ("   missed", "   reached")[episode.success] if step == result.steps else ""
    return f"{result.policy}:   {100 * episode.distances_m[step]:.1f} cm from the goal{outcome}"
