"""Clips whose loss or gradient is not finite: saved for inspection in RUN/not_finite/step-XXXXXXXX.

Each process saves its own: an npz per clip (frames, states, actions, episode_id, start) and one figure of all. Clips
from a latent cache have no frames: their latents are saved instead, as float32, and their film strip is blank.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.sources.latents.cache_files import unpack_latents
from vjepa2_ac.episode import Batch, StoredLatents
from vjepa2_ac.storage import atomic_writer

MOST_CLIPS = 16
MOST_BYTES = 512 * 10**6  # of frames, stored until the gradients are known to be finite


class ClipRecorder:
    """The micro-batches of a step, until it is known whether its gradients are finite."""

    def __init__(self) -> None:
        self._kept: list[tuple[Batch, Tensor]] = []
        self._bytes = 0

    def add(self, batch: Batch, loss: Float[Tensor, ""]) -> None:
        """Store a micro-batch and its loss, unless too much is stored already. Does not wait for the loss."""
        self._bytes += 0 if batch.frames is None else batch.frames.nbytes
        self._bytes += 0 if batch.latents is None else batch.latents.values.nbytes
        if self._bytes <= MOST_BYTES:
            self._kept.append((batch, loss.detach()))

    def save(self, folder: Path, process: int) -> str:
        """Write some clips, the suspicious ones first, and return where they are; or, if that fails, the reason.

        Nothing is raised: the error that is being reported is more important.

        Args:
            folder: RUN/not_finite/step-XXXXXXXX.
            process: The process of the clips.
        """
        try:
            chosen = self._most_suspicious()
            for number, (batch, place) in enumerate(chosen):
                _write(batch, place, folder / f"process{process}-clip{number:02d}.npz")
            _draw(chosen, folder / f"process{process}.png")
        except Exception as error:  # a full disk, no permission, a frame that cannot be drawn
            return f"they could not all be saved in {folder}: {type(error).__name__}: {error}"
        return f"{len(chosen)} of them are saved in {folder}"

    def _most_suspicious(self) -> list[tuple[Batch, int]]:
        """Return micro-batch and index of clips: those with numbers that are not finite, then by their loss."""
        found = []
        for batch, loss in self._kept:
            for place in range(len(batch.starts)):
                own = batch.states[place].isfinite().all() and batch.actions[place].isfinite().all()
                found.append((bool(own), bool(torch.isfinite(loss)), (batch, place)))
        found.sort(key=lambda entry: entry[:2])
        return [clip for *_, clip in found[:MOST_CLIPS]]


def _write(batch: Batch, place: int, path: Path) -> None:
    arrays: dict[str, Any] = {
        **_seen(batch, place),
        "states": batch.states[place].numpy(),
        "actions": batch.actions[place].numpy(),
        "episode_id": np.array(batch.episode_ids[place]),
        "start": np.array(batch.starts[place]),
    }
    with atomic_writer(path) as file:
        np.savez_compressed(file, **arrays)


def _seen(batch: Batch, place: int) -> dict[str, np.ndarray]:
    if batch.frames is not None:
        return {"frames": batch.frames[place].numpy()}
    if batch.latents is None:
        raise ValueError("a batch with neither frames nor latents")
    scales = None if batch.latents.scales is None else batch.latents.scales[place]
    return {"latents": unpack_latents(StoredLatents(batch.latents.values[place], scales)).numpy()}


def _draw(chosen: Sequence[tuple[Batch, int]], path: Path) -> None:
    from vjepa2_ac.reports.figures.clips import ClipFigure, plot_clips

    blank = np.full((1, 9, 16, 3), 224, np.uint8)
    figures = [
        ClipFigure(
            name=f"{batch.episode_ids[place]} from step {batch.starts[place]}",
            frames=_seen(batch, place).get("frames", blank),
            numbers={"states": batch.states[place].numpy(), "actions": batch.actions[place].numpy()},
        )
        for batch, place in chosen
    ]
    plot_clips(f"Clips of a step whose loss or gradient is not finite ({len(figures)})", figures, path)
