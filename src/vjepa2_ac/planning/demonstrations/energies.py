"""Energies between frames of a demonstration, as the planner computes them, and their noise floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vjepa2_ac.data.windows import spread_with_ends
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.episode import FrameReader, Progress, no_progress
from vjepa2_ac.planning.energy import distance
from vjepa2_ac.planning.goals.folder import NoiseFloor
from vjepa2_ac.planning.goals.key_frames import resting_pairs
from vjepa2_ac.planning.session import PlanningSession

_AT_ONCE = 16  # frames that are read and encoded together
_MOST_PAIRS = 64
_UPPER = 0.95  # quantile of the energies between resting frames that is their floor


@dataclass(frozen=True)
class Energies:
    """What a session's model makes of frames: with its crop, its distance, and no mask."""

    session: PlanningSession

    def latents(
        self, read: FrameReader, frames: Sequence[int], progress: Progress = no_progress
    ) -> Float[Tensor, "frames tokens dim"]:
        """Return the latents of some frames; only so many pixels at a time are in memory."""
        model, crop, found = self.session.world_model, self.session.config.data.crop, []
        for start in range(0, len(frames), _AT_ONCE):
            part = frames[start : start + _AT_ONCE]
            found.append(encode_frames(model, read(part), crop))
            progress(min(start + _AT_ONCE, len(frames)), len(frames))
        return torch.cat(found)

    def between(
        self, seen: Float[Tensor, "frames tokens dim"], wanted: Float[Tensor, "*frames tokens dim"]
    ) -> Float[np.ndarray, " frames"]:
        """Return the energy of each frame to a wanted one, or to one of its own."""
        kind = self.session.config.planning.energy.distance
        return np.array([
            float(distance(one, to, kind)) for one, to in zip(seen, wanted.expand_as(seen), strict=True)
        ])  # fmt: skip

    def noise(
        self, read: FrameReader, rests: Bool[np.ndarray, " neighbours"], gap: int, progress: Progress = no_progress
    ) -> NoiseFloor | None:
        """Return the 95th percentile of energies between frames of a resting arm; None: it never rests.

        Args:
            read: Reads frames.
            rests: Of each frame but the last whether the arm rests until the next one.
            gap: Frames from one of a pair to the other.
            progress: Called with the number of encoded frames.
        """
        pairs = resting_pairs(rests, gap)
        if not len(pairs):
            return None
        taken = pairs[list(spread_with_ends(len(pairs), _MOST_PAIRS))]
        places = {frame: place for place, frame in enumerate(np.unique(taken).tolist())}
        latents = self.latents(read, list(places), progress)
        one, other = ([places[frame] for frame in taken[:, side].tolist()] for side in (0, 1))
        energies = self.between(latents[one], latents[other])
        kind = self.session.config.planning.energy.distance
        return NoiseFloor(float(np.quantile(energies, _UPPER)), len(taken), self.session.encoder, kind)
