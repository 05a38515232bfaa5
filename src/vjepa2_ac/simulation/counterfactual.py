"""Counterfactuals: what really happens in a recorded simulated episode under actions that were not taken.

The episode is simulated again up to a control step, and what is there is compared with what was recorded; from there
the arm carries out other actions as in the closed loop (`closed_loop.rollout.send_action`: same targets, same lag).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import decode_jpegs, encode_jpeg
from vjepa2_ac.simulation.closed_loop.rollout import send_action
from vjepa2_ac.simulation.recording.demonstration import arm_of, carry_out, put_at
from vjepa2_ac.simulation.recording.record import JPEG_QUALITY
from vjepa2_ac.simulation.recording.simulation_file import RecordedSimulation, other_versions, read_simulation
from vjepa2_ac.simulation.world.domains import Domain

RECORDED_CAMERAS = {"exterior_1_left": "exterior_1", "exterior_2_left": "exterior_2", "wrist_left": "wrist"}
"""Camera of a data set, as in `data.fields.cameras` -> camera of the simulated arm."""

_STATE_TOLERANCE = 1e-5  # metres, radians, closedness: recorded states are float32, other libraries round otherwise


@dataclass(frozen=True)
class Outcome:
    """What happened: rendered and measured at the start and after every model step."""

    frames: UInt8[np.ndarray, "time height width 3"]  # through JPEG, as those of the data set
    states: Float[np.ndarray, "time 7"]  # measured
    blocks: Float[np.ndarray, "time 4"] | None  # x, y, z, rotation about z in the robot base frame; None: no block
    reached: Bool[np.ndarray, " time-1"]  # whether joint angles reach each action's target; else the arm went part way


class Resimulation:
    """A recorded episode at a control step, simulated again; every outcome begins there. Use `resimulate` to make one.

    Args:
        simulation: How the data set was recorded.
        number: Under which the episode was recorded.
        start: Control step.
        camera: Of the data set: one of `RECORDED_CAMERAS`.
    """

    def __init__(self, simulation: RecordedSimulation, number: int, start: int, camera: str) -> None:
        self._spec, self._number, self.start = simulation.spec, number, start
        self._camera = camera_of(simulation, camera)
        self._arm = arm_of(number, simulation.spec)

    @property
    def domain(self) -> Domain:
        """The episode's world, for `world.projection.hand_pixels`."""
        return self._arm.domain

    @property
    def camera(self) -> str:
        """The camera of the simulated arm; the only one if the data set was recorded with one."""
        return self._camera

    def under(self, actions: Float[np.ndarray, "steps 7"], stride: int) -> Outcome:
        """Carry out actions of model steps (legend: episode.py), each from the state that is measured then.

        Args:
            actions: One for each model step; none: only the start.
            stride: Control steps of a model step.

        Raises:
            ValueError: Not 7 finite numbers each, or no stride.
        """
        actions = np.asarray(actions, dtype=np.float64)
        if actions.ndim != 2 or actions.shape[1] != 7 or not np.isfinite(actions).all() or stride < 1:
            raise ValueError(f"actions of shape {actions.shape}, stride {stride}: needed are steps x 7 finite numbers")
        return self._outcome([partial(send_action, self._arm, action, stride) for action in actions])

    def as_recorded(self, steps: int, stride: int) -> Outcome:
        """Carry out the commands of the recording itself: its frames and states at every `stride`-th control step.

        Raises:
            ValueError: The recording ends before.
        """
        if min(steps, stride - 1) < 0 or self.start + steps * stride >= self._spec.steps:
            raise ValueError(f"{steps} steps of {stride} from {self.start}: {self._spec.steps} were recorded")
        motion = carry_out(self._arm, self._number, self._spec)

        def follow(first: int) -> bool:
            for step in range(first, first + stride):
                self._arm.command_joints(motion.commanded_joints[step], float(motion.commanded_gripper[step]))
            return True

        firsts = range(self.start, self.start + steps * stride, stride)
        return self._outcome([partial(follow, first) for first in firsts])

    def _outcome(self, moves: list[Callable[[], bool]]) -> Outcome:
        """Return what happens if the arm moves so from the start; each move says whether it was completed."""
        arm = put_at(self._arm, self._number, self._spec, self.start)
        images, states, blocks, reached = [arm.image(self._camera)], [arm.state], [arm.block], []
        for move in moves:
            reached.append(move())
            images.append(arm.image(self._camera))
            states.append(arm.state)
            blocks.append(arm.block)
        found = [block for block in blocks if block is not None]
        return Outcome(
            _through_jpeg(images), np.stack(states), np.stack(found) if found else None, np.array(reached, bool)
        )


def camera_of(simulation: RecordedSimulation, camera: str) -> str:
    """Return the camera of the simulated arm that a camera of the data set is; recorded with one, all are the same."""
    return RECORDED_CAMERAS[camera] if simulation.spec.cameras == 3 else "exterior_1"


def resimulate(folder: str | Path, episode: Episode, start: int, camera: str = "exterior_1_left") -> Resimulation:
    """Simulate an episode of a recorded data set again up to a control step, and make sure that it is the same.

    Args:
        folder: Of the data set, with its `simulation.json`.
        episode: As its source reads it.
        start: Control step from which other actions are taken.
        camera: Of the data set, as in `data.fields.cameras`.

    Raises:
        InputError: The data set was not simulated, or does not say how; it has no such episode, step or camera; or the
            simulation comes to another state than was recorded. Or MuJoCo is missing.
    """
    simulation = read_simulation(folder)
    number, steps = simulation.number_of(episode.info.id), simulation.spec.steps
    where = f"{folder}: {episode.info.id}"
    if episode.info.num_steps != steps:
        raise InputError(where=where, found=f"{episode.info.num_steps} control steps", needed=f"{steps}, as simulated")
    if not 0 <= start < steps:
        raise InputError(where=where, found=f"control step {start}", needed=f"0 to {steps - 1}")
    if camera not in RECORDED_CAMERAS:
        raise InputError(where=where, found=f"camera {camera!r}", needed=f"one of {', '.join(RECORDED_CAMERAS)}")
    again = Resimulation(simulation, number, start, camera)
    _require_same(again.under(np.zeros((0, 7)), 1), episode, start, f"{where}: control step {start}", simulation)
    return again


def _require_same(outcome: Outcome, episode: Episode, start: int, where: str, simulation: RecordedSimulation) -> None:
    """Refuse a simulation that does not show what was recorded."""
    recorded = np.asarray(episode.states[start], dtype=np.float64)
    needed = "what was recorded"
    if recorded.shape != (7,):
        found = f"a state of {recorded.size} numbers"
        raise InputError(where=where, found=found, needed="a pose", fix="Open the data with data.states: pose")
    off = np.abs(outcome.states[0] - recorded)
    off[3:6] = np.minimum(off[3:6], np.abs(2 * np.pi - off[3:6]))  # -pi and pi are one angle
    fix = "Record it again with this version"
    if versions := other_versions(simulation):
        fix = f"{fix}; it was recorded with {versions}"
    if off.max() > _STATE_TOLERANCE:
        found = f"simulated again, the state differs by up to {off.max():.2g}"
        raise InputError(where=where, found=found, needed=needed, fix=fix)


def _through_jpeg(images: list[UInt8[np.ndarray, "height width 3"]]) -> UInt8[np.ndarray, "time height width 3"]:
    """Return images as a data set would give them back."""
    encoded = [encode_jpeg(image, quality=JPEG_QUALITY) for image in images]
    return decode_jpegs(encoded, range(len(encoded)), "a simulated frame")
