"""What a planner imagined: decoded from the predictions by which its plan was chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from vjepa2_ac.data.transforms import frames_as_seen, split_views, view
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.decoding.imagine import shown
from vjepa2_ac.media.film import spread_with_ends
from vjepa2_ac.planning.controller import Decision
from vjepa2_ac.planning.decision import PlanResult

Image = UInt8[np.ndarray, "height width 3"]  # as the encoder sees it; several views side by side
Film = UInt8[np.ndarray, "steps height width 3"]
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
    controller, goal = answer.controller, answer.question.goals[answer.decision.goals[-1]].image
    decoder.to(controller.device)
    given = torch.stack([controller.encoded(image) for image in (answer.question.start, goal)])
    start, decoded_goal = shown(decoder.decoder, given, controller.config.views)
    frames = _rollout(answer.decision, decoder, steps=answer.space.steps)
    places = spread_with_ends(len(frames), _MOST_STEPS)
    views = view(split_views(goal[None], controller.config.views), controller.crop)
    seen = np.concatenate(frames_as_seen(views, decoder.card.shape.image_size), axis=1)
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
    return shown(decoder.decoder, latents, decision.cost.views) if bool(torch.isfinite(latents).all()) else none
