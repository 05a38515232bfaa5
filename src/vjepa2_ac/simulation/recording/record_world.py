"""Recording of demonstrations in a world that others made: its scripted expert, filmed, as .npz episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.simulation.closed_loop.worlds import OtherWorld, WorldObservation
from vjepa2_ac.storage import atomic_writer, user_can_write

REST_S = 0.5  # after success an episode goes on for so long
OFF_M, OFF_S, EVERY_S = 0.02, 0.3, 1.5  # of a disturbance: its standard deviation on each axis, length, and period


def record_world(world: OtherWorld, folder: Path, seeds: Sequence[int], progress: Progress = no_progress) -> int:
    """Record the expert's episodes of some seeds; one that is there already is not recorded again.

    Every second episode is disturbed: now and then the expert's targets are a few centimetres off, so that the data
    have more than one way to do the task, and ways back.

    Args:
        world: With an expert.
        folder: One .npz file an episode (format: data/sources/npz.py), at the world's control rate.
        seeds: Of the episodes.
        progress: Called with (episodes done, episodes in total).

    Returns:
        How many of them the expert has solved.

    Raises:
        InputError: The folder cannot be written, or the world ends or answers something else.
    """
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
    solved = 0
    for done, seed in enumerate(seeds, start=1):
        file = folder / f"{world.about.task}_{seed:06d}.npz"
        if file.exists():
            with np.load(file) as kept:
                solved += bool(kept["success"])
        else:
            solved += _record(world, file, seed)
        progress(done, len(seeds))
    return solved


def _record(world: OtherWorld, file: Path, seed: int) -> bool:
    about, rng = world.about, np.random.default_rng([seed, 0])
    period, off = round(EVERY_S * about.rate_hz), round(OFF_S * about.rate_hz)
    seen: list[WorldObservation] = [world.reset(seed)]
    targets, rested = [], 0
    while len(seen) <= about.steps and rested < REST_S * about.rate_hz:
        begins = (len(seen) - 1) % period
        if begins == 0:
            offset = OFF_M * rng.normal(size=3) * (seed % 2)
        seen.append(world.let_expert(1, offset.tolist() if begins < off else (0.0, 0.0, 0.0)))
        targets.append(seen[-1].state if seen[-1].target is None else seen[-1].target)
        rested = rested + 1 if seen[-1].is_done else 0
    with user_can_write(file), atomic_writer(file) as stream:
        np.savez(
            stream,
            states=np.stack([one.state for one in seen[:-1]]),
            actions=np.stack(targets),
            frames=np.stack([one.image for one in seen[:-1]]),
            fps_hz=about.rate_hz,
            success=seen[-1].is_done,
            language=about.instruction,
        )
    return seen[-1].is_done
