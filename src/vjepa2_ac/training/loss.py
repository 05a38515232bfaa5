"""The training loss on normalised latents: teacher forcing, a short rollout, and a contrast of actions if asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss

from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.distances import absolute_difference, squared_difference
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.network.dynamics import LatentDynamics
from vjepa2_ac.model.network.kv_cache import KeyValueCache

Distance = Callable[[Tensor, Tensor], Tensor]  # of predicted and true latents, number by number


@dataclass(frozen=True)
class Losses:
    """The two parts of the loss; each is a mean over all elements."""

    teacher_forcing: Float[Tensor, ""]
    rollout: Float[Tensor, ""]

    @property
    def total(self) -> Float[Tensor, ""]:
        """The plain sum, as released."""
        return self.teacher_forcing + self.rollout


class Objective(nn.Module):
    """The loss of a world model on latents, as a module: one forward pass per step, as DDP requires.

    Teacher forcing predicts frames 2..T from the true frames 1..T-1. The rollout starts at frame 1; its first
    prediction is the teacher-forced one, each further one sees the predictions before it. States and actions are the
    true ones throughout. `training.action_contrast` adds `action_contrast_loss`, unknown to the released recipe.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/train.py, forward_predictions and loss_fn.
    """

    def __init__(self, world_model: LatentDynamics, training: TrainingConfig) -> None:
        super().__init__()
        self.world_model = world_model
        self.weights = (training.teacher_forcing_weight, training.rollout_weight)
        self.rollout_steps = training.rollout_steps if training.rollout_weight else 1  # weight 0: no cost
        self.distance = LOSSES[training.loss](training)
        self.action_contrast = training.action_contrast

    @property
    def names(self) -> tuple[str, ...]:
        """What the parts of the loss are called, in their order."""
        return ("teacher_forcing", "rollout", *(["action_contrast"] if self.action_contrast.weight else []))

    def forward(self, batch: LatentBatch) -> tuple[Float[Tensor, ""], ...]:
        """Return the parts of the loss, in the order of `names`, each times its weight: the loss is their sum.

        They are plain tensors, which DDP and Accelerate pass through.
        """
        predicted = _predictions(self.world_model, batch, self.rollout_steps)
        other = _forced(self.world_model, batch, others_actions(batch.actions)) if self.action_contrast.weight else None
        true = batch.latents[:, 1:]
        errors = self.distance(predicted.forced, true)
        forced_weight, rollout_weight = self.weights
        rollout = self.distance(predicted.rolled, true[:, : self.rollout_steps]).mean()
        losses = (errors.mean() * forced_weight, rollout * rollout_weight)
        if other is None:
            return losses
        copied = self.distance(batch.latents[:, :-1], true)
        contrast = action_contrast_loss(errors, self.distance(other, true), copied, self.action_contrast.margin)
        return *losses, contrast * self.action_contrast.weight


def prediction_losses(
    world_model: LatentDynamics, batch: LatentBatch, rollout_steps: int, distance: Distance = absolute_difference
) -> Losses:
    """Return both parts of the loss of one batch, without weights; the distance is L1 unless given.

    Both parts begin with the first step: the rollout reuses the keys and values that teacher forcing computed for it,
    and computes one new step for each further prediction. Loss and gradient equal those of recomputing everything.
    With dropout both parts share the masks of the first step, which changes the expectation of neither.

    Raises:
        ValueError: A rollout longer than the clip.
    """
    predicted, true = _predictions(world_model, batch, rollout_steps), batch.latents[:, 1:]
    return Losses(
        teacher_forcing=distance(predicted.forced, true).mean(),
        rollout=distance(predicted.rolled, true[:, :rollout_steps]).mean(),
    )


def others_actions(actions: Float[Tensor, "batch time action_dim"]) -> Float[Tensor, "batch time action_dim"]:
    """Return wrong actions for each clip: those of the clip before it; of a clip that is alone its own, reversed.

    Clips are in the run's random order, so the neighbour is any other clip. `training.batch_size` 1 is refused; a clip
    is alone where `data.broken_episodes: skip` has left out the others of its micro-batch.
    """
    return actions.roll(1, dims=0) if len(actions) > 1 else actions.flip(1)


def action_contrast_loss(
    errors: Float[Tensor, "batch time tokens dim"],
    others: Float[Tensor, "batch time tokens dim"],
    copied: Float[Tensor, "batch time tokens dim"],
    margin: float,
) -> Float[Tensor, ""]:
    """Return how far each clip is from the margin between true and wrong actions, on average: a hinge per clip.

    max(0, E(true) - E(wrong) + margin * E(copy)) with E a clip's mean error. The margin is thus a share of what changes
    in the clip, the unit of `evaluate`'s ratios, whatever the distance, data or model. The term itself is not divided
    by E(copy): it stays in the unit of the other losses, and a clip in which nothing moves asks for nothing, instead of
    dividing by almost zero. Clips with the same actions have the same two errors, whose gradients cancel. Gradients
    reach both predictions, and those of a clip beyond the margin are zero.

    The idea, with a cosine in place of the error: HALO-WAM (Algorineko/halo-wam), margin 0.1 and weight 1.

    Args:
        errors: With the true actions, number by number.
        others: With wrong actions.
        copied: Of copying the last frame.
        margin: In errors of copying.
    """
    clips = (1, 2, 3)
    return (errors.mean(clips) - others.mean(clips) + margin * copied.mean(clips)).clamp(min=0.0).mean()


@dataclass(frozen=True)
class _Predictions:
    forced: Float[Tensor, "batch time tokens dim"]
    rolled: Float[Tensor, "batch rollout tokens dim"]


def _predictions(world_model: LatentDynamics, batch: LatentBatch, rollout_steps: int) -> _Predictions:
    """Predict teacher-forced, and fed back.

    Raises:
        ValueError: A rollout longer than the clip.
    """
    latents, actions, states, extrinsics = batch.latents, batch.actions, batch.states, batch.extrinsics
    if rollout_steps >= latents.shape[1]:
        raise ValueError(f"a rollout of {rollout_steps} steps needs {rollout_steps + 1} frames, got {latents.shape[1]}")
    cache = KeyValueCache() if rollout_steps > 1 else None
    forced = _forced(world_model, batch, actions, cache)
    rolled = forced[:, :1]
    if rollout_steps > 1:
        rest = slice(1, rollout_steps)
        camera = None if extrinsics is None else extrinsics[:, rest]
        further = world_model.rollout(rolled, actions[:, rest], states[:, rest], camera, cache)
        rolled = torch.cat([rolled, further], dim=1)
    return _Predictions(forced, rolled)


def _forced(
    world_model: LatentDynamics,
    batch: LatentBatch,
    actions: Float[Tensor, "batch time action_dim"],
    cache: KeyValueCache | None = None,
) -> Float[Tensor, "batch time tokens dim"]:
    """Predict each next frame from the true ones, after these actions and from the true states."""
    extrinsics = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    return world_model.predict(batch.latents[:, :-1], actions, batch.states[:, :-1], extrinsics, cache, keep=1)


def _smooth_difference(
    predicted: Float[Tensor, "batch time tokens dim"], true: Float[Tensor, "batch time tokens dim"], beta: float
) -> Float[Tensor, "batch time tokens dim"]:
    """Return d**2 / (2 * beta) where a difference d is below beta, and d - beta / 2 above, computed in float32."""
    return smooth_l1_loss(predicted.float(), true.float(), reduction="none", beta=beta)


LOSSES: dict[str, Callable[[TrainingConfig], Distance]] = {  # what `training.loss` names
    "l1": lambda _: absolute_difference,
    "l2": lambda _: squared_difference,
    "smooth_l1": lambda training: partial(_smooth_difference, beta=training.smooth_l1_beta),
}
