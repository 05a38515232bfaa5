"""Counterfactuals: simulate the outcome of other actions in a recorded simulated episode.

The episode is simulated again up to a control step, and the state is compared with the recorded one. From this step the
arm carries out other actions as in closed loop (`rollout.send_action`, with the same targets and the same lag).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import decode_images, encode_jpeg
from vjepa2_ac.planning.planner import Cancelled, SearchCancelledError
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.record import JPEG_QUALITY, RecordingSpec, execute_episode, make_arm, read_simulation
from vjepa2_ac.simulation.rollout import send_action
from vjepa2_ac.storage.paths import SIMULATION_FILE

RECORDED_CAMERAS = {"exterior_1_left": "exterior_1", "exterior_2_left": "exterior_2", "wrist_left": "wrist"}
"""Camera of a data set, as in `data.fields.cameras` -> camera of the simulated arm."""

_CACHE_SIZE = 4  # number of cached resimulations of `explore`, each with another start
# Metres, radians, gripper position. Recorded states are float32, and library versions round differently.
_STATE_TOLERANCE = 1e-5

Actions = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Outcome:
    """The simulated outcome of actions, rendered and measured at the start and after every model step."""

    frames: UInt8[np.ndarray, "time height width 3"]  # compressed as JPEG, like those of the data set
    silhouettes: Bool[np.ndarray, "time height width"]  # which pixels show the arm, the block or moving objects
    states: Float[np.ndarray, "time 7"]  # measured
    reached: Bool[np.ndarray, " time-1"]  # whether the arm reached the target of each action


@dataclass(eq=False)
class Resimulation:
    """A recorded episode, simulated again up to a control step at which outcomes start. Created by `resimulate`."""

    spec: RecordingSpec
    number: int  # number of the episode in its recording
    start: int  # control step
    camera: str  # camera of the simulated arm
    arm: SimulatedArm
    executed: Actions | None = None  # actions from the start to the arm's current state; None: the state is unknown

    def simulate(self, actions: Float[np.ndarray, "steps 7"], stride: int) -> Outcome:
        """Carry out actions from the start, each relative to the measured state, and return the outcome.

        Args:
            actions: One action per model step (conventions: episode.py); may be empty.
            stride: Control steps per model step.
        """
        arm = self.arm
        self.executed = None
        execute_episode(arm, self.number, self.spec, until=self.start)

        def observe() -> tuple[Any, ...]:
            return arm.image(self.camera), arm.silhouette(self.camera), arm.state

        observations, reached = [observe()], []
        for action in actions:
            reached.append(send_action(arm, np.asarray(action, dtype=np.float64), stride))
            observations.append(observe())
        images, silhouettes, states = zip(*observations, strict=True)
        encoded = [encode_jpeg(image, quality=JPEG_QUALITY) for image in images]
        return Outcome(
            frames=decode_images(encoded, range(len(encoded)), "a simulated frame"),
            silhouettes=np.stack(silhouettes),
            states=np.stack(states),
            reached=np.array(reached, bool),
        )


def resimulate(folder: str | Path, episode: Episode, start: int, camera: str = "exterior_1_left") -> Resimulation:
    """Simulate a recorded episode again up to a control step, and check that the state equals the recorded one.

    Args:
        folder: Folder of the data set, with its `simulation.json`.
        episode: The recorded episode, with poses as states.
        start: Control step at which outcomes start.
        camera: A camera of the data set, as in `data.fields.cameras`.

    Raises:
        InputError: The data set was not simulated or has no `simulation.json`; there is no such episode, step or
            camera; or the state differs from the recorded one.
        UnreachableError: MuJoCo is not installed.
    """
    simulation, where = read_simulation(folder), f"{folder}: {episode.info.id}"
    number, steps = simulation.number_of(episode.info.id), simulation.steps
    if not 0 <= start < steps:
        raise InputError(where=where, found=f"control step {start}", needed=f"0 to {steps - 1}")
    if camera not in RECORDED_CAMERAS:
        raise InputError(where=where, found=f"camera {camera!r}", needed=f"one of {', '.join(RECORDED_CAMERAS)}")
    if episode.states.shape != (steps, 7):
        shape, needed = "x".join(map(str, episode.states.shape)), f"{steps}x7, as simulated: data.states: pose"
        raise InputError(where=where, found=f"states of {shape} numbers", needed=needed)
    # A recording with fewer cameras repeats the image of the first camera.
    arm_camera = RECORDED_CAMERAS[camera] if simulation.cameras == 3 else "exterior_1"
    resimulation = Resimulation(simulation, number, start, arm_camera, make_arm(number, simulation))
    state = resimulation.simulate(np.zeros((0, 7)), 1).states[0]
    difference = np.abs(state - np.asarray(episode.states[start], dtype=np.float64))
    difference[3:6] = np.minimum(difference[3:6], np.abs(2 * np.pi - difference[3:6]))  # -pi and pi are the same angle
    if difference.max() > _STATE_TOLERANCE:
        problem = f"the resimulated state differs by up to {difference.max():.2g}"
        fix = f"Install the library versions that {SIMULATION_FILE} names, or record the data set again"
        raise InputError(where=f"{where}: control step {start}", found=problem, needed="the recorded state", fix=fix)
    return resimulation


def simulated_outcome(dataset: Dataset, episode: int, start: int) -> Callable[[np.ndarray], tuple[Any, Any]] | None:
    """Return a function that simulates actions from a control step on; None if the data were not simulated.

    The function returns the frames and the silhouettes.

    Raises:
        InputError, UnreachableError: As for `resimulate`.
    """
    if not Path(dataset.config.path, SIMULATION_FILE).is_file():
        return None
    arm = _resimulate_dataset(dataset, episode, start)

    def outcome(actions: np.ndarray) -> tuple[Any, Any]:
        simulated = arm.simulate(actions, dataset.config.model_stride)
        return simulated.frames, simulated.silhouettes

    return outcome


def _resimulate_dataset(dataset: Dataset, episode: int, start: int) -> Resimulation:
    path, camera = dataset.config.path, dataset.config.cameras[0]
    return resimulate(path, dataset.source.read(episode, camera), start, camera)


class SimulatedFutures:
    """Simulates recorded episodes with other actions from a control step on.

    Raises:
        InputError: A simulated state differs from the recorded one.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._stride = dataset.config.model_stride
        self._resimulated = lru_cache(maxsize=_CACHE_SIZE)(partial(_resimulate_dataset, dataset))

    @classmethod
    def of(cls, dataset: Dataset) -> SimulatedFutures | None:
        """Return the simulator of a data set; None if the data were not simulated."""
        return cls(dataset) if Path(dataset.config.path, SIMULATION_FILE).is_file() else None

    def __call__(
        self, episode: int, step: int, actions: Actions, cancelled: Cancelled
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, " 7"], bool]:
        """Return frame and state after actions, and whether the arm reached the target of the last action.

        Args:
            episode: Index of the episode in the data set.
            step: Control step at which the actions start.
            actions: One action per model step.
            cancelled: Called before each action; returns whether to cancel.

        Raises:
            SearchCancelledError: `cancelled` returned True.
        """
        simulation = self._resimulated(episode, step)
        is_next, simulation.executed = bool(actions) and simulation.executed == actions[:-1], None
        if not is_next:
            execute_episode(simulation.arm, simulation.number, simulation.spec, until=step)
        is_reached = True
        for action in actions[-1:] if is_next else actions:
            if cancelled():
                raise SearchCancelledError
            is_reached = send_action(simulation.arm, np.array(action), self._stride)
        simulation.executed = actions
        image = encode_jpeg(simulation.arm.image(simulation.camera), quality=JPEG_QUALITY)  # as in the data set
        return decode_images([image], [0], "a simulated frame")[0], simulation.arm.state, is_reached
