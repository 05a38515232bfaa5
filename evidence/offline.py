"""Measure offline metrics that may predict a model's success in closed loop; lower is better for each."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.action_use import rank_actions, select_moves
from vjepa2_ac.evaluation.distribution import LatentSums, compare_distributions
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.spaces import ActionSpace

MOVES = 32  # clips whose moves are ranked


@torch.no_grad()
def measure_offline(model: WorldModel, space: ActionSpace, held_out: Sequence[LatentBatch]) -> dict[str, float]:
    """Return the offline metrics on clips of held-out episodes."""
    true, predicted = LatentSums(), LatentSums()
    for batch in held_out:
        true.add(batch.latents[:, 1:], batch.episode_ids)
        rolled = model.rollout(batch.latents[:, :1], batch.actions, batch.states[:, :-1])
        predicted.add(rolled, batch.episode_ids)
    distribution = compare_distributions(predicted, true)
    clips = [(batch, row) for batch in held_out for row in range(len(batch.starts))]
    ranked = [clips[index] for index in np.linspace(0, len(clips) - 1, MOVES).astype(int)]
    moves = [move for batch, row in ranked for move in select_moves(batch, row, space, 0.075)]
    ranking = rank_actions(model, moves, space, ProbeOptions(samples=32), seed=0)
    return {
        "action-ranking error": ranking.rank.value,
        "energy spread, negative": -ranking.spread.value,
        "spread of latents, distance from 1": abs(distribution.spread[-1].value - 1),
        "latent MMD": distribution.mmd[-1].value,
    }


def correlations(
    rows: Sequence[dict[str, Any]], outcomes: Sequence[float], groups: Sequence[Hashable], draws: int = 2000
) -> dict[str, Any]:
    """Return Spearman's correlation of each metric with an outcome, with a bootstrap interval.

    Rows of the same group, such as the checkpoints of a run, are drawn together, because they are not independent.
    """
    outcome, distinct = np.array(outcomes), list(dict.fromkeys(groups))
    indices = [np.flatnonzero([group == each for group in groups]) for each in distinct]
    drawn = np.random.default_rng(0).integers(len(distinct), size=(draws, len(distinct)))
    samples = [np.concatenate([indices[number] for number in numbers]) for numbers in drawn]
    result = {}
    for name in sorted(set.intersection(*(set(row) for row in rows))):
        values = np.array([row[name] for row in rows])
        resampled = [spearmanr(values[sample], outcome[sample]).statistic for sample in samples]
        low, high = np.nanpercentile(resampled, [2.5, 97.5])
        result[name] = {"value": float(spearmanr(values, outcome).statistic), "low": float(low), "high": float(high)}
    return result
