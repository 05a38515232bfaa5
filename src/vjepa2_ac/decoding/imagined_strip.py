"""The image strip of a validation: the frames that base and model predict for one held-out clip, and the true ones.

A hook of training (`validation.decoder`). The clip is always the same: the validation clip with the most motion (with
several processes: of rank 0's clips). Nothing that fails here ends a run: the strip is left out with a warning.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, frames_of
from vjepa2_ac.data.transforms import frames_as_seen
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import AS_RECORDED, Imagination, Imagined, Start, rolled_out, shown, strip_of
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.media.film import draw_strip
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.model.lora import base_only
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.folder import IMAGINED
from vjepa2_ac.storage import write_atomically

logger = logging.getLogger(__name__)

Image = UInt8[np.ndarray, "height width 3"]


class ImaginedStrip:
    """Chooses the clip among those of the first validation of this process, and draws it at each validation.

    Args:
        config: The run, whose decoder is loaded.

    Raises:
        InputError: `validation.decoder` is no decoder.
    """

    def __init__(self, config: Config) -> None:
        self._decoder: TrainedDecoder = load_decoder(str(config.validation.decoder), where="validation.decoder:")
        self._most = -1.0  # motion of a clip
        self._clip: tuple[Batch, int, LatentBatch] | None = None  # its row in a batch; its latents and states alone
        self._frames: UInt8[np.ndarray, "time size size 3"] | None = None  # what happened; read once

    def require_fit(self, world_model: WorldModel, config: Config) -> None:
        """Refuse a decoder of another encoder or camera.

        Raises:
            InputError: Names both.
        """
        self._decoder.require_fit(world_model, config.data, subject=config.model.base)

    def seen(self, dataset: Dataset, batch: Batch, encoded: LatentBatch) -> None:
        """Look for the clip with the most motion in a batch of validation clips and its latents."""
        self._dataset = dataset
        for row, states in enumerate(encoded.states.double().cpu().numpy()):
            motion = dataset.spaces.state.path_length(states)
            if motion > self._most:
                clip = encoded.clip(row)
                own = replace(clip, latents=clip.latents.detach().float().cpu().clone())  # or all clips would stay
                self._most, self._clip = motion, (replace(batch, latents=None, on_device=None), row, own)

    def draw(self, world_model: WorldModel, device: torch.device, run: Path, step: int) -> Image | None:
        """Write RUN/imagined/step-XXXXXXXX.png; return the image, None if none was drawn."""
        try:
            image: Image = draw_strip(strip_of(self.imagine(world_model, device, f"{run.name}, step {step:,}")))
            (run / IMAGINED).mkdir(exist_ok=True)
            write_atomically(run / IMAGINED / f"{checkpoint_name(step)}.png", encode_png(image))
        except Exception as error:  # an image is not worth a run
            logger.warning("The predictions at step %d could not be drawn: %s", step, error)
            return None
        return image

    @torch.no_grad()
    def imagine(self, world_model: WorldModel, device: torch.device, subject: str) -> Imagination:
        """Return what the model imagines of the clip, and the base where an adapter can be switched off.

        Raises:
            ValueError: No clip was seen.
        """
        if self._clip is None:
            raise ValueError("no clip was seen")
        batch, row, clip = self._clip
        if self._frames is None:
            self._frames = frames_as_seen(frames_of(self._dataset, batch, row), world_model.image_size)
        decoder, latents = self._decoder.to(device).decoder, clip.latents.to(device)
        actions, states = (values[0].double().cpu().numpy() for values in (clip.actions, clip.states))
        start = Start.of(replace(clip, latents=latents), self._dataset.spaces.state)
        world_model.eval()

        def rollout(name: str) -> Imagined:
            rolled = rolled_out(world_model.rollout, start, actions, states[:-1])
            return Imagined(name, AS_RECORDED, actions, shown(decoder, rolled))

        rollouts, adaptation = [rollout("model now")], world_model.adaptation
        if adaptation is not None and adaptation.kind == "lora" and world_model.fresh_heads is None:
            with base_only(world_model):
                rollouts.insert(0, rollout("base"))
        decoded = shown(decoder, latents[0])
        return Imagination(
            subject=subject,
            episode_id=batch.episode_ids[row],
            start=batch.starts[row],
            seconds_per_step=self._dataset.config.model_stride / self._dataset.control_rate_hz,
            first=self._frames[0],
            decoded_first=decoded[0],
            rollouts=tuple(rollouts),
            truth=self._frames[1:],
            decoded_truth=decoded[1:],
        )
