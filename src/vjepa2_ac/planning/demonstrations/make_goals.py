"""Goals from one demonstration: its key frames, with durations, gripper, energies, and the noise floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from vjepa2_ac import __version__
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.demonstrations.energies import Energies
from vjepa2_ac.planning.demonstrations.recording import Recording
from vjepa2_ac.planning.goals.folder import NoiseFloor, write_goals
from vjepa2_ac.planning.goals.from_demonstration import Timing, sub_goals_of
from vjepa2_ac.planning.goals.key_frames import (
    KeyFrame,
    StillRule,
    every_key_frame,
    gripper_key_frames,
    latent_key_frames,
    resting,
)
from vjepa2_ac.planning.goals.sub_goals import SubGoal
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage.structured import utc_now

By = Literal["gripper", "latent", "every"]

_MOST_ENCODED = 600  # frames of a demonstration; of a longer one every second, third ...
_APART = 4  # model steps from one goal to the next, by latents


@dataclass(frozen=True)
class KeyFrameOptions:
    """Which frames become goals, and how long each may take."""

    by: By = "gripper"
    every: int | None = None  # frames, by `every`
    apart: int | None = None  # least frames between a stop and another goal (4), or between goals by latents
    stride: int = 4  # frames of a model step
    slack: int = 3  # model steps that a goal may take fewer or more than the demonstration
    share: float | None = None  # of each goal but the last
    stop_share: float | None = None  # of the last one


@dataclass(frozen=True, eq=False)
class EnergyCourse:
    """The energy of frames of a demonstration to the goal that applies then."""

    frames: Int[np.ndarray, " encoded"]
    energy: Float[np.ndarray, " encoded"]
    began: tuple[float, ...]  # of each goal: energy of the key frame before to it
    step_before: tuple[float, ...]  # of each goal: energy one model step before it is reached


@dataclass(frozen=True, eq=False)
class MadeGoals:
    """The goals of a demonstration, and what is known about them."""

    recording: Recording
    options: KeyFrameOptions
    keys: tuple[KeyFrame, ...]
    goals: tuple[SubGoal, ...]
    first: UInt8[np.ndarray, "height width 3"]  # the first frame of the demonstration
    course: EnergyCourse | None = None  # None: without a model
    noise: NoiseFloor | None = None

    def write(self, folder: Path) -> Path:
        """Write the folder of goals, and return the path of its goals.json.

        Raises:
            InputError: It cannot be written.
        """
        about = {"by": self.options.by, "every": self.options.every, "stride": self.options.stride}
        made = {"frames": self.recording.frames, "version": __version__, "time": utc_now()}
        return write_goals(
            folder,
            self.goals,
            frames=[key.frame for key in self.keys],
            began=() if self.course is None else self.course.began,
            noise=self.noise,
            origin={**self.recording.origin, **about, **made},
        )


def make_goals(
    recording: Recording,
    options: KeyFrameOptions,
    energies: Energies | None = None,
    *,
    still: Recording | None = None,
    reporter: Reporter = SILENT,
) -> MadeGoals:
    """Return the key frames of a demonstration as goals.

    Args:
        recording: The demonstration.
        options: Which frames, and how long they may take.
        energies: Of the model that will plan; needed by latents, and for the noise floor.
        still: A film of the resting arm, for the noise floor; None: where the arm rests in the demonstration.
        reporter: Shows the progress.

    Raises:
        InputError: The demonstration has no poses, or there is no model, and the options need them.
    """
    _require_what_is_needed(recording, options, energies)
    seen = None if energies is None else _Seen.of(energies, recording, reporter)
    keys = _keys(recording, options, seen)
    first, *images = recording.read([0, *(key.frame for key in keys)])
    timing = Timing(options.stride, options.slack, options.share)
    goals = sub_goals_of(images, keys, timing, recording.states)
    goals = (*goals[:-1], replace(goals[-1], share=options.stop_share))
    course = noise = None
    if seen is not None:
        course = seen.course([key.frame for key in keys], options.stride)
        noise = _noise(seen.energies, recording, options.stride, still, reporter)
    return MadeGoals(recording, options, keys, goals, first, course, noise)


def _require_what_is_needed(recording: Recording, options: KeyFrameOptions, energies: Energies | None) -> None:
    fix = "Take --by latent with --model, or --by every N"
    if options.by == "gripper" and recording.states is None:
        found, needed = f"{recording.name}: no measured poses", "an episode with poses and gripper"
        raise InputError(where="--by gripper", found=found, needed=needed, fix=fix)
    if options.by == "latent" and energies is None:
        raise InputError(where="--by latent", found="no model", needed="--model: whose latents are compared")
    if options.by == "every" and options.every is None:
        raise InputError(where="--by every", found="no number", needed="how many frames apart, as --by every 20")


@dataclass(frozen=True, eq=False)
class _Seen:
    """The latents of a demonstration: of all its frames, or of so many that they fit into memory."""

    energies: Energies
    recording: Recording
    frames: Int[np.ndarray, " encoded"]
    latents: Float[Tensor, "encoded tokens dim"]

    @classmethod
    def of(cls, energies: Energies, recording: Recording, reporter: Reporter) -> _Seen:
        step = math.ceil(recording.frames / _MOST_ENCODED)
        frames = np.unique(np.append(np.arange(0, recording.frames, step), recording.frames - 1))
        latents = energies.latents(recording.read, frames.tolist(), reporter.task("encoding frames"))
        return cls(energies, recording, frames, latents)

    def key_frames(self, apart: int) -> tuple[KeyFrame, ...]:
        least = max(1, math.ceil(apart / int(self.frames[1] - self.frames[0])))
        found = latent_key_frames(
            len(self.frames), lambda goal: self.energies.between(self.latents, self.latents[goal]), least
        )
        frames = [int(self.frames[key.frame]) for key in found]
        return tuple(KeyFrame(frame, _name(frame, self.recording.frames)) for frame in frames)

    def course(self, goals: Sequence[int], stride: int) -> EnergyCourse:
        """Return the energies of all frames to the goal that applies then: the next key frame."""
        begins = [0, *goals[:-1]]
        before = [max(begin, goal - stride) for begin, goal in zip(begins, goals, strict=True)]
        taken = self.energies.latents(self.recording.read, [*begins, *before, *goals])
        began, step_before, wanted = taken.split(len(goals))  # type: ignore[no-untyped-call]  # torch
        places = np.searchsorted(goals, self.frames).clip(max=len(goals) - 1)
        energy = np.empty(len(self.frames))
        for place, goal in enumerate(wanted):
            energy[places == place] = self.energies.between(self.latents[np.flatnonzero(places == place)], goal)
        ends = (self.energies.between(one, wanted) for one in (began, step_before))
        return EnergyCourse(self.frames, energy, *(tuple(one.tolist()) for one in ends))


def _name(frame: int, frames: int) -> str:
    return "end" if frame == frames - 1 else f"frame {frame}"


def _keys(recording: Recording, options: KeyFrameOptions, seen: _Seen | None) -> tuple[KeyFrame, ...]:
    if options.by == "latent" and seen is not None:
        return seen.key_frames(options.apart or _APART * options.stride)
    if options.by == "every":
        return every_key_frame(recording.frames, options.every or 1)
    if recording.states is None:
        raise ValueError("no states, and no way without them")  # it was refused before
    rule = StillRule() if options.apart is None else StillRule(apart=options.apart)
    return gripper_key_frames(recording.states, rule)


def _noise(
    energies: Energies, recording: Recording, gap: int, still: Recording | None, reporter: Reporter
) -> NoiseFloor | None:
    progress = reporter.task("encoding frames of a resting arm")
    if still is not None:
        return energies.noise(still.read, np.ones(still.frames - 1, dtype=bool), gap, progress)
    if recording.states is None:
        return None
    return energies.noise(recording.read, resting(recording.states), gap, progress)
