"""Turned errors: how well a model predicts the next frame where it is given state and action turned by each angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.distances import squared_difference
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart
from vjepa2_ac.evaluation.axis_fit import TRIED_DEGREES
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.planning.axes.mapping import Axes


@torch.no_grad()
def turned_errors(
    model: Predictor, starts: Sequence[RolloutStart], centre_m: tuple[float, float] = (0.0, 0.0), *, at_once: int
) -> Float[np.ndarray, "starts angles"]:
    """Return the mean squared error of the next frame at each angle of `TRIED_DEGREES`, with the executed action.

    Args:
        model: The predictor.
        starts: Of poses in the robot's base frame.
        centre_m: x, y about which is turned.
        at_once: Samples per batch.
    """
    return np.stack([_errors(model, start, centre_m, at_once) for start in starts])


def turned(start: RolloutStart, axes: Axes) -> RolloutStart:
    """Return a start as a model of these axes sees it."""
    return replace(
        start,
        state=axes.poses(start.state),
        action=axes.actions(start.action),
        extrinsics=None if start.extrinsics is None else axes.poses(start.extrinsics),
    )


def _errors(
    model: Predictor, start: RolloutStart, centre_m: tuple[float, float], at_once: int
) -> Float[np.ndarray, " angles"]:
    seen = [turned(start, Axes(math.radians(angle), centre_m)) for angle in TRIED_DEGREES]
    errors = []
    for first in range(0, len(seen), at_once):
        part = seen[first : first + at_once]
        states, actions = (torch.stack([getattr(one, name) for one in part])[:, None] for name in ("state", "action"))
        cameras = [one.extrinsics for one in part if one.extrinsics is not None]
        frames = start.frame.expand(len(part), 1, *start.frame.shape)
        predicted = model.predict(frames, actions, states, torch.stack(cameras)[:, None] if cameras else None)
        errors.append(squared_difference(predicted[:, 0], start.following).mean(dim=(1, 2)))
    return torch.cat(errors).double().cpu().numpy()
