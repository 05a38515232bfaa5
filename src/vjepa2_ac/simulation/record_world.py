"""Recording in a world that others made: its scripted expert, and play, filmed, as .npz episodes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.simulation.worlds import OtherWorld, WorldObservation
from vjepa2_ac.storage import atomic_writer, user_can_write

REST_S = 0.5  # after success an episode goes on for so long
OFF_M, OFF_S, EVERY_S = 0.02, 0.3, 1.5  # of a disturbance: its standard deviation on each axis, length, and period
HELD_S, WIDER_M, GRIPS = (0.3, 1.0), 0.05, 0.3  # of play: how long a target, how much wider the box, share of grips
LOOK = 4  # control steps of the expert from one look at where it is to the next
DISTURBED, PLAY = 1, 2  # seeds that leave this, divided by three


def record_world(
    world: OtherWorld, folder: Path, seeds: Sequence[int], progress: Progress = no_progress, *, every: int = 1
) -> tuple[int, int]:
    """Record the episodes of some seeds; one that is there already is not recorded again.

    Of three episodes, one is the expert's. In one its targets are now and then a few centimetres off, so that there is
    more than one way to do the task, and ways back. One is play: random places in the box in which the expert of this
    seed moves, with an opening and closing gripper. Without it a model learns where experts go, not what actions do.

    Args:
        world: With an expert.
        folder: One .npz file an episode (format: data/sources/npz.py).
        seeds: Of the episodes.
        progress: Called with (episodes done, episodes in total).
        every: Control steps from one frame to the next.

    Returns:
        Number of episodes that the expert solved, and that it acted in; neither counts play.

    Raises:
        InputError: The folder cannot be written, or the world ends or answers something else.
    """
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
    solved, name = 0, re.sub(r"[^\w .,()+-]", "-", world.about.task, flags=re.ASCII)  # the name of a file, and no path
    for done, seed in enumerate(seeds, start=1):
        file = folder / f"{name}_{seed:06d}.npz"
        if not file.exists():
            _record(world, file, seed, every)
        with np.load(file) as recorded:
            solved += bool(recorded["success"]) and seed % 3 != PLAY
        progress(done, len(seeds))
    return solved, sum(seed % 3 != PLAY for seed in seeds)


def _record(world: OtherWorld, file: Path, seed: int, every: int) -> None:
    about, kind = world.about, seed % 3
    ways = _played(world, seed, every) if kind == PLAY else _shown(world, seed, every, is_disturbed=kind == DISTURBED)
    steps = list(ways)
    seen, targets = [one for one, _ in steps], [target for _, target in steps]
    with user_can_write(file), atomic_writer(file) as stream:
        np.savez(
            stream,
            states=np.stack([one.state for one in seen[:-1]]),
            actions=np.stack(targets[1:]),
            frames=np.stack([one.image for one in seen[:-1]]),
            fps_hz=about.rate_hz / every,
            success=seen[-1].is_done,
            language=about.instruction,
        )


Step = tuple[WorldObservation, Float[np.ndarray, " 7"]]  # what is seen, and the target that led there


def _shown(world: OtherWorld, seed: int, every: int, *, is_disturbed: bool) -> Iterator[Step]:
    """Yield the steps of the expert until it rests."""
    about, rng, now = world.about, np.random.default_rng([seed, 0]), world.reset(seed)
    period, off, offset, rested = max(1, round(EVERY_S * about.rate_hz)), round(OFF_S * about.rate_hz), np.zeros(3), 0
    yield now, now.state
    for step in range(0, about.steps, every):
        if step % period < every and is_disturbed:
            offset = OFF_M * rng.normal(size=3)
        now = world.let_expert(every, offset.tolist() if step % period < off else (0.0, 0.0, 0.0))
        yield now, now.state if now.target is None else now.target
        rested = rested + every if now.is_done else 0
        if rested >= REST_S * about.rate_hz:
            return


def _played(world: OtherWorld, seed: int, every: int) -> Iterator[Step]:
    """Yield the steps of play, where the expert of this seed moves."""
    about, rng, now = world.about, np.random.default_rng([seed, 1]), world.reset(seed)
    places = [now.state[:3], *(world.let_expert(LOOK).state[:3] for _ in range(about.steps // LOOK))]
    low, high = np.min(places, axis=0) - [WIDER_M, WIDER_M, 0.0], np.max(places, axis=0) + WIDER_M
    now, target, until = world.reset(seed), now.state.copy(), 0.0
    yield now, now.state
    for step in range(0, about.steps, every):
        if step >= until:
            until = step + rng.uniform(*HELD_S) * about.rate_hz
            target[:3], target[6] = rng.uniform(low, high), rng.integers(2) if rng.uniform() < GRIPS else target[6]
        now = world.move(target, every)
        yield now, target.copy()
