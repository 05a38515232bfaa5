"""How wrong are the predictions? Teacher forcing plus a short rollout, L1 on normalised latents."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.world_model import WorldModel


@dataclass(frozen=True)
class Losses:
    """The two parts of the loss; each is the mean absolute difference over all elements."""

    teacher_forcing: Float[Tensor, ""]
    rollout: Float[Tensor, ""]

    @property
    def total(self) -> Float[Tensor, ""]:
        """The plain sum, as released."""
        return self.teacher_forcing + self.rollout


class Objective(nn.Module):
    """The loss of a world model on latents, as a module: one forward pass a step, which is what DDP wants.

    Teacher forcing predicts frames 2..T from the true frames 1..T-1. The rollout starts at frame 1; its first
    prediction is the teacher-forced one, each further one sees the predictions before it. States and actions are the
    true ones throughout.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/train.py, forward_predictions and loss_fn.
    """

    def __init__(self, world_model: WorldModel, rollout_steps: int) -> None:
        super().__init__()
        self.world_model = world_model
        self.rollout_steps = rollout_steps

    def forward(self, batch: LatentBatch) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return (teacher forcing, rollout): plain tensors, which DDP and Accelerate pass through."""
        losses = prediction_losses(self.world_model, batch, self.rollout_steps)
        return losses.teacher_forcing, losses.rollout


def prediction_losses(world_model: WorldModel, batch: LatentBatch, rollout_steps: int) -> Losses:
    """Return both parts of the loss of one batch.

    Raises:
        ValueError: A rollout longer than the clip.
    """
    latents, actions, states, extrinsics = batch.latents, batch.actions, batch.states, batch.extrinsics
    if rollout_steps >= latents.shape[1]:
        raise ValueError(f"a rollout of {rollout_steps} steps needs {rollout_steps + 1} frames, got {latents.shape[1]}")
    states = states[:, :-1]
    extrinsics = None if extrinsics is None else extrinsics[:, :-1]
    forced = world_model.predict(latents[:, :-1], actions, states, extrinsics)
    rolled = forced[:, :1]
    if rollout_steps > 1:
        context = torch.cat([latents[:, :1], rolled], dim=1)
        camera = None if extrinsics is None else extrinsics[:, :rollout_steps]
        further = world_model.rollout(context, actions[:, :rollout_steps], states[:, :rollout_steps], camera)
        rolled = torch.cat([rolled, further], dim=1)
    return Losses(
        teacher_forcing=mean_absolute_difference(forced, latents[:, 1:]),
        rollout=mean_absolute_difference(rolled, latents[:, 1 : rollout_steps + 1]),
    )


def mean_absolute_difference(
    predicted: Float[Tensor, "batch time tokens dim"], true: Float[Tensor, "batch time tokens dim"]
) -> Float[Tensor, ""]:
    """Return the L1 distance, computed in float32."""
    return (predicted.float() - true.float()).abs().mean()
