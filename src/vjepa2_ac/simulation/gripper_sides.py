"""Does the imagined gripper open and close? Actions that were not taken, from held-out starts of simulated data.

From each start every model imagines `none`, `open` and `close`, and the simulator carries them out. Closedness is read
from the images around the fingers by a probe that was fitted on true frames. What counts is the difference to `none` at
the same step of the same source: a change since the start would reward blur, since a blurred gripper is read as half
open, which is the right side of both ends. A cell counts as right if the sign is that of the true difference: chance is
0.5, and a model that ignores its actions, whose difference is 0, is never right. Where the true closedness differs by
less than 0.25, because the gripper was open or closed already, no side is the true one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.evaluation.decoded.gripper import GripperProbe, fit_gripper_probe
from vjepa2_ac.evaluation.decoded.hand import HandPositions
from vjepa2_ac.evaluation.decoded_rollouts.setup import frames_of_training
from vjepa2_ac.intervals import Estimate, ratio
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.simulation.counterfactual_sides import (
    DECODED_TRUTH,
    Counterfactual,
    CounterfactualSetup,
    Side,
    SidesOptions,
    open_setup,
)
from vjepa2_ac.simulation.world.camera import FINGERS_MIDDLE_M

ACTIONS = ("open", "close")
TRUE_FRAMES = "true_frames"
LEAST_CLOSEDNESS = 0.25
_NONE, _GRIPPER = "none", 6


@dataclass(frozen=True)
class GripperCell:
    """One start under `open` or `close`, after each model step: differences of closedness to `none`."""

    episode_id: str
    start: int  # control step
    name: str  # of the action
    true: Float[np.ndarray, " steps"]  # measured by the simulator
    read: Mapping[str, Float[np.ndarray, " steps"]]  # source -> read from its images
    latent: Mapping[str, Float[np.ndarray, " steps"]]  # source -> inner product of its latents' difference and the true


@dataclass(frozen=True)
class Reading:
    """How well the probe reads a source whose closedness is known: of all true outcomes, start included."""

    error: float  # mean absolute, of closedness
    error_of_mean: float  # of always saying the mean of the frames on which the probe was fitted


@dataclass(frozen=True)
class GripperSides:
    """The cells of all starts, and what they were read with."""

    cells: tuple[GripperCell, ...]
    sources: tuple[str, ...]  # true frames: what the probe can do; decoded truth: what the decoder shows; models
    image_px: int
    probe_fitted_on: tuple[int, int]  # frames, episodes
    readings: Mapping[str, Reading]  # of true frames and decoded truth

    def of(self, source: str, action: str | None = None, step: int = -1) -> Side:
        """Return the count for one source, under an action (None: both), after a model step (-1: last)."""
        counted = self._counted(action, step)
        right = sum(bool(cell.read[source][step] * cell.true[step] > 0) for cell in counted)
        cells = sum(action in {None, cell.name} for cell in self.cells)
        return Side(right, len(counted), cells - len(counted))

    def extent(self, source: str, action: str | None = None, step: int = -1) -> Estimate | None:
        """Return the mean difference that is read over the true one, with an interval over episodes.

        1: as far as in truth; 0: not at all; below 0: the other way. None: no cell counts.
        """
        counted = self._counted(action, step)
        if not counted:
            return None
        true = np.array([cell.true[step] for cell in counted])
        read = np.array([cell.read[source][step] for cell in counted])
        return ratio(read * np.sign(true), np.abs(true), [cell.episode_id for cell in counted])

    def extent_in_latents(self, source: str, action: str | None = None, step: int = -1) -> Estimate | None:
        """Return how far the difference of latents goes along the true one: the same without decoder and probe.

        1: as far as in truth; 0: not at all. None: no cell counts, or the source has no latents.
        """
        counted = self._counted(action, step)
        if not counted or source not in counted[0].latent:
            return None
        along, whole = (np.array([cell.latent[one][step] for cell in counted]) for one in (source, DECODED_TRUTH))
        return ratio(along, whole, [cell.episode_id for cell in counted])

    def _counted(self, action: str | None, step: int) -> list[GripperCell]:
        return [cell for cell in self.cells if action in {None, cell.name} and _counts(cell, step)]


def measure_gripper(subject: str, asked: SidesOptions, *, reporter: Reporter = SILENT) -> GripperSides:
    """Measure a run, or a model with `asked.evaluation.data`, on held-out starts of simulated data.

    Raises:
        InputError: Subject, data or decoder cannot be used; the data were not simulated; or `planning.limits.gripper`
            is 0.
    """
    setup = open_setup(subject, asked, reporter)
    fingers = setup.positions(FINGERS_MIDDLE_M)
    probe = _fitted(setup, fingers)
    cells: list[GripperCell] = []
    states: list[Float[np.ndarray, "time 7"]] = []
    readings: list[Mapping[str, Float[np.ndarray, " time"]]] = []
    for cases in setup.counterfactuals((_NONE, *ACTIONS), reporter):
        read = {name: _read(case, fingers, probe) for name, case in cases.items()}
        cells += [_cell(cases, read, name) for name in ACTIONS]
        states += [case.outcome.states for case in cases.values()]
        readings += read.values()
    sources = (TRUE_FRAMES, *setup.sources)
    known = {
        source: _reading(np.concatenate([read[source] for read in readings]), np.concatenate(states), probe)
        for source in (TRUE_FRAMES, DECODED_TRUTH)
    }
    return GripperSides(tuple(cells), sources, setup.image_size, probe.fitted_on, known)


def _cell(
    cases: Mapping[str, Counterfactual], read: Mapping[str, Mapping[str, Float[np.ndarray, " time"]]], name: str
) -> GripperCell:
    """Return the differences between an action and none."""
    case, unmoved = cases[name], cases[_NONE]
    true = (case.outcome.states - unmoved.outcome.states)[1:, _GRIPPER]
    differences = {source: (values - read[_NONE][source])[1:] for source, values in read[name].items()}
    moved = {source: (latents - unmoved.latents[source])[1:].double() for source, latents in case.latents.items()}
    along = {source: (one * moved[DECODED_TRUTH]).sum(dim=(1, 2)).cpu().numpy() for source, one in moved.items()}
    return GripperCell(case.episode_id, case.start, name, true, differences, along)


def _reading(read: Float[np.ndarray, " frames"], states: Float[np.ndarray, "frames 7"], probe: GripperProbe) -> Reading:
    off = [float(np.abs(guess - states[:, _GRIPPER]).mean()) for guess in (read, probe.offset.numpy())]
    return Reading(*off)


def _fitted(setup: CounterfactualSetup, fingers: HandPositions) -> GripperProbe:
    images, centres, closedness, ids = [], [], [], []
    for seen, states, name in frames_of_training(setup.dataset, setup.image_size):
        images.append(seen)
        centres.append(fingers(name, states))
        closedness.append(states[:, _GRIPPER])
        ids += [name] * len(seen)
    return fit_gripper_probe(torch.cat(images), np.concatenate(centres), np.concatenate(closedness), ids)


def _read(case: Counterfactual, fingers: HandPositions, probe: GripperProbe) -> dict[str, Float[np.ndarray, " time"]]:
    """Return the closedness in the images of each source, where the fingers are at the start: the hand stays there."""
    centre = fingers(case.episode_id, case.outcome.states[:1])
    images = {TRUE_FRAMES: case.seen, **case.decoded}
    return {source: probe.read(shown, np.repeat(centre, len(shown), axis=0)) for source, shown in images.items()}


def _counts(cell: GripperCell, step: int) -> bool:
    return bool(abs(cell.true[step]) >= LEAST_CLOSEDNESS)
