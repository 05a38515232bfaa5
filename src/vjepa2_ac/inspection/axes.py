"""Calibrate the axes of a model: the angle about the vertical between its axes and those of the robot.

States and actions are rotated by angles from -180 to 165 degrees, about the robot's base and about the centre of the
motion. The result is the angle with the lowest prediction error for the next frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.action_use import Transition, make_transition
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.inspection.variants import load_named
from vjepa2_ac.intervals import Estimate, bootstrap, estimate_ratio
from vjepa2_ac.model.distances import squared_difference
from vjepa2_ac.model.lora import merge_adapter
from vjepa2_ac.planning.energy import AxesRotation
from vjepa2_ac.planning.settings import AXES_FORMAT, require_calibratable
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.storage.structured import utc_now

MAX_HALF_WIDTH_DEGREES = 15.0  # maximum half-width of the angle's interval with which the result is used
MIN_EPISODES = 2  # for an interval
ANGLES_DEGREES = tuple(range(-180, 180, 15))  # angles at which the error is measured
_NO_ROTATION = ANGLES_DEGREES.index(0)


@dataclass(frozen=True)
class AxisFit:
    """The rotation about z, counterclockwise from above, with which a model predicts the robot's motion best."""

    yaw_degrees: Estimate
    error: Estimate  # squared error of the next frame at the measured angle nearest to the yaw, relative to no rotation
    by_angle: tuple[float, ...]  # squared error at each of `ANGLES_DEGREES`, relative to no rotation
    pairs: int  # number of pairs of frames
    episodes: int
    centre_m: tuple[float, float]  # x, y of the centre of the rotation

    @property
    def problem(self) -> str | None:
        """Why the result cannot be used for planning; None if it can be used."""
        yaw, half_width = self.yaw_degrees, (self.yaw_degrees.high - self.yaw_degrees.low) / 2
        if self.episodes < MIN_EPISODES:
            return f"needs pairs from at least {MIN_EPISODES} episodes for an interval, found {self.episodes}"
        if _find_nearest_angle(yaw.value) != _NO_ROTATION and not self.error.high < 1.0:
            return f"no significant improvement: squared error {self.error} relative to no rotation"
        if not half_width <= MAX_HALF_WIDTH_DEGREES:
            return (
                f"uncertain: yaw {yaw.value:.0f} degrees, 95 % interval {yaw.low:.0f} to {yaw.high:.0f}"
                f" (needs a half-width of at most {MAX_HALF_WIDTH_DEGREES:g})"
            )
        return None

    def words(self) -> str:
        """Return the result as text, with the reason if it cannot be used for planning."""
        yaw, (x, y) = self.yaw_degrees, self.centre_m
        centre = f"the middle of its motion, x {x:.2f} y {y:.2f} m" if any(self.centre_m) else "its base"
        interval = f" (95 % interval {yaw.low:.0f} to {yaw.high:.0f})" if yaw.has_interval else ""
        text = (
            f"The model predicts best if the robot's motion is rotated by {yaw.value:+.1f} degrees about {centre}"
            f"{interval}: squared error {self.error} relative to no rotation"
            f" ({self.pairs} pairs of frames from {counted(self.episodes, 'episode')})."
        )
        return text if self.problem is None else f"{text} Not usable for planning: {self.problem}."

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers as plain values, for JSON."""
        return {
            "yaw_degrees": self.yaw_degrees.as_dict(),
            "error": self.error.as_dict(),
            "error_by_degrees": dict(zip(map(str, ANGLES_DEGREES), self.by_angle, strict=True)),
            "centre_m": list(self.centre_m),
            **{name: getattr(self, name) for name in ("pairs", "episodes", "problem")},
        }


def fit_axes(
    errors: Float[np.ndarray, "pairs angles"], episode_ids: Sequence[str], centre_m: tuple[float, float] = (0.0, 0.0)
) -> AxisFit:
    """Estimate the angle with the lowest error by a parabola through the lowest error and its two neighbours.

    Args:
        errors: Squared errors of the next frame at each of `ANGLES_DEGREES`.
        episode_ids: The episode of each pair; whole episodes are resampled for the intervals.
        centre_m: x, y of the centre of the rotation.
    """
    overall = _find_minimum(errors.sum(axis=0))

    def find_minima(sums: Float[np.ndarray, "1 *batch angles"]) -> Float[np.ndarray, "*batch 1"]:
        # Angles near 180 and -180 degrees must not be averaged, so that the minima are within 180 degrees of `overall`.
        return np.asarray((overall + _wrap_degrees(_find_minimum(sums[0]) - overall))[..., None])

    (yaw,) = bootstrap(find_minima, errors[None], episode_ids)
    return AxisFit(
        yaw_degrees=yaw,
        error=estimate_ratio(errors[:, _find_nearest_angle(yaw.value)], errors[:, _NO_ROTATION], episode_ids),
        by_angle=tuple((errors.sum(axis=0) / errors[:, _NO_ROTATION].sum()).tolist()),
        pairs=len(errors),
        episodes=len(set(episode_ids)),
        centre_m=centre_m,
    )


def _find_nearest_angle(degrees: float) -> int:
    return int(np.abs(_wrap_degrees(np.array(ANGLES_DEGREES) - degrees)).argmin())


def _find_minimum(errors: Float[np.ndarray, "*batch angles"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle in degrees at which the error is lowest, interpolated by a parabola."""
    index = errors.argmin(axis=-1)[..., None]
    before, lowest, after = (
        np.take_along_axis(errors, (index + step) % errors.shape[-1], axis=-1)[..., 0] for step in (-1, 0, 1)
    )
    curvature = before - 2 * lowest + after
    shift = np.divide(before - after, 2 * curvature, out=np.zeros_like(curvature), where=curvature > 0)
    step = ANGLES_DEGREES[1] - ANGLES_DEGREES[0]
    return np.asarray(_wrap_degrees(ANGLES_DEGREES[0] + step * (index[..., 0] + shift)))


def _wrap_degrees(degrees: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Wrap angles to -180 .. 180 degrees."""
    return np.asarray(np.remainder(degrees + 180.0, 360.0) - 180.0)


@torch.no_grad()
def infer_axes(
    model: Predictor, transitions: Sequence[Transition], at_once: int, progress: Progress = no_progress
) -> AxisFit:
    """Find the angle by which a model's axes are rotated relative to those of the robot.

    Args:
        model: The predictor.
        transitions: Transitions with poses in the robot's base frame; at least one.
        at_once: Samples per batch.
        progress: Called with the number of finished transitions.
    """
    # If the robot's mounting is rotated, states are rotated about the base. If the camera is rotated, they are rotated
    # about the point that it looks at, which is near the centre of the motion.
    x, y = np.mean([transition.state[:2].cpu().double().numpy() for transition in transitions], axis=0)
    centres = ((0.0, 0.0), (float(x), float(y)))
    errors = np.zeros((len(centres), len(transitions), len(ANGLES_DEGREES)))
    for number, transition in enumerate(transitions):
        for errors_of_centre, centre in zip(errors, centres, strict=True):
            errors_of_centre[number] = _measure_errors(model, transition, centre, at_once)
        progress(number + 1, len(transitions))
    best = int(errors.sum(axis=1).min(axis=1).argmin())
    return fit_axes(errors[best], [transition.episode_id for transition in transitions], centres[best])


def _measure_errors(
    model: Predictor, transition: Transition, centre_m: tuple[float, float], at_once: int
) -> Float[np.ndarray, " angles"]:
    """Return the mean squared error of the next frame with state and action rotated by each of `ANGLES_DEGREES`."""
    rotations = [AxesRotation(math.radians(angle), centre_m) for angle in ANGLES_DEGREES]
    states = torch.stack([rotation.rotate_poses(transition.state) for rotation in rotations])[:, None]
    actions = torch.stack([rotation.rotate_actions(transition.action) for rotation in rotations])[:, None]
    cameras = None
    if transition.extrinsics is not None:
        cameras = torch.stack([rotation.rotate_poses(transition.extrinsics) for rotation in rotations])[:, None]
    errors = []
    for first in range(0, len(rotations), at_once):
        part = slice(first, first + at_once)
        frames = transition.frame.expand(len(states[part]), 1, *transition.frame.shape)
        camera = None if cameras is None else cameras[part]
        predicted = model.predict(frames, actions[part], states[part], camera)
        errors.append(squared_difference(predicted[:, 0], transition.next_frame).mean(dim=(1, 2)))
    return torch.cat(errors).double().cpu().numpy()


def calibrate_axes(
    config: Config, model: str, *, pairs: int, split: Split = "validation", reporter: Reporter = SILENT
) -> tuple[AxisFit, dict[str, Any]]:
    """Fit the axes of a model to recorded pairs of frames, one model step apart.

    The model predicts as in planning: with trained weights merged, in the base model's dtype, without autocast.

    Args:
        config: The config with data and device.
        model: A model in a form that `model.base` accepts, or the folder of a run.
        pairs: Maximum number of pairs, spread over the episodes.
        split: The split of the data.
        reporter: Shows the progress of indexing, encoding and predicting.

    Rerotations:
        The fit, and the content of axes.json, by the schema in docs/planning_reference.md.

    Raises:
        InputError: The data or the model cannot be used, or the states have no axes.
    """
    require_calibratable(config.data)
    accelerator = make_accelerator(config)
    settings = config.data.model_copy(update={"frames": 2})
    dataset = open_dataset(settings, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
    world_model = load_named(config, dataset, model)
    fingerprints = world_model.fingerprints()
    if world_model.adaptation is not None:
        merge_adapter(world_model)
    world_model.to(accelerator.device).eval()
    transitions: list[Transition] = []
    encode = partial(encode_batch, world_model, device=accelerator.device)
    with torch.no_grad():
        for batch in validation_batches(dataset, split, clips=pairs, batch_size=config.validation.batch_size):
            latents = encode(batch)
            transitions += [make_transition(latents, row, 0) for row in range(len(batch.starts))]
    fit = infer_axes(
        world_model, transitions, config.planning.energy.samples_at_once, reporter.task("rotating the axes")
    )
    data = config.data
    return fit, {
        "format": AXES_FORMAT,
        "verdict": fit.words(),
        **fit.as_dict(),
        "model": {"subject": model, **fingerprints._asdict()},
        "data": {"path": data.path, "cameras": list(data.cameras), "stride": data.model_stride, "split": split},
        "version": __version__,
        "time": utc_now(),
    }
