"""Action sensitivity: how predictions change with the actions, and the rank of the true action by energy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, evaluate_actions
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.result import Ranking, Sensitivity
from vjepa2_ac.intervals import mean_of, ratio
from vjepa2_ac.spaces import ActionSpace

TOP = (1, 5, 10)
_SAME = 1e-6  # relative difference below which energies are equal: rounding decides no rank


@dataclass(frozen=True)
class ActionPool:
    """Actions of all clips, a pool to draw others from."""

    actions: Float[np.ndarray, "count action_dim"]
    episode_ids: tuple[str, ...]  # of each action
    space: ActionSpace
    reach: float  # half the width of the box along each of x, y, z, in metres; of poses only
    samples: int  # drawn per start, from each of the two sources
    seed: int  # a start gets the same actions whatever else is measured

    def drawn_for(self, start: RolloutStart) -> Float[np.ndarray, "others action_dim"]:
        """Draw other actions for a start: those of other episodes, then those in the box."""
        generator = start.generator(self.seed)
        return np.concatenate([self.of_others(start, generator), self.in_box(start, generator)])

    def of_others(self, start: RolloutStart, generator: np.random.Generator) -> Float[np.ndarray, "samples action_dim"]:
        """Draw actions of other episodes, with replacement; of the same one if there is no other."""
        others = np.flatnonzero(np.array(self.episode_ids) != start.episode_id)
        chosen = generator.choice(others if len(others) else np.arange(len(self.actions)), size=self.samples)
        return np.asarray(self.actions[chosen])

    def in_box(self, start: RolloutStart, generator: np.random.Generator) -> Float[np.ndarray, "samples action_dim"]:
        """Draw uniformly: for poses (dx, dy, dz) in the box, the rest being true; for vectors every number."""
        true = start.action.cpu().numpy().astype(np.float64)
        half = np.abs(self.actions).max(axis=0)
        drawn = generator.uniform(-1.0, 1.0, size=(self.samples, len(true)))
        if self.space.position is None:
            return np.asarray(drawn * half)
        evaluated = np.tile(true, (self.samples, 1))
        evaluated[:, self.space.position] = drawn[:, self.space.position] * self.reach
        return evaluated

    def on_shell(self, start: RolloutStart, generator: np.random.Generator) -> Float[np.ndarray, "samples action_dim"]:
        """Draw actions as long as the true one, in any direction: of poses (dx, dy, dz), the rest being true.

        A model that only knows whether the robot moves ranks the true action high in the box, and by chance here. Each
        number of a vector is measured in its largest size.
        """
        true = start.action.cpu().numpy().astype(np.float64)
        moved, unit = self.space.sized, np.ones(len(true))
        if self.space.position is None:
            unit = np.abs(self.actions).max(axis=0)
        unit = unit[moved]
        drawn = generator.normal(size=(self.samples, len(unit))) * (unit > 0)
        length = np.linalg.norm(true[moved] / np.where(unit > 0, unit, 1.0))
        evaluated = np.tile(true, (self.samples, 1))
        evaluated[:, moved] = drawn * unit * length / np.maximum(np.linalg.norm(drawn, axis=1), 1e-12)[:, None]
        return evaluated

    def words(self, drawn_from: Literal["clips", "box"]) -> str:
        """Return as text where actions are drawn from."""
        if drawn_from == "clips":
            return "actions of other episodes"
        if self.space.position is not None:
            return f"(dx, dy, dz) uniform within {self.reach * 100:g} cm along each axis"
        return "every number uniform within its largest size"


def measure_sensitivity(
    model: Predictor,
    starts: Sequence[RolloutStart],
    pool: ActionPool,
    *,
    at_once: int,
    progress: Progress = no_progress,
) -> Sensitivity:
    """Evaluate other actions from each start.

    Args:
        model: The predictor.
        starts: One frame of each clip.
        pool: The pool of other actions.
        at_once: Samples per batch.
        progress: Called with the number of finished starts.
    """
    changes, persistence, samples = [], [], pool.samples
    ranks: dict[Literal["clips", "box"], list[tuple[float, float]]] = {"clips": [], "box": []}
    for done, start in enumerate(starts, start=1):
        true = start.action.cpu().numpy().astype(np.float64)[None]
        evaluated = evaluate_actions(model, start, np.concatenate([true, pool.drawn_for(start)]), at_once=at_once)
        own, others, boxed = np.split(evaluated.energy, [1, 1 + samples])
        ranks["clips"].append(place_of(own[0], others))
        ranks["box"].append(place_of(own[0], boxed))
        changes.append(float(evaluated.change[1 : 1 + samples].mean()))
        persistence.append(start.persistence)
        progress(done, len(starts))
    ids = tuple(start.episode_id for start in starts)
    clips = tuple(start.clip for start in starts)
    return Sensitivity(
        change=ratio(np.array(changes), np.array(persistence), ids),
        change_by_clip=np.array(changes) / np.maximum(np.array(persistence), 1e-12),
        rankings=tuple(_ranking(name, pool.words(name), samples, clips, np.array(ranks[name]), ids) for name in ranks),
    )


def place_of(true: float, others: Float[np.ndarray, " samples"]) -> tuple[float, float]:
    """Return how many others have a lower energy, and how many an equal one."""
    same = np.abs(others - true) <= _SAME * max(abs(true), 1e-12)
    return float(((others < true) & ~same).sum()), float(same.sum())


def _ranking(
    drawn_from: Literal["clips", "box"],
    words: str,
    samples: int,
    clips: tuple[int, ...],
    places: Float[np.ndarray, "clips 2"],
    episode_ids: tuple[str, ...],
) -> Ranking:
    lower, same = places[:, 0], places[:, 1]
    rank = (lower + same / 2) / samples
    among = {k: np.clip((k - lower) / (same + 1), 0.0, 1.0) for k in TOP if k <= samples}
    return Ranking(
        drawn_from=drawn_from,
        words=words,
        samples=samples,
        clips=clips,
        rank=rank,
        mean_rank=mean_of(rank, episode_ids),
        top={k: mean_of(share, episode_ids) for k, share in among.items()},
    )
