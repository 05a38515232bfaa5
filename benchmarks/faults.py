"""What goes wrong where pictures and states are put together? Each fault done to whole recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.evaluation.calibration.data import mirrored
from vjepa2_ac.spaces import actions_from_states

LATE, EARLY, STALE_EVERY, NOISE_M = 8, 2, 5, 0.02


@dataclass(frozen=True, eq=False)
class Recording:
    """An episode with all its pictures."""

    states: Float[np.ndarray, "steps 7"]
    frames: UInt8[np.ndarray, "steps height width 3"]
    rate_hz: float


@dataclass(frozen=True)
class Fault:
    """What is done to each recording, and the variant of the probe in which it would be mended."""

    name: str
    spoil: Callable[[Recording, Recording, np.random.Generator], Recording]  # a recording, and the next one
    variant: str | None = None
    every: int = 1  # 2: only every second recording has the fault


def spoiled(fault: Fault, recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with a fault; always the same ones."""
    generator = np.random.default_rng(0)
    following = [*recordings[1:], recordings[0]]
    return [
        one if number % fault.every else fault.spoil(one, other, generator)
        for number, (one, other) in enumerate(zip(recordings, following, strict=True))
    ]


def _with_late_pictures(one: Recording, steps: int) -> Recording:
    count = len(one.states) - abs(steps)
    first, later = slice(0, count), slice(abs(steps), None)
    states, frames = (later, first) if steps > 0 else (first, later)
    return replace(one, states=one.states[states], frames=one.frames[frames])


def _of_another(one: Recording, other: Recording) -> Recording:
    count = min(len(one.states), len(other.states))
    return replace(one, states=one.states[:count], frames=other.frames[:count])


def _stale(one: Recording) -> Recording:
    states = one.states.copy()
    for step in range(STALE_EVERY - 1, len(states), STALE_EVERY):
        states[step] = states[step - 1]
    return replace(one, states=states)


def _shaken(one: Recording, generator: np.random.Generator) -> Recording:
    states = one.states.copy()
    states[:, :3] += generator.normal(0, NOISE_M, (len(states), 3))
    return replace(one, states=states)


def _deltas(one: Recording) -> Recording:
    """Take what moves the flange for where it is, as of a set's actions; the gripper of these is absolute."""
    deltas = actions_from_states(one.states)
    states = np.concatenate([deltas[:, :6], one.states[1:, 6:]], axis=1)
    return replace(one, states=states, frames=one.frames[:-1])


def _noise(one: Recording, generator: np.random.Generator) -> Recording:
    return replace(one, frames=generator.integers(0, 256, one.frames.shape, dtype=np.uint8))


def _twice(one: Recording) -> Recording:
    steps = np.repeat(np.arange(len(one.states)), 2)
    return replace(one, states=one.states[steps], frames=one.frames[steps], rate_hz=2 * one.rate_hz)


def _at_half_scale(one: Recording) -> Recording:
    return replace(one, states=one.states * [0.5, 0.5, 0.5, 1, 1, 1, 1])


def _near_copy(other: Recording, generator: np.random.Generator) -> Recording:
    return replace(other, states=other.states + generator.normal(0, 1e-6, other.states.shape))


def _with_outlier(one: Recording) -> Recording:
    states = one.states.copy()
    states[len(states) // 2, 0] *= 10
    return replace(one, states=states)


def _with_gripper_inverted(one: Recording) -> Recording:
    return replace(one, states=np.concatenate([one.states[:, :6], 1 - one.states[:, 6:]], axis=1))


CLEAN = "as it is"
FAULTS = (
    Fault(CLEAN, lambda one, *_: one),
    Fault("frames mirrored", lambda one, *_: replace(one, frames=one.frames[:, :, ::-1]), "frames mirrored"),
    Fault("y negated", lambda one, *_: replace(one, states=mirrored(one.states, 1)), "y negated"),
    Fault("x negated", lambda one, *_: replace(one, states=mirrored(one.states, 0)), "x negated"),
    Fault("frames 8 steps late", lambda one, *_: _with_late_pictures(one, LATE), "frames 8 steps late"),
    Fault("frames 2 steps early", lambda one, *_: _with_late_pictures(one, -EARLY), "frames 2 steps early"),
    Fault("frames reversed", lambda one, *_: replace(one, frames=one.frames[::-1]), "the states backwards"),
    Fault("of another episode", lambda one, other, _: _of_another(one, other)),
    Fault("stale poses, every 5th", lambda one, *_: _stale(one)),
    Fault("2 cm of noise", lambda one, _, generator: _shaken(one, generator)),
    Fault("deltas taken for poses", lambda one, *_: _deltas(one)),
    Fault("BGR", lambda one, *_: replace(one, frames=one.frames[..., ::-1]), "red and blue exchanged"),
    Fault("noise as frames", lambda one, _, generator: _noise(one, generator)),
    Fault("half the rate labelled", lambda one, *_: replace(one, rate_hz=2 * one.rate_hz)),
    Fault("each step twice", lambda one, *_: _twice(one)),
    Fault("gripper inverted", lambda one, *_: _with_gripper_inverted(one), "the gripper inverted"),
    Fault("one outlier in one", lambda one, *_: _with_outlier(one), every=1000),
    Fault("one is black", lambda one, *_: replace(one, frames=one.frames * 0), every=1000),
    Fault("half of them black", lambda one, *_: replace(one, frames=one.frames * 0), every=2),
    Fault("half at half the scale", lambda one, *_: _at_half_scale(one), every=2),
    Fault("half of them reversed", lambda one, *_: replace(one, frames=one.frames[::-1]), every=2),
    Fault("half grippers inverted", lambda one, *_: _with_gripper_inverted(one), every=2),
    Fault("copies with noise", lambda _, other, generator: _near_copy(other, generator), every=2),
)
