"""What a model or a planner imagines: the images of a rollout from one frame, under actions taken, planned or neither.

The first frame and its state are given; nothing after them is. The states along the way are integrated from the first
one: those of a recording would tell a model what did happen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.transforms import frames_as_seen, view
from vjepa2_ac.data.windows import spread_with_ends
from vjepa2_ac.decoding.decoder_folder import DecoderCard, TrainedDecoder
from vjepa2_ac.decoding.network import Decoder, as_pixels
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.planning.controller import Decision
from vjepa2_ac.planning.counterfactual import counterfactual_states, feasible_actions
from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.spaces import StateSpace

Actions = Float[np.ndarray, "steps action_dim"]
Image = UInt8[np.ndarray, "size size 3"]  # as the encoder sees it
Film = UInt8[np.ndarray, "steps size size 3"]

AS_RECORDED = "as recorded"
_MUCH_WORSE_DB = 5.0


class Rolls(Protocol):
    """What a rollout needs of a model: `WorldModel`, or an oracle in a test."""

    def rollout(
        self, context: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None, /
    ) -> Float[Tensor, "batch horizon tokens dim"]:
        """Return the frames after the context, each prediction fed back."""
        ...


@dataclass(frozen=True, eq=False)
class Start:
    """Where imagination begins: all that a model is given."""

    latents: Float[Tensor, "tokens dim"]
    state: Float[np.ndarray, " state_dim"]
    space: StateSpace
    extrinsics: Float[Tensor, " 6"] | None = None

    @classmethod
    def of(cls, batch: LatentBatch, space: StateSpace) -> Start:
        """Return the start of the first clip of a batch."""
        extrinsics = None if batch.extrinsics is None else batch.extrinsics[0, 0]
        return cls(batch.latents[0, 0], batch.states[0, 0].double().cpu().numpy(), space, extrinsics)


@dataclass(frozen=True, eq=False)
class Imagined:
    """A rollout as images, and what really happened, where somebody knows."""

    model: str  # base, adapter, model
    name: str  # of the actions: as recorded, up, ...
    actions: Actions
    frames: Film  # after each action
    truth: Film | None = None


@dataclass(frozen=True, eq=False)
class Imagination:
    """One start, and everything that was imagined from it. All frames are as the encoder sees them."""

    subject: str
    episode_id: str  # "" of an image that is no part of a data set
    start: int  # control step
    seconds_per_step: float
    first: Image
    decoded_first: Image
    rollouts: tuple[Imagined, ...]
    truth: Film | None = None  # under the recorded actions
    decoded_truth: Film | None = None
    notes: tuple[str, ...] = field(default=())


@torch.no_grad()
def rolled_out(
    model: Rolls, start: Start, actions: Actions, states: Float[np.ndarray, "steps state_dim"] | None = None
) -> Float[Tensor, "steps tokens dim"]:
    """Return the latents after each action, each prediction fed back.

    Args:
        model: What predicts.
        start: The first frame and its state.
        actions: One for each step.
        states: Those that are known: the recorded ones of recorded actions. None: integrated from the first; a gripper
            changes as far as it can (`feasible_actions`), since a model has seen nothing else.
    """
    if states is None:
        states = counterfactual_states(start.state, actions, start.space)[:-1]
        actions = feasible_actions(start.state, actions, start.space)
    device = start.latents.device
    taken, known = (torch.as_tensor(one, dtype=torch.float32, device=device)[None] for one in (actions, states))
    extrinsics = None if start.extrinsics is None else start.extrinsics.expand(1, len(actions), -1)
    return model.rollout(start.latents[None, None], taken, known, extrinsics)[0]


def worth_knowing(card: DecoderCard, first: Image, decoded_first: Image) -> tuple[str, ...]:
    """Return a note where the decoder shows the start much worse than it showed its own held-out frames."""
    usual = card.held_out.get("decoder", {}).get("psnr_db", {}).get("value")
    error = np.square(first.astype(np.float64) - decoded_first).mean() / 255**2
    decibels = -10 * np.log10(max(error, 1e-10))
    if usual is None or decibels > usual - _MUCH_WORSE_DB:
        return ()
    note = (
        f"The decoder does not know this scene: it shows the start with {decibels:.1f} dB, its own held-out frames with"
        f" {usual:.1f} dB. What the images lack, the model need not lack; train a decoder on frames of this scene."
    )
    return (note,)


def shown(decoder: Decoder, latents: Float[Tensor, "steps tokens dim"]) -> Film:
    """Return latents as images for people."""
    return as_pixels(decoder.decode(latents.float()))


# ---- what a planner imagined: decoded from the predictions that its plan was chosen by ----

_MOST_STEPS = 8


@dataclass(frozen=True, eq=False)
class ImaginedPlan:
    """Images of a plan, all as the encoder sees them."""

    start: Image  # decoded
    steps: dict[int, Image]  # imagined after so many model steps; empty without a plan
    goal: Image  # the one that applies at the end
    decoded_goal: Image


def imagine_plan(answer: PlanResult, decoder: TrainedDecoder) -> ImaginedPlan:
    """Decode the rollout of a plan, of some steps if there are many, and what it started from and aimed at.

    Args:
        answer: The decision.
        decoder: Of the model's encoder; it is moved to the model's device.
    """
    controller, goal = answer.controller, answer.question.goals[answer.decision.goals[-1]]
    decoder.to(controller.device)
    given = torch.stack([controller.encoded(image) for image in (answer.question.start, goal)])
    start, decoded_goal = shown(decoder.decoder, given)
    frames = _rollout(answer.decision, decoder, steps=answer.space.steps)
    places = spread_with_ends(len(frames), _MOST_STEPS)
    seen = frames_as_seen(view(goal[None], controller.crop), decoder.card.shape.image_size)[0]
    return ImaginedPlan(start, {place + 1: frames[place] for place in places}, seen, decoded_goal)


def imagined_next(decision: Decision, decoder: TrainedDecoder) -> Image | None:
    """Return the next frame as the planner imagined it when it decided; None: it imagined none."""
    frames = _rollout(decision, decoder, steps=1)
    return frames[0] if len(frames) else None


@torch.no_grad()
def _rollout(decision: Decision, decoder: TrainedDecoder, *, steps: int) -> Film:
    """Return the images after the first steps of a plan; none without a plan, or if the predictions are not finite."""
    side = decoder.card.shape.image_size
    none = np.zeros((0, side, side, 3), np.uint8)
    if decision.plan is None or decision.cost is None:
        return none
    latents: Float[torch.Tensor, "steps tokens dim"] = decision.cost.imagine(decision.plan.actions[None, :steps])[0][0]
    return shown(decoder.decoder, latents) if bool(torch.isfinite(latents).all()) else none
