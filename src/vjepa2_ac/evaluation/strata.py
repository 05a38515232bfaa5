"""Strata of steps by difficulty: steps grouped by how the robot moves and how far, from the true action."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.evaluation.result import Clips, Stratum
from vjepa2_ac.geometry import matrices_from_euler

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
    is_pose: bool,
    seconds_per_step: float,
) -> Clips:
    """Return the clips with the size of their actions, and which of their steps move.

    Args:
        actions: In the units of `vjepa2_ac.episode`.
        episode_ids: Of each clip.
        starts: First control step of each.
        is_pose: The actions are of poses; else they are plain numbers.
        seconds_per_step: Length of a model step.
    """
    if not is_pose:
        size = np.linalg.norm(actions, axis=-1)
        least = _IDLE_SHARE * float(np.percentile(size, 95))
        words = f"the norm of the action is {least:.3g} or more, a tenth of its 95th percentile"
        return Clips(episode_ids, starts, size, size >= max(least, np.finfo(float).tiny), words)
    size = np.linalg.norm(actions[..., :3], axis=-1) * 100
    moves = size >= SPEED_CM_S * seconds_per_step
    turns = _angles(actions[..., 3:6]) >= TURN_DEGREES_S * seconds_per_step
    grips = np.abs(actions[..., 6]) >= GRIP
    words = (
        f"the flange moves at {SPEED_CM_S:g} cm/s or more, or turns at {TURN_DEGREES_S:g} degrees/s or more, or the"
        f" gripper opens or closes by {GRIP:.0%} or more in the step"
    )
    return Clips(episode_ids, starts, size, moves | turns | grips, words)


def strata_of(clips: Clips, *, is_pose: bool) -> tuple[Stratum, ...]:
    """Return moving and idle steps, then thirds by the size of the action; empty strata are left out."""
    found = [Stratum("moving", "motion", clips.moving), Stratum("idle", "motion", ~clips.moving)]
    edges = np.quantile(clips.action_size, np.arange(1, _PARTS) / _PARTS)
    part = np.searchsorted(edges, clips.action_size, side="right")
    for number in range(_PARTS):
        steps = part == number
        if steps.any():
            found.append(Stratum(_range_of(clips.action_size[steps], is_pose=is_pose), "action size", steps))
    return tuple(stratum for stratum in found if stratum.steps.any())


def _range_of(sizes: Float[np.ndarray, " steps"], *, is_pose: bool) -> str:
    form, unit = (".1f", " cm") if is_pose else (".3g", "")
    return f"{sizes.min():{form}} to {sizes.max():{form}}{unit}"


def _angles(rotations: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of each rotation in degrees."""
    traces = np.trace(matrices_from_euler(rotations), axis1=-2, axis2=-1)
    return np.asarray(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0))))
