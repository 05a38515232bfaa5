"""The training loss: teacher forcing plus a short rollout, on normalised latents."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss

from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.config.section import Positive, Section
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.distances import absolute_difference
from vjepa2_ac.model.network.predictor_network import KeyValueCache, LatentDynamics
from vjepa2_ac.registry import LOSSES

Distance = Callable[[Tensor, Tensor], Tensor]  # of predicted and true latents, number by number


class Objective(nn.Module):
    """The loss of a world model on latents, as a module that holds the world model.

    Teacher forcing predicts frames 2..T from the true frames 1..T-1. The rollout starts at frame 1; its first
    prediction is the teacher-forced one, each further one sees the predictions before it. States and actions are the
    true ones throughout.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/train.py, forward_predictions and loss_fn.
    """

    def __init__(self, world_model: LatentDynamics, training: TrainingConfig) -> None:
        super().__init__()
        self.world_model = world_model
        self.weights = (training.teacher_forcing_weight, training.rollout_weight)
        self.rollout_steps = training.rollout_steps if training.rollout_weight else 1  # weight 0: no cost
        self.distance: Distance = LOSSES.make(training.loss.name, training.loss.options)

    def forward(self, batch: LatentBatch) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return (teacher forcing, rollout), each times its weight, so that the loss is their sum."""
        forced, rollout = prediction_losses(self.world_model, batch, self.rollout_steps, self.distance)
        forced_weight, rollout_weight = self.weights
        return forced * forced_weight, rollout * rollout_weight


def prediction_losses(
    world_model: LatentDynamics, batch: LatentBatch, rollout_steps: int, distance: Distance = absolute_difference
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return (teacher forcing, rollout) of one batch, without weights, each a mean over all elements.

    Both parts begin with the first step: the rollout reuses the keys and values that teacher forcing computed for it,
    and computes one new step for each further prediction. Loss and gradient equal those of recomputing everything.
    With dropout both parts share the masks of the first step, which changes the expectation of neither.

    Raises:
        ValueError: A rollout longer than the clip.
    """
    latents, actions, states, extrinsics = batch.latents, batch.actions, batch.states, batch.extrinsics
    if rollout_steps >= latents.shape[1]:
        raise ValueError(f"a rollout of {rollout_steps} steps needs {rollout_steps + 1} frames, got {latents.shape[1]}")
    states = states[:, :-1]
    extrinsics = None if extrinsics is None else extrinsics[:, :-1]
    cache = KeyValueCache() if rollout_steps > 1 else None
    forced = world_model.predict(latents[:, :-1], actions, states, extrinsics, cache, keep=1)
    rolled = forced[:, :1]
    if rollout_steps > 1:
        rest = slice(1, rollout_steps)
        camera = None if extrinsics is None else extrinsics[:, rest]
        further = world_model.rollout(rolled, actions[:, rest], states[:, rest], camera, cache)
        rolled = torch.cat([rolled, further], dim=1)
    return distance(forced, latents[:, 1:]).mean(), distance(rolled, latents[:, 1 : rollout_steps + 1]).mean()


class SmoothL1:
    """Half the squared difference d over beta, d**2 / (2 * beta), below beta, and d - beta / 2 above."""

    class Config(Section):
        """Options of the loss smooth_l1."""

        beta: Positive = 1.0
        """The difference below which the loss is squared."""

    def __init__(self, options: Config) -> None:
        self.beta = options.beta

    def __call__(
        self, predicted: Float[Tensor, "batch time tokens dim"], true: Float[Tensor, "batch time tokens dim"]
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the loss of each number, computed in float32."""
        return smooth_l1_loss(predicted.float(), true.float(), reduction="none", beta=self.beta)
