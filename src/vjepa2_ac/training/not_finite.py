"""Clips whose loss or gradient is not finite, saved for inspection in RUN/not_finite/step-XXXXXXXX.

Each process saves its own: an npz per clip (frames, or the latents of a cache as float32; states, actions, episode_id,
start), and its frames side by side as a PNG.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.sources.latents.cache_files import unpack_latents
from vjepa2_ac.episode import Batch, StoredLatents
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.storage import atomic_writer, write_atomically

MOST_CLIPS = 16  # that are saved
MOST_BYTES = 512 * 10**6  # of frames, held until the gradients are known to be finite


class ClipRecorder:
    """The micro-batches of a step, until it is known whether its gradients are finite."""

    def __init__(self) -> None:
        self._kept: list[tuple[Batch, Tensor]] = []
        self._bytes = 0

    def add(self, batch: Batch, loss: Float[Tensor, ""]) -> None:
        """Store a micro-batch and its loss, unless too much is stored already. Does not wait for the loss."""
        self._bytes += batch.nbytes
        if self._bytes <= MOST_BYTES:
            self._kept.append((batch, loss.detach()))

    def save(self, folder: Path, process: int) -> str:
        """Write some clips, those with numbers that are not finite first; return where they are, or what failed.

        Nothing is raised: the error that is being reported is more important.
        """
        clips = [(batch, row, loss) for batch, loss in self._kept for row in range(len(batch.starts))]
        clips.sort(key=lambda clip: (_is_finite(*clip[:2]), bool(torch.isfinite(clip[2]))))
        try:
            for number, (batch, row, _) in enumerate(clips[:MOST_CLIPS]):
                path = folder / f"process{process}-clip{number:02d}.npz"
                with atomic_writer(path) as file:
                    np.savez_compressed(file, **_arrays(batch, row))
                if batch.frames is not None:
                    strip = np.concatenate(batch.frames[row].numpy(), axis=1)
                    write_atomically(path.with_suffix(".png"), encode_png(strip))
        except Exception as error:  # a full disk, no permission
            return f"they could not all be saved in {folder}: {type(error).__name__}: {error}"
        return f"{min(len(clips), MOST_CLIPS)} of them are saved in {folder}"


def _is_finite(batch: Batch, row: int) -> bool:
    return bool(batch.states[row].isfinite().all() and batch.actions[row].isfinite().all())


def _arrays(batch: Batch, row: int) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "states": batch.states[row].numpy(),
        "actions": batch.actions[row].numpy(),
        "episode_id": np.array(batch.episode_ids[row]),
        "start": np.array(batch.starts[row]),
    }
    if batch.frames is not None:
        arrays["frames"] = batch.frames[row].numpy()
    if batch.latents is not None:
        scales = None if batch.latents.scales is None else batch.latents.scales[row]
        arrays["latents"] = unpack_latents(StoredLatents(batch.latents.values[row], scales)).numpy()
    return arrays
