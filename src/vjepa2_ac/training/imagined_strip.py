"""The film strip of a validation: what base and model imagine of one held-out clip, beside what happened.

It is always the same clip: of the validation's, the one with the most motion. Nothing that fails here ends a run: a
strip is left out, and a warning says why.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.data.clips import frames_of
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.transforms import frames_as_seen
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import AS_RECORDED, Imagination, Imagined, Start, rolled_out, shown
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.model.adapter.lora import base_only
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reports.figures.film import draw_strip
from vjepa2_ac.reports.imagined import strip_of
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.folder import IMAGINED
from vjepa2_ac.storage import write_atomically

logger = logging.getLogger(__name__)

Image = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, eq=False)
class _Clip:
    """A clip of a batch, whose frames are read only if it is the one."""

    batch: Batch  # without latents
    row: int
    latents: Float[Tensor, "time tokens dim"]
    actions: Float[np.ndarray, "time-1 action_dim"]
    states: Float[np.ndarray, "time state_dim"]
    extrinsics: Float[Tensor, " 6"] | None
    motion: float


class ImaginedStrip:
    """Finds the clip among those of the first validation of this process, and draws it at each.

    Args:
        decoder: Of the run's encoder.
        dataset: Of the run.
        size: Height and width of the encoder's input.
    """

    def __init__(self, decoder: TrainedDecoder, dataset: Dataset, size: int) -> None:
        self._decoder, self._dataset, self._size = decoder, dataset, size
        self._clip: _Clip | None = None
        self._is_found = False  # from the first drawing on
        self._base: dict[str, Tensor] = {}  # what the base imagines: [steps, tokens, dim]
        self._frames: UInt8[np.ndarray, "time size size 3"] | None = None  # what happened

    def seen(self, batch: Batch, encoded: LatentBatch) -> LatentBatch:
        """Return the latents of a batch of validation clips, after looking for the clip with the most motion."""
        if not self._is_found:
            for row, states in enumerate(encoded.states.double().cpu().numpy()):
                motion = self._dataset.spaces.state.path_length(states)
                if self._clip is None or motion > self._clip.motion:
                    self._clip = _clip_of(batch, encoded, row, motion)
        return encoded

    def draw(self, world_model: WorldModel, device: torch.device, run: Path, step: int) -> Image | None:
        """Write RUN/imagined/step-XXXXXXXX.png; return the image, None if none was drawn."""
        if self._clip is None:
            return None
        self._is_found = True
        try:
            imagination = self._imagine(self._clip, world_model, device, f"{run.name}, step {step:,}")
            image: Image = draw_strip(strip_of(imagination))
            (run / IMAGINED).mkdir(exist_ok=True)
            write_atomically(run / IMAGINED / f"{checkpoint_name(step)}.png", encode_png(image))
        except Exception as error:  # an image is not worth a run
            logger.warning("What the model imagines at step %d could not be drawn: %s", step, error)
            return None
        return image

    @torch.no_grad()
    def _imagine(self, clip: _Clip, world_model: WorldModel, device: torch.device, subject: str) -> Imagination:
        if self._frames is None:
            self._frames = frames_as_seen(frames_of(self._dataset, clip.batch, clip.row), self._size)
        decoder = self._decoder.to(device).decoder
        decoded = shown(decoder, clip.latents.to(device))
        return Imagination(
            subject=subject,
            episode_id=clip.batch.episode_ids[clip.row],
            start=clip.batch.starts[clip.row],
            seconds_per_step=self._dataset.config.model_stride / self._dataset.control_rate_hz,
            first=self._frames[0],
            decoded_first=decoded[0],
            rollouts=tuple(
                Imagined(name, AS_RECORDED, clip.actions, shown(decoder, latents.to(device)))
                for name, latents in self._rollouts(clip, world_model, device).items()
            ),
            truth=self._frames[1:],
            decoded_truth=decoded[1:],
        )

    def _rollouts(self, clip: _Clip, world_model: WorldModel, device: torch.device) -> dict[str, Tensor]:
        """Return the latents that base and model imagine.

        The base is asked once, and only where an adapter can be switched off; before training, the model is the base.
        """
        world_model.eval()
        extrinsics = None if clip.extrinsics is None else clip.extrinsics.to(device)
        start = Start(clip.latents[0].to(device), clip.states[0], self._dataset.spaces.state, extrinsics)
        adaptation = world_model.adaptation
        if not self._base and adaptation is not None and adaptation.kind == "lora" and world_model.fresh_heads is None:
            with base_only(world_model):
                self._base = {"base": rolled_out(world_model, start, clip.actions, clip.states[:-1]).cpu()}
        return {**self._base, "model now": rolled_out(world_model, start, clip.actions, clip.states[:-1])}


def decoder_of(config: Config) -> TrainedDecoder | None:
    """Load `validation.decoder`; None if it is not set.

    Raises:
        InputError: It is no decoder.
    """
    name = config.validation.decoder
    return None if name is None else load_decoder(name, where="validation.decoder:")


def _clip_of(batch: Batch, encoded: LatentBatch, row: int, motion: float) -> _Clip:
    """Return a clip with its own memory: latents of whole batches would stay."""
    return _Clip(
        batch=replace(batch, latents=None, on_device=None),
        row=row,
        latents=encoded.latents[row].detach().float().cpu().clone(),
        actions=encoded.actions[row].double().cpu().numpy(),
        states=encoded.states[row].double().cpu().numpy(),
        extrinsics=None if encoded.extrinsics is None else encoded.extrinsics[row, 0].cpu(),
        motion=motion,
    )
