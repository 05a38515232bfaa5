"""Calibration of axes: how the axes in which a model infers moves lie to those in which a robot executes them.

Two measurements of one angle: that at which the model predicts best, and that of a fit. Planning takes the first.

Source: of the fit, arXiv 2506.09985, appendix B.4: moves that the model infers are fitted to executed ones by linear
least squares, and the angle is that of the rotation nearest to the fitted matrix.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.config.component import Component
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.distributed import make_accelerator, shared
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.action_use import RolloutStart, evaluate_actions, start_of
from vjepa2_ac.evaluation.calibration.variants import load_named
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.result import Row
from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio
from vjepa2_ac.model.adapter.lora import merge_adapter
from vjepa2_ac.model.distances import squared_difference
from vjepa2_ac.planning.axes import AXES_FORMAT, Axes, require_axes_in
from vjepa2_ac.planning.planner import Planner
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.storage.structured import utc_now

MOST_CONDITION = 10.0  # beyond it, one direction is hardly inferred, or hardly executed
MOST_YAW_DEGREES = 15.0  # half the width of the interval of an angle that is known
EPISODES_NEEDED = 2  # for an interval
TRIED_DEGREES = tuple(range(-180, 180, 15))
_ESTIMATES: dict[str, tuple[str, str, float | None]] = {  # of a fit: name, format, and value by chance
    "yaw_degrees": ("yaw, degrees", ".0f", None),
    "error": ("error at it / unturned", ".3f", 1.0),
    "fitted_yaw_degrees": ("fitted yaw", ".0f", None),
    "gain": ("gain", ".3f", 0.0),
    "condition": ("condition", ".1f", None),
    "residual_cm": ("off by, cm", ".1f", None),
}


@dataclass(frozen=True)
class AxisFit:
    """The least-squares fit inferred = matrix @ executed over pairs of frames, in the robot's base frame."""

    matrix: Float[np.ndarray, "3 3"]
    yaw_degrees: Estimate  # about z, counterclockwise from above: at which the model predicts best
    fitted_yaw_degrees: Estimate  # of the rotation nearest to the matrix's horizontal 2 x 2 block
    error: Estimate  # squared error of the next frame at the yaw, over that of what is not turned
    gain: Estimate  # square root of that block's determinant: inferred length over executed length
    condition: Estimate  # largest over smallest singular value of the matrix
    residual_cm: Estimate  # mean |inferred - matrix @ executed|
    executed: Float[np.ndarray, "pairs 3"]  # metres
    inferred: Float[np.ndarray, "pairs 3"]
    episodes: int
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y about which states are turned by the yaw

    @property
    def pairs(self) -> int:
        """How many pairs it was fitted to."""
        return len(self.executed)

    @property
    def problem(self) -> str | None:
        """Why nothing can be planned by it, as text; None: it can."""
        yaw, half = self.yaw_degrees, (self.yaw_degrees.high - self.yaw_degrees.low) / 2
        if self.episodes < EPISODES_NEEDED:
            return f"pairs of {self.episodes} episode, and an interval needs {EPISODES_NEEDED}"
        if not self.condition.high <= MOST_CONDITION:
            return f"ill-conditioned: condition {self.condition}, and above {MOST_CONDITION:g} a direction is unknown"
        if not np.linalg.det(self.matrix) > 0:
            return "mirrored axes: an image that is flipped, or a model that does not use the actions"
        if not (self.error.value == 1.0 or self.error.high < 1.0):  # 1: the nearest angle tried is 0
            return f"no better than none: squared error {self.error} of that without a turn"
        if not half <= MOST_YAW_DEGREES:
            return f"uncertain: yaw {yaw.value:.0f} degrees, 95 % interval {yaw.low:.0f} to {yaw.high:.0f}"
        return None

    def words(self) -> str:
        """Return as text where the axes lie, and whether they can be planned by."""
        yaw, (x, y) = self.yaw_degrees, self.centre_m
        place = f"the middle of its motion, x {x:.2f} y {y:.2f} m" if any(self.centre_m) else "its base"
        between = f" (95 % interval {yaw.low:.0f} to {yaw.high:.0f})" if yaw.has_interval else ""
        text = (
            f"Turned by {yaw.value:+.1f} degrees about {place}{between}, what the robot does is predicted best:"
            f" squared error {self.error} of that without a turn. The fit of inferred moves has yaw"
            f" {self.fitted_yaw_degrees.value:+.1f}, gain {self.gain}, condition {self.condition}"
            f" ({self.pairs} pairs of {counted(self.episodes, 'episode')}, mean error {self.residual_cm.value:.1f} cm)."
        )
        return text if self.problem is None else f"{text} Not to plan by: {self.problem}."

    def rows(self, model: str) -> list[Row]:
        """Return the numbers as rows of an evaluation."""
        group, found = f"Axes of inferred moves ({self.pairs} pairs)", []
        for field, (name, form, chance) in _ESTIMATES.items():
            one: Estimate = getattr(self, field)
            key, detail = f"axes.{field}", field == "residual_cm"
            found.append(Row(group, name, key, model, one.value, one.low, one.high, form, "", chance, detail=detail))
        if self.problem is not None:
            found.append(Row(group, "not to plan by", "axes.problem", model, math.nan, note=self.problem, detail=True))
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers but the pairs as plain values, for JSON."""
        return {
            **{name: getattr(self, name).as_dict() for name in _ESTIMATES},
            "centre_m": list(self.centre_m),
            "matrix": self.matrix.tolist(),
            **{name: getattr(self, name) for name in ("pairs", "episodes", "problem")},
        }


def _yaw_of_least_error(errors: Float[np.ndarray, "pairs angles"], episode_ids: Sequence[str]) -> Estimate:
    """Return the angle of least error in degrees: of a parabola through the least of the tried ones and those beside.

    Args:
        errors: Squared errors at each of `TRIED_DEGREES`.
        episode_ids: Of each pair.
    """
    nearby = _least(errors.sum(axis=0))

    def of_sums(sums: Float[np.ndarray, "1 *batch angles"]) -> Float[np.ndarray, "*batch 1"]:
        return np.asarray((nearby + _wrapped(_least(sums[0]) - nearby))[..., None])

    return bootstrapped(of_sums, errors[None], episode_ids)[0]


def fit_axes(
    inferred: Float[np.ndarray, "pairs 3"],
    executed: Float[np.ndarray, "pairs 3"],
    errors: Float[np.ndarray, "pairs angles"],
    episode_ids: Sequence[str],
    centre_m: tuple[float, float] = (0.0, 0.0),
) -> AxisFit:
    """Fit inferred = matrix @ executed, with intervals from resampling whole episodes.

    Args:
        inferred: Moves (dx, dy, dz) in metres that a model infers from pairs of frames.
        executed: Those that the robot made.
        errors: Squared errors at each of `TRIED_DEGREES`.
        episode_ids: Of each pair.
        centre_m: x, y about which states were turned.
    """
    products = np.concatenate(
        [np.einsum("ni,nj->nij", one, executed).reshape(-1, 9) for one in (inferred, executed)], axis=1
    )
    matrix = _matrix(products.sum(axis=0))
    nearby = _yaw(matrix)

    def of_sums(sums: Float[np.ndarray, "1 *batch 18"]) -> Float[np.ndarray, "*batch 3"]:
        fitted = _matrix(sums[0])
        flat = np.sqrt(np.abs(np.linalg.det(fitted[..., :2, :2])))
        sizes = np.linalg.svd(fitted, compute_uv=False)
        return np.stack([nearby + _wrapped(_yaw(fitted) - nearby), flat, sizes[..., 0] / sizes[..., -1]], axis=-1)

    fitted_yaw, gain, condition = bootstrapped(of_sums, products[None], episode_ids)
    yaw = _yaw_of_least_error(errors, episode_ids)
    place = int(np.abs(_wrapped(np.array(TRIED_DEGREES) - yaw.value)).argmin())  # the nearest that was tried
    residuals = np.linalg.norm(inferred - executed @ matrix.T, axis=1)
    return AxisFit(
        matrix=matrix,
        yaw_degrees=yaw,
        fitted_yaw_degrees=fitted_yaw,
        error=ratio(errors[:, place], errors[:, TRIED_DEGREES.index(0)], episode_ids),
        gain=gain,
        condition=condition,
        residual_cm=mean_of(100 * residuals, episode_ids),
        executed=executed,
        inferred=inferred,
        episodes=len(set(episode_ids)),
        centre_m=centre_m,
    )


def _least(errors: Float[np.ndarray, "*batch angles"]) -> Float[np.ndarray, "*batch"]:
    place = errors.argmin(axis=-1)[..., None]
    before, least, after = (
        np.take_along_axis(errors, (place + step) % errors.shape[-1], axis=-1)[..., 0] for step in (-1, 0, 1)
    )
    bend = before - 2 * least + after
    shift = np.divide(before - after, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    step = TRIED_DEGREES[1] - TRIED_DEGREES[0]
    return np.asarray(_wrapped(TRIED_DEGREES[0] + step * (place[..., 0] + shift)))


def _wrapped(degrees: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Return angles within -180 .. 180: an interval may go across it."""
    return np.asarray(np.remainder(degrees + 180.0, 360.0) - 180.0)


def _matrix(sums: Float[np.ndarray, "*batch 18"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the least-squares matrix from the sums of the products of inferred and executed, executed and executed."""
    across, within = (part.reshape(*sums.shape[:-1], 3, 3) for part in np.split(sums, 2, axis=-1))
    return np.asarray(across @ np.linalg.pinv(within, hermitian=True))


def _yaw(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle in degrees of the rotation nearest to the horizontal block (its polar decomposition)."""
    sine, cosine = matrix[..., 1, 0] - matrix[..., 0, 1], matrix[..., 0, 0] + matrix[..., 1, 1]
    return np.asarray(np.degrees(np.arctan2(sine, cosine)))


def _turned(start: RolloutStart, axes: Axes) -> RolloutStart:
    """Return a start as a model of these axes sees it."""
    return replace(
        start,
        state=axes.poses(start.state),
        action=axes.actions(start.action),
        extrinsics=None if start.extrinsics is None else axes.poses(start.extrinsics),
    )


def _turned_errors(
    model: Predictor, start: RolloutStart, centre_m: tuple[float, float], at_once: int
) -> Float[np.ndarray, " angles"]:
    """Return the mean squared error of the next frame at each angle of `TRIED_DEGREES`, with the executed action."""
    seen = [_turned(start, Axes(math.radians(angle), centre_m)) for angle in TRIED_DEGREES]
    errors = []
    for first in range(0, len(seen), at_once):
        part = seen[first : first + at_once]
        states, actions = (torch.stack([getattr(one, name) for one in part])[:, None] for name in ("state", "action"))
        cameras = [one.extrinsics for one in part if one.extrinsics is not None]
        frames = start.frame.expand(len(part), 1, *start.frame.shape)
        predicted = model.predict(frames, actions, states, torch.stack(cameras)[:, None] if cameras else None)
        errors.append(squared_difference(predicted[:, 0], start.following).mean(dim=(1, 2)))
    return torch.cat(errors).double().cpu().numpy()


_ROOM = 1.25  # extent of the search along each axis, relative to the longest executed move
_LEAST_M = 0.01
_MOVE = slice(0, 3)
_SEARCH = PlanningConfig(samples=48, iterations=6, start_std=0.67, planner=Component("cem", {"elites": 6}))


@torch.no_grad()
def infer_axes(
    model: Predictor, starts: Sequence[RolloutStart], at_once: int, progress: Progress = no_progress
) -> AxisFit:
    """Find the angle by which a model's axes are turned, infer the moves of the starts, and fit them to the executed.

    A move is inferred from the state turned by the angle: a model that is given the state in axes not its own takes it
    for another place (docs/planning_reference.md has what this changes).

    Args:
        model: The predictor.
        starts: Of poses in the robot's base frame; one or more.
        at_once: Samples per batch.
        progress: Called with the number of finished starts.
    """
    names = [start.episode_id for start in starts]
    # A robot that is mounted turned is turned about its base; a camera, rather about what it looks at: the middle of
    # the motion.
    x, y = np.mean([_numbers(start.state)[:2] for start in starts], axis=0)
    places = ((0.0, 0.0), (float(x), float(y)))

    def turned(start: RolloutStart) -> list[np.ndarray]:
        return [_turned_errors(model, start, place, at_once) for place in places]

    tried = dict(zip(places, np.stack(shared(starts, turned, no_progress), axis=1), strict=True))
    centre_m = min(places, key=lambda place: tried[place].sum(axis=0).min())
    errors = tried[centre_m]
    axes = Axes(math.radians(_yaw_of_least_error(errors, names).value), centre_m)
    executed = np.stack([start.true[_MOVE] for start in starts])
    reach = min(1.0, max(_LEAST_M, _ROOM * float(np.linalg.norm(executed, axis=1).max())))
    limits = LimitsConfig(xyz=(reach, reach, reach), gripper_mode="held")
    planner = Planner(_SEARCH.model_copy(update={"limits": limits}))
    inferred = shared(starts, lambda start: _inferred(model, _turned(start, axes), planner, at_once), progress)
    return fit_axes(np.stack(inferred), executed, errors, names, centre_m)


def _inferred(model: Predictor, start: RolloutStart, planner: Planner, at_once: int) -> Float[np.ndarray, " 3"]:
    """Return the move (dx, dy, dz) that predicts the next frame best; the rest of the action is the true one."""

    def cost(actions: Float[Tensor, "samples 1 7"]) -> Float[Tensor, " samples"]:
        tried = np.tile(start.true, (len(actions), 1))
        tried[:, _MOVE] = actions[:, 0, _MOVE].double().numpy()
        return torch.from_numpy(evaluate_actions(model, start, tried, at_once=at_once)[0])

    drawn = int(start.generator(0).integers(2**62))
    return _numbers(planner.plan(cost, torch.Generator().manual_seed(drawn)).actions[0, _MOVE])


def _numbers(values: Tensor) -> Float[np.ndarray, " numbers"]:
    return values.detach().cpu().double().numpy()


def calibrate_axes(
    config: Config, model: str, *, pairs: int, split: Split = "validation", reporter: Reporter = SILENT
) -> tuple[AxisFit, dict[str, Any]]:
    """Fit the axes of a model to recorded pairs of frames, one model step apart.

    The model infers moves as it plans: with trained weights merged, in the base's type, without autocast.

    Args:
        config: The data, the device and the precision.
        model: What `model.base` takes, or the folder of a run.
        pairs: At most, spread over the episodes.
        split: Of the data.
        reporter: Shows the progress of indexing, encoding and inferring.

    Returns:
        The fit, and the content of axes.json, by the schema in docs/planning_reference.md.

    Raises:
        InputError: The data or the model cannot be used; or the states have no axes.
    """
    require_axes_in(config.data)
    accelerator = make_accelerator(config)
    settings = config.data.model_copy(update={"frames": 2})
    dataset = open_dataset(settings, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
    world_model = load_named(config, dataset, model)
    known = world_model.fingerprints()
    if world_model.adaptation is not None:
        merge_adapter(world_model)
    world_model.to(accelerator.device).eval()
    starts: list[RolloutStart] = []
    encode = partial(encode_batch, world_model, device=accelerator.device, chunk=config.model.encode_chunk)
    with torch.no_grad():
        for batch in validation_batches(dataset, split, clips=pairs, batch_size=config.validation.batch_size):
            latents = encode(batch)
            starts += [start_of(latents, row, 0) for row in range(len(batch.starts))]
    fit = infer_axes(world_model, starts, config.planning.energy.samples_at_once, reporter.task("inferring moves"))
    data = config.data
    return fit, {
        "format": AXES_FORMAT,
        "verdict": fit.words(),
        **fit.as_dict(),
        "model": {"subject": model, **known._asdict()},
        "data": {"path": data.path, "cameras": list(data.cameras), "stride": data.model_stride, "split": split},
        "version": __version__,
        "time": utc_now(),
    }
