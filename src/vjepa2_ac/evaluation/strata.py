"""Strata of steps by difficulty: steps grouped by how the robot moves and how far, from the true action."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.evaluation.result import Clips, Stratum
from vjepa2_ac.geometry import matrices_from_euler
from vjepa2_ac.spaces import ActionSpace

SPEED_CM_S = 2.0  # of the flange; slower, and
TURN_DEGREES_S = 10.0  # turning slower, and
GRIP = 0.05  # closing or opening by less than this share in a model step: idle
_IDLE_SHARE = 0.1  # of the 95th percentile of the norm, where actions are no poses
_PARTS = 3


def clips_of(
    actions: Float[np.ndarray, "clips horizon action_dim"],
    episode_ids: tuple[str, ...],
    starts: tuple[int, ...],
    *,
    space: ActionSpace,
    seconds_per_step: float,
) -> Clips:
    """Return the clips with the size of their actions, and which of their steps move.

    Args:
        actions: Of the space.
        episode_ids: Of each clip.
        starts: First control step of each.
        space: Of the actions.
        seconds_per_step: Length of a model step.
    """
    size = space.shown_size(actions)
    if space.position is None or space.rotation is None or space.gripper is None:
        least = _IDLE_SHARE * float(np.percentile(size, 95))
        words = f"the norm of the action is {least:.3g} or more, a tenth of its 95th percentile"
        return Clips(episode_ids, starts, size, size >= max(least, np.finfo(float).tiny), words)
    moves = size >= SPEED_CM_S * seconds_per_step
    turns = _angles(actions[..., space.rotation]) >= TURN_DEGREES_S * seconds_per_step
    grips = np.abs(actions[..., space.gripper]) >= GRIP
    words = (
        f"the flange moves at {SPEED_CM_S:g} cm/s or more, or turns at {TURN_DEGREES_S:g} degrees/s or more, or the"
        f" gripper opens or closes by {GRIP:.0%} or more in the step"
    )
    return Clips(episode_ids, starts, size, moves | turns | grips, words)


def strata_of(clips: Clips, space: ActionSpace) -> tuple[Stratum, ...]:
    """Return moving and idle steps, then thirds by the size of the action; empty strata are left out."""
    found = [Stratum("moving", "motion", clips.moving), Stratum("idle", "motion", ~clips.moving)]
    edges = np.quantile(clips.action_size, np.arange(1, _PARTS) / _PARTS)
    part = np.searchsorted(edges, clips.action_size, side="right")
    for number in range(_PARTS):
        steps = part == number
        if steps.any():
            found.append(Stratum(_range_of(clips.action_size[steps], space.shown_unit), "action size", steps))
    return tuple(stratum for stratum in found if stratum.steps.any())


def _range_of(sizes: Float[np.ndarray, " steps"], unit: str) -> str:
    form = ".1f" if unit else ".3g"
    return f"{sizes.min():{form}} to {sizes.max():{form}} {unit}".rstrip()


def _angles(rotations: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of each rotation in degrees."""
    traces = np.trace(matrices_from_euler(rotations), axis1=-2, axis2=-1)
    return np.asarray(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0))))
