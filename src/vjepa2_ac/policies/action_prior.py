"""Goal-conditioned inverse dynamics: from latents now, latents wanted and steps left to a mean and spread of actions.

Source of the idea: arXiv 2605.08732 (GC-IDM): hindsight goals from demonstrations, adaptive layer norms on the steps
that remain. Where things are in an image is read as spatial softmax does (arXiv 1509.06113).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import gelu

from vjepa2_ac import __version__
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import Fingerprints
from vjepa2_ac.planning.cameras import Cameras
from vjepa2_ac.planning.energy import WorldModelCost
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.planning.solvers import PlanStart
from vjepa2_ac.storage import folder_writer
from vjepa2_ac.storage.structured import read_json_object, record_of
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

CARD, WEIGHTS = "prior.json", "prior.safetensors"
POINTS, VALUES, WIDTH, BLOCKS = 16, 16, 256, 2  # points of an image, numbers of each; the network's width and depth

_NEEDED = "the folder of a prior, as `vjepa2-ac prior` writes it"
_FIX = "Train it again: `vjepa2-ac prior RUN`"
Size = Annotated[int, Field(ge=1, le=65_536)]


@dataclass(frozen=True)
class PriorSizes:
    """What goes in and comes out."""

    grid: Size  # patches along one side
    dim: Size  # of a token
    state: Size
    action: Size
    ahead: Size  # most steps to a goal


@dataclass(frozen=True)
class PriorCard:
    """What is known of a prior."""

    format: Literal["vjepa2-ac prior 1"]
    sizes: PriorSizes
    encoder: str  # WorldModel.encoder_fingerprint
    crop: str  # data.crop
    data: str  # data.path
    steps: int
    held_out: Mapping[str, Any] = field(default_factory=dict)
    version: str = __version__
    time: str = ""  # UTC


class ActionPrior(nn.Module):
    """The network, and how a search starts from it."""

    grid: Tensor
    scale: Tensor

    def __init__(self, sizes: PriorSizes) -> None:
        super().__init__()
        self.sizes = sizes
        described = POINTS * (2 + VALUES)
        self.features = nn.Linear(sizes.dim, 4 * POINTS)
        self.places, self.values = nn.Linear(4 * POINTS, POINTS), nn.Linear(4 * POINTS, VALUES)
        self.inner = nn.Linear(3 * described + sizes.state, WIDTH)
        self.blocks = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(WIDTH, elementwise_affine=False)
        self.remaining = nn.Embedding(sizes.ahead + 1, BLOCKS * 2 * WIDTH)
        self.outer = nn.Linear(WIDTH, 2 * sizes.action)
        nn.init.zeros_(self.remaining.weight)
        line = torch.linspace(-1.0, 1.0, sizes.grid)
        self.register_buffer("grid", torch.cartesian_prod(line, line))
        self.register_buffer("scale", torch.ones(sizes.action))  # of an action: standard deviation in the data

    def forward(
        self,
        seen: Float[Tensor, "batch tokens dim"],
        wanted: Float[Tensor, "batch tokens dim"],
        remaining: Int[Tensor, " batch"],
        state: Float[Tensor, "batch state_dim"],
    ) -> tuple[Float[Tensor, "batch action_dim"], Float[Tensor, "batch action_dim"]]:
        """Return mean and mean absolute deviation of the next action, in units of `scale`."""
        now, then = self._described(seen), self._described(wanted)
        x = self.inner(torch.cat([now, then, then - now, state], dim=1))
        parts = self.remaining(remaining.clamp(0, self.sizes.ahead)).unflatten(1, (BLOCKS, 2, WIDTH))
        for number, block in enumerate(self.blocks):
            x = x + gelu(block(self.norm(x) * (1 + parts[:, number, 0]) + parts[:, number, 1]))
        mean, log_deviation = self.outer(self.norm(x)).chunk(2, dim=1)
        return mean, log_deviation.clamp(-5.0, 3.0).exp()

    def _described(self, latents: Float[Tensor, "batch tokens dim"]) -> Float[Tensor, "batch numbers"]:
        """Return where some things are in an image, and what is there."""
        features = gelu(self.features(latents))
        shares = self.places(features).softmax(dim=1)
        points = torch.einsum("bnk,nc->bkc", shares, self.grid)
        values = torch.einsum("bnk,bnv->bkv", shares, self.values(features))
        return torch.cat([points, values], dim=2).flatten(1)

    @torch.no_grad()
    def next_action(
        self,
        frame: Float[Tensor, "tokens dim"],
        state: Float[Tensor, " state_dim"],
        goal: Float[Tensor, "tokens dim"],
        remaining: int,
    ) -> tuple[Float[Tensor, " action_dim"], Float[Tensor, " action_dim"]]:
        """Return mean and standard deviation of the next action, on the CPU.

        Args:
            frame: Latents of the current frame.
            state: Measured.
            goal: Latents of the goal.
            remaining: Estimated number of model steps to the goal.
        """
        left = torch.tensor([max(1, remaining)], device=frame.device)
        mean, deviation = self(frame[None], goal[None], left, state[None])
        std = math.sqrt(2) * deviation  # of a Laplace distribution
        return (mean * self.scale)[0].float().cpu(), (std * self.scale)[0].float().cpu()

    @torch.no_grad()
    def start(
        self, cost: WorldModelCost, wanted: Float[Tensor, "tokens dim"], remaining: int, space: SearchSpace
    ) -> PlanStart:
        """Return where a search starts: the next action, and what follows from what the model predicts after it.

        Args:
            cost: Of the present scene; it predicts what is seen after an action.
            wanted: Latents of the goal.
            remaining: Model steps to it, at a guess.
            space: The allowed actions.
        """
        seen, state = cost.now
        decisions, spread = torch.zeros_like(space.lower), torch.zeros_like(space.lower)
        for number in range(space.decisions):
            done = number * space.repeat
            if done:
                predicted, states = cost.imagine(space.over_steps(space.allowed(decisions))[None])
                seen, state = predicted[0, done - 1], states[0, done]
            decisions[number], spread[number] = self.next_action(seen, state, wanted, remaining - done)
        return PlanStart(decisions, decisions[None], spread)


def save_prior(folder: Path, card: PriorCard, prior: ActionPrior) -> None:
    """Write a prior into a folder, whole or not at all.

    Raises:
        InputError: The folder cannot be written.
    """
    with folder_writer(folder, CARD) as fresh:
        save_tensors(prior.state_dict(), fresh / WEIGHTS)
        (fresh / CARD).write_text(json.dumps(asdict(card), indent=1) + "\n", encoding="utf-8")


def load_prior(folder: str | Path, *, where: str) -> tuple[PriorCard, ActionPrior]:
    """Read a prior and its card, on the CPU.

    Raises:
        InputError: There is none, or it is incomplete or damaged.
    """
    path = Path(folder)
    values = read_json_object(path / CARD, needed=_NEEDED, fix=_FIX)
    card = record_of(PriorCard, values, where=f"{where}: {path / CARD}", needed=_NEEDED, fix=_FIX)
    prior = ActionPrior(card.sizes).eval().requires_grad_(False)
    prior.load_state_dict(read_tensors(path / WEIGHTS, prior.state_dict(), needed=_NEEDED, fix=_FIX))
    return card, prior


def read_for_planning(path: str, known: Fingerprints, cameras: Cameras) -> ActionPrior:
    """Return the prior of `planning.prior`, on the device of the model.

    Raises:
        InputError: As `load_prior`; or the prior was trained with another encoder or crop.
    """
    card, prior = load_prior(path, where="planning.prior")
    for name, trained, model in (("encoder", card.encoder, known.encoder), ("data.crop", card.crop, cameras.crop)):
        if trained != model:
            found, needed = f"the prior of another {name} {trained}, not {model}", "one trained for this model"
            raise InputError(where=f"planning.prior: {path}", found=found, needed=needed, fix=_FIX)
    return prior.to(cameras.model.device)
