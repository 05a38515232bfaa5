"""Which offline figures of a model could tell how it will fare in closed loop? Each as one number, lower is better."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr
from torch import Tensor

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.action_use import moves_of, rank_actions
from vjepa2_ac.evaluation.distribution import LatentSums, distribution_of
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.spaces import ActionSpace, apply_action

MOVES = 32  # clips whose moves are ranked
VISITED = 16  # samples of each iteration of a search
RIDGE = 10.0  # of the inverse dynamics, in units of the mean squared feature


def offline_figures(
    model: WorldModel,
    space: ActionSpace,
    train: Sequence[LatentBatch],
    held_out: Sequence[LatentBatch],
) -> dict[str, float]:
    """Return what is measured of a model without a robot, on clips of held-out episodes.

    Args:
        model: The model.
        space: Of its actions.
        train: Clips of the training episodes, from which the inverse dynamics is fitted.
        held_out: Clips to measure on.
    """
    true, predicted = LatentSums(), LatentSums()
    rolled = [_rollout(model, batch) for batch in held_out]
    for batch, latents in zip(held_out, rolled, strict=True):
        true.add(batch.latents[:, 1:], batch.episode_ids)
        predicted.add(latents, batch.episode_ids)
    distribution = distribution_of(predicted, true)
    rows = [(batch, row) for batch in held_out for row in range(len(batch.starts))]
    chosen = [rows[place] for place in np.linspace(0, len(rows) - 1, MOVES).astype(int)]
    probes = ProbeOptions(samples=32)
    moves = [move for batch, row in chosen for move in moves_of(batch, row, space, 0.075)]
    ranking = rank_actions(model, moves, space, probes, seed=0)
    return {
        "action-ranking error": ranking.rank.value,
        "energy spread, negative": -ranking.spread.value,
        "spread of latents, distance from 1": abs(distribution.spread[-1].value - 1),
        "latent MMD": distribution.mmd[-1].value,
        **inverse_dynamics(model, train, held_out),
    }


@torch.no_grad()
def _rollout(model: WorldModel, batch: LatentBatch) -> Tensor:
    return model.rollout(batch.latents[:, :1], batch.actions, batch.states[:, :-1])


def inverse_dynamics(
    model: WorldModel, train: Sequence[LatentBatch], held_out: Sequence[LatentBatch]
) -> dict[str, float]:
    """Return errors (1 - R2) of actions read from transitions by ridge regression: fitted to true or predicted ones.

    Source of the idea: ATM, arXiv 2606.09028: probes of true and predicted transitions, two by two.
    """
    of_train, of_test = (
        {kind: _transitions(model, batches, kind) for kind in ("true", "predicted")} for batches in (train, held_out)
    )
    found = {}
    for fitted, (features, actions) in of_train.items():
        mean, scale = actions.mean(axis=0), actions.std(axis=0) + 1e-6
        centre = features.mean(axis=0)
        inner = (features - centre) @ (features - centre).T
        ridge = RIDGE * np.trace(inner) / len(inner)
        weights = np.linalg.solve(inner + ridge * np.eye(len(inner)), (actions - mean) / scale)
        for tested, (others, wanted) in of_test.items():
            guessed = ((others - centre) @ (features - centre).T @ weights) * scale + mean
            moving = slice(0, 3)  # x, y, z
            error = ((guessed - wanted)[:, moving] ** 2).sum() / ((wanted - mean)[:, moving] ** 2).sum()
            found[f"inverse dynamics, {fitted} on {tested}"] = float(error)
    return found


@torch.no_grad()
def _transitions(model: WorldModel, batches: Sequence[LatentBatch], kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return latent differences of one step, flattened, and their actions."""
    features, actions = [], []
    for batch in batches:
        following = batch.latents[:, 1:]
        if kind == "predicted":
            following = model.predict(batch.latents[:, :-1], batch.actions, batch.states[:, :-1])
        features.append((following - batch.latents[:, :-1]).flatten(0, 1).flatten(1).double().numpy())
        actions.append(batch.actions.flatten(0, 1).double().numpy())
    return np.concatenate(features), np.concatenate(actions)


def visited_correlation(controller: Controller, wanted: np.ndarray, seed: int) -> float | None:
    """Return Spearman's correlation of energy and true distance over what the last search visited; None: no search.

    The samples are drawn anew from the distribution that each iteration found; the true distance is that of the hand to
    where it has to be, if the arm did exactly what a sample says.

    Source of the idea: arXiv 2608.18746, correlation over the plans that the search itself visits.

    Args:
        controller: After a decision.
        wanted: The place of the hand, metres.
        seed: Of the samples.
    """
    decision = controller.decision
    if decision is None or decision.plan is None or decision.cost is None or decision.states is None:
        return None
    generator, space = torch.Generator().manual_seed(seed), controller.space
    drawn = [
        one.mean + one.std * torch.randn(VISITED, *one.mean.shape, generator=generator)
        for one in decision.plan.iterations
    ]
    actions = space.allowed(torch.cat(drawn).clamp(space.lower, space.upper))
    with torch.no_grad():
        energies = decision.cost(actions).double().numpy()
    ends = apply_action(np.tile(decision.states[0], (len(actions), 1)), actions[:, 0].double().numpy())
    return float(spearmanr(energies, np.linalg.norm(ends[:, :3] - wanted, axis=1)).statistic)


def correlations(
    rows: Sequence[dict[str, Any]], success: Sequence[float], of: Sequence[Hashable], draws: int = 2000
) -> dict[str, Any]:
    """Return Spearman's correlation of each figure with a success, over cells, with a bootstrap interval.

    Cells of one kind, which differ in their seed alone, are drawn together: they are no news of each other.

    Args:
        rows: The figures of each cell.
        success: How it fared.
        of: Its kind.
        draws: Of the bootstrap.
    """
    names, rng, found = sorted(set.intersection(*(set(row) for row in rows))), np.random.default_rng(0), {}
    wins, kinds = np.array(success), list(dict.fromkeys(of))
    places = [np.flatnonzero([one == kind for one in of]) for kind in kinds]
    for name in names:
        values = np.array([row[name] for row in rows])
        drawn = rng.integers(len(kinds), size=(draws, len(kinds)))
        picks = (np.concatenate([places[kind] for kind in one]) for one in drawn)
        resampled = np.array([spearmanr(values[one], wins[one]).statistic for one in picks])
        low, high = np.nanpercentile(resampled, [2.5, 97.5])
        found[name] = {"value": float(spearmanr(values, wins).statistic), "low": float(low), "high": float(high)}
    return found
