"""How far does a policy come that imitates? Behaviour cloning on the same latents, with a network of the same size."""

from __future__ import annotations

import numpy as np
import torch
from prepare import encoded
from torch import Tensor, nn

from vjepa2_ac.config import Config
from vjepa2_ac.data.transforms import Crop
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.closed_loop.policies import Image, Moves
from vjepa2_ac.simulation.closed_loop.tasks import Problem
from vjepa2_ac.simulation.closed_loop.worlds import WorldProblem

BATCH, RATE, WARM_UP = 18, 1e-3, 20
MOST_CLIPS = 4_096  # of the demonstrations


class Cloned(nn.Module):
    """A predictor that sees the present frame and the goal, and says the action from the one towards the other."""

    def __init__(self, model: WorldModel, seed: int) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.model = model
        self.model.draw_predictor(torch.Generator().manual_seed(seed), torch.float32, at_persistence=False)
        self.head = nn.Linear(model.sizes.encoder.width, 7)
        self.scale = torch.ones(7)

    def forward(self, latents: Tensor, states: Tensor) -> Tensor:
        """Return actions [batch, 7] of latents [batch, 2, tokens, dim], present and goal, and states [batch, 7]."""
        both = states[:, None].expand(-1, 2, -1)
        tokens = self.model.predict(latents, torch.zeros_like(both), both)
        return self.head(tokens[:, 1].mean(dim=1)) * self.scale


def clone(config: Config, model: WorldModel, steps: int, seed: int) -> Cloned:
    """Train on the demonstrations of a run's config: a frame, one that is 1 to 3 model steps later, and its action."""
    clips = encoded(config, model, "train", MOST_CLIPS)
    latents, states, actions = (
        torch.cat([getattr(one, name) for one in clips]) for name in ("latents", "states", "actions")
    )
    cloned, rng = Cloned(model, seed), np.random.default_rng([seed, 3])
    cloned.scale = actions.flatten(0, 1).std(dim=0).clamp_min(1e-3)
    weights = [*model.predictor.parameters(), *cloned.head.parameters()]
    for weight in weights:
        weight.requires_grad_(True)
    optimiser = torch.optim.AdamW(weights, lr=RATE, weight_decay=0.04)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser, lambda step: min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + np.cos(np.pi * step / steps))
    )
    cloned.train()
    for _ in range(steps):
        rows, first = rng.integers(len(latents), size=BATCH), rng.integers(actions.shape[1], size=BATCH)
        goal = first + 1 + rng.integers(actions.shape[1] - first)
        found = cloned(torch.stack([latents[rows, first], latents[rows, goal]], dim=1), states[rows, first])
        loss = ((found - actions[rows, first]) / cloned.scale).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return cloned.eval()


class Cloning:
    """Acts by imitation: its goal at each model step is the one that the demonstration had one step later."""

    name, why, moves = "behaviour cloning", "imitated", Moves.FLANGE

    def __init__(self, cloned: Cloned, crop: Crop) -> None:
        self._cloned, self._crop = cloned, crop

    def reset(self, problem: Problem, goal_image: Image) -> None:
        """Begin an episode."""
        goals = problem.goals if isinstance(problem, WorldProblem) else ()
        self._goals: tuple[SubGoal, ...] = goals or (SubGoal(goal_image),)
        self._step = 0

    @torch.no_grad()
    def act(self, image: Image, state: np.ndarray) -> np.ndarray:
        """Return the action towards the goal of this step."""
        goal = self._goals[min(self._step, len(self._goals) - 1)].image
        self._step += 1
        latents = torch.cat([self._encoded(one) for one in (image, goal)], dim=1)
        return self._cloned(latents, torch.tensor(state, dtype=torch.float32)[None])[0].double().numpy()

    def _encoded(self, image: Image) -> Tensor:
        return encode_frames(self._cloned.model, image[None], self._crop)[None]
