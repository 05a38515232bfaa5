"""What really happens, under any actions: rendered by the simulator that recorded the data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.transforms import frames_as_seen, view
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.explore.explorer import Explorer, Moment, Pixels, Place
from vjepa2_ac.media.images import decode_jpegs, encode_jpeg
from vjepa2_ac.planning.planner import Cancelled, SearchCancelledError
from vjepa2_ac.simulation.counterfactual import Resimulation, resimulate
from vjepa2_ac.simulation.record import JPEG_QUALITY, carry_out
from vjepa2_ac.simulation.rollout import send_action
from vjepa2_ac.storage.places import SIMULATION_FILE

_KEPT = 4  # arms, each at its own start


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """What is true at a place."""

    pixels: Pixels  # as the encoder sees it
    latents: Float[Tensor, "tokens dim"]
    state: Float[np.ndarray, " state_dim"]  # measured
    is_simulated: bool  # else recorded
    reached: bool = True  # whether the arm could do the last action


class Truth:
    """The truth of a place: recorded where the recording goes that way; else simulated, where the data were.

    Raises:
        InputError: The data were simulated otherwise than their `simulation.json` says.
    """

    def __init__(self, explorer: Explorer) -> None:
        config = explorer.dataset.config
        self._explorer, self._camera, self._folder = explorer, config.cameras[0], Path(config.path)
        self.is_simulated = (self._folder / SIMULATION_FILE).is_file()
        self._arms = lru_cache(maxsize=_KEPT)(self._arm)
        self._at: dict[tuple[int, int], Place] = {}  # where each arm is
        self._outcomes = lru_cache(maxsize=64)(self._outcome)
        self._cancelled: Cancelled = lambda: False

    def outcome(self, place: Place, cancelled: Cancelled = lambda: False) -> TrueFrame | None:
        """Return what is true at a place; None: it is unknown.

        Args:
            place: Where.
            cancelled: Asked before each simulated action.

        Raises:
            SearchCancelledError: It was cancelled.
        """
        self._cancelled = cancelled
        return self._outcomes(place)

    def _outcome(self, place: Place) -> TrueFrame | None:
        recorded = self._explorer.recorded(place)
        if recorded is not None:
            return _recorded(recorded)
        return self._simulated(place) if self.is_simulated else None

    @torch.no_grad()
    def _simulated(self, place: Place) -> TrueFrame:
        key, explorer = (place.episode, place.start), self._explorer
        simulation = self._arms(*key)
        arm, is_next = simulation.arm, self._at.pop(key, None) == place.before
        if not is_next:
            carry_out(arm, simulation.number, simulation.spec, until=place.start)
        reached = True
        for action in place.actions[-1:] if is_next else place.actions:
            if self._cancelled():
                raise SearchCancelledError
            reached = send_action(arm, np.array(action), explorer.stride)
        self._at[key] = place
        image = encode_jpeg(arm.image(simulation.camera), quality=JPEG_QUALITY)  # as those of the data set
        frames, crop = decode_jpegs([image], [0], "a simulated frame"), explorer.dataset.config.crop
        with explorer.autocast():
            latents = encode_frames(explorer.world_model, frames, crop)[0]
        pixels = frames_as_seen(view(frames, crop), explorer.world_model.image_size)[0]
        return TrueFrame(pixels, latents, arm.state, is_simulated=True, reached=reached)

    def _arm(self, episode: int, start: int) -> Resimulation:
        """Return the simulation of an episode at a start."""
        explorer = self._explorer
        self._at.pop((episode, start), None)
        recording = explorer.dataset.source.read(explorer.episodes[episode], self._camera)
        return resimulate(self._folder, recording, start, self._camera)


def _recorded(moment: Moment) -> TrueFrame:
    return TrueFrame(moment.pixels, moment.latents, moment.state, is_simulated=False)
