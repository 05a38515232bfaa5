"""What clips are like: strata of steps by how the robot moves, and examples of good and bad predictions as images."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.distances import absolute_difference
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.result import L1, Clips, Example, PredictionErrors, Stratum
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
    unit, form = space.shown_unit, ".1f" if space.shown_unit else ".3g"
    for number in range(_PARTS):
        if (steps := part == number).any():
            sizes = clips.action_size[steps]
            name = f"{sizes.min():{form}} to {sizes.max():{form}} {unit}".rstrip()
            found.append(Stratum(name, "action size", steps))
    return tuple(stratum for stratum in found if stratum.steps.any())


def _angles(rotations: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of each rotation in degrees."""
    traces = np.trace(matrices_from_euler(rotations), axis1=-2, axis2=-1)
    return np.asarray(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0))))


def chosen_clips(errors: PredictionErrors, moved: Float[np.ndarray, " clips"], count: int) -> dict[int, str]:
    """Return which clips to show, and why: best, worst, median by L1 error over persistence, and most motion.

    Args:
        errors: Of the model.
        moved: Distance that the robot moves in each clip.
        count: Number of clips, at most.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        trained, nothing = (errors.of("rollout", L1, way).mean(axis=1) for way in ("true", "persistence"))
        ratios = trained / nothing
    order = np.argsort(np.nan_to_num(ratios, nan=np.inf, posinf=np.inf), kind="stable")
    wanted = {
        "most motion": int(np.argmax(moved)),
        "best": int(order[0]),
        "worst": int(order[-1]),
        "median": int(order[len(order) // 2]),
    }
    chosen: dict[int, str] = {}
    for why, clip in wanted.items():
        chosen[clip] = f"{chosen[clip]}, {why}" if clip in chosen else why
    return dict(list(chosen.items())[:count])


def make_example(
    why: str,
    batch: LatentBatch,
    row: int,
    predicted: Mapping[str, Float[Tensor, "horizon tokens dim"]],
    frames: UInt8[np.ndarray, "time height width 3"] | None,
) -> Example:
    """Return one clip as an example.

    Args:
        why: The reason for its choice.
        batch: The batch that holds it.
        row: Its row in the batch.
        predicted: Predictions of each model.
        frames: Its frames, if there are any.
    """
    true = batch.latents[row].float().cpu()
    grid = math.isqrt(true.shape[1])
    nothing = true[:1].expand_as(true[1:])

    def errors(values: Tensor) -> Float[np.ndarray, "horizon grid grid"]:
        of_patch = absolute_difference(values, true[1:]).mean(dim=-1)
        return rearrange(of_patch, "horizon (h w) -> horizon h w", h=grid).numpy()

    colours = Colours(true)
    return Example(
        why=why,
        episode_id=batch.episode_ids[row],
        start=batch.starts[row],
        frames=frames,
        errors={"persistence": errors(nothing)} | {name: errors(values) for name, values in predicted.items()},
        true_colours=colours.of(true),
        predicted_colours={name: colours.of(values) for name, values in predicted.items()},
    )


class Colours:
    """Turns latents into colours by the three principal components of some true latents: similar latents look similar.

    The 1st to 99th percentile of a component in the true latents is mapped to the range of its colour.
    """

    def __init__(self, true: Float[Tensor, "time tokens dim"]) -> None:
        flat = true.flatten(0, 1).double()
        self._mean = flat.mean(dim=0)
        centred = flat - self._mean
        _, vectors = torch.linalg.eigh(centred.T @ centred)
        basis = vectors[:, -3:].flip(1)  # the largest first
        largest = basis.gather(0, basis.abs().argmax(dim=0, keepdim=True))
        self._basis = basis * largest.sign()  # otherwise the sign would depend on the library
        seen = centred @ self._basis
        self._low, self._high = (torch.quantile(seen, share, dim=0) for share in (0.01, 0.99))

    def of(self, latents: Float[Tensor, "time tokens dim"]) -> UInt8[np.ndarray, "time grid grid 3"]:
        """Return the colours of latents."""
        seen = (latents.double() - self._mean) @ self._basis
        shown = ((seen - self._low) / (self._high - self._low).clamp(min=1e-9)).clamp(0, 1) * 255
        grid = math.isqrt(latents.shape[1])
        return np.asarray(rearrange(shown, "time (h w) c -> time h w c", h=grid).round().to(torch.uint8).numpy())
