"""Action ranking: the rank of the true action by energy, for moves as large as planned ones.

A model may predict the steps of its data well and yet give a planner nothing to go by: fine-tuned on steps of one
direction and size, it may know the outcome without looking at the action. So the moves are stretched over several
steps and played backwards, and the true action is ranked among others in a box and among others of its own length.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, evaluate_actions
from vjepa2_ac.evaluation.action_use.sensitivity import ActionPool, place_of
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.result import ActionRanking
from vjepa2_ac.intervals import mean_of, ratio
from vjepa2_ac.spaces import ActionSpace


def pool_of(moves: Sequence[RolloutStart], space: ActionSpace, *, reach: float, samples: int, seed: int) -> ActionPool:
    """Return how other actions are drawn for moves: of vectors, the largest of each number bounds the box."""
    actions = np.stack([move.action.cpu().numpy().astype(np.float64) for move in moves])
    return ActionPool(actions, tuple(move.episode_id for move in moves), space, reach, samples, seed)


def rank_actions(
    model: Predictor, moves: Sequence[RolloutStart], pool: ActionPool, *, at_once: int, progress: Progress = no_progress
) -> ActionRanking:
    """Rank the true action of each move.

    Args:
        model: The predictor.
        moves: One or more.
        pool: How other actions are drawn.
        at_once: Samples per batch: limits the memory.
        progress: Called with the number of finished moves.
    """
    rows = []
    for done, move in enumerate(moves, start=1):
        generator = move.generator(pool.seed)
        true = move.action.cpu().numpy().astype(np.float64)[None]
        drawn = np.concatenate([true, pool.in_box(move, generator), pool.on_shell(move, generator)])
        own, box, shell = np.split(evaluate_actions(model, move, drawn, at_once=at_once).energy, [1, 1 + pool.samples])
        rows.append((_rank(own[0], box), _rank(own[0], shell), float(box.std()), move.persistence))
        progress(done, len(moves))
    in_box, on_shell, spread, now = np.array(rows).T
    ids, ranks = tuple(move.episode_id for move in moves), (in_box + on_shell) / 2
    return ActionRanking(
        samples=pool.samples,
        reach=pool.reach,
        episode_ids=ids,
        ranks=ranks,
        rank=mean_of(ranks, ids),
        box=mean_of(in_box, ids),
        shell=mean_of(on_shell, ids),
        spread=ratio(spread, now, ids),
    )


def _rank(true: float, others: np.ndarray) -> float:
    """Return the share of the others with a lower energy; equal ones count half."""
    lower, same = place_of(true, others)
    return (lower + same / 2) / len(others)
