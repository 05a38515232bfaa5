"""Action use: does the model distinguish the true action from others?"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vjepa2_ac.distances import absolute_difference
from vjepa2_ac.episode import LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.result import ActionRanking, Landscape, Landscapes, Ranking, Sensitivity
from vjepa2_ac.intervals import Estimate, mean_of, ratio
from vjepa2_ac.spaces import POSE, ActionSpace, vector_states


@dataclass(frozen=True)
class RolloutStart:
    """One frame of a held-out clip, and the true next frame: the state of a planner before an action."""

    clip: int  # index into the evaluation's clips
    episode_id: str
    first_step: int  # control step at which the clip begins
    frame: Float[Tensor, "tokens dim"]
    following: Float[Tensor, "tokens dim"]  # the next frame
    state: Float[Tensor, " state_dim"]
    action: Float[Tensor, " action_dim"]  # that led to it
    extrinsics: Float[Tensor, " 6"] | None

    @property
    def true(self) -> Float[np.ndarray, " action_dim"]:
        """The action, in float64."""
        return np.asarray(self.action.cpu().numpy().astype(np.float64))

    @property
    def persistence(self) -> float:
        """The L1 error of predicting that nothing changes."""
        return float(absolute_difference(self.frame, self.following).mean())

    def generator(self, seed: int) -> np.random.Generator:
        """Return a random generator that depends only on the seed and this clip, not on those before it."""
        return clip_generator(seed, self.episode_id, self.first_step)


@dataclass(frozen=True)
class EvaluatedActions:
    """The results of each evaluated action of a start."""

    energy: Float[np.ndarray, " samples"]  # L1 distance of the prediction to the true next frame
    change: Float[np.ndarray, " samples"]  # L1 distance of the prediction to that with the true action


def clip_generator(seed: int, episode_id: str, first_step: int) -> np.random.Generator:
    """Return a random generator that depends only on the seed and the name of a clip, not on the clips before it."""
    digest = hashlib.blake2b(f"{episode_id} {first_step}".encode(), digest_size=8).digest()
    return np.random.default_rng([seed, int.from_bytes(digest, "big")])


def start_of(batch: LatentBatch, row: int, step: int, clip: int) -> RolloutStart:
    """Return a step of a clip in a batch as a start."""
    return _start(batch, row, clip, (step, step + 1), batch.actions[row, step])


def moves_of(batch: LatentBatch, row: int, clip: int, space: ActionSpace, reach: float) -> tuple[RolloutStart, ...]:
    """Return two moves of a clip as starts: the longest within reach, from one of its frames to another, and back.

    The world around an arm that moves slowly is what its pose makes it: frames that are several steps apart show what
    one larger action does, and in reverse order what the opposite one does. (What falls or was dropped does not go
    back: such clips are harder for every model alike.) If all moves are longer, the shortest is taken. Commands that
    are no changes of the state cannot be joined or turned back: then it is the clip's largest step, as it is.

    Args:
        batch: Of clips.
        row: The clip's, in the batch.
        clip: Its index.
        space: Of its actions.
        reach: Of a move, in metres; of vectors every move is within it.
    """
    if space.follows != "change":
        return (start_of(batch, row, int(batch.actions[row].norm(dim=-1).argmax()), clip),)
    states = batch.states[row].cpu().numpy().astype(np.float64)
    kind = vector_states(states.shape[1]) if space.position is None else POSE
    pairs = [(first, last) for first in range(len(states)) for last in range(first + 1, len(states))]
    changes = np.concatenate([kind.differences(states[[first, last]]) for first, last in pairs])
    lengths = np.linalg.norm(changes[:, kind.sized], axis=1)
    within = lengths <= (np.inf if space.position is None else reach)
    ends = pairs[int(np.where(within, lengths, -1.0).argmax() if within.any() else lengths.argmin())]
    found = []
    for pair in (ends, ends[::-1]):
        change = kind.differences(states[list(pair)])[0]
        found.append(_start(batch, row, clip, pair, torch.from_numpy(change).to(batch.actions)))
    return tuple(found)


@torch.no_grad()
def evaluate_actions(
    model: Predictor, start: RolloutStart, actions: Float[np.ndarray, "samples action_dim"], *, at_once: int
) -> EvaluatedActions:
    """Predict one step from one frame under each action; with the true state and camera.

    Args:
        model: The predictor.
        start: The frame.
        actions: In the units of the data.
        at_once: Samples per batch: limits the memory.
    """
    expected = _predict(model, start, start.action[None])[0]
    energies, changes = [], []
    for part in torch.from_numpy(actions.astype(np.float32)).to(start.action).split(at_once):  # type: ignore[no-untyped-call]  # torch
        predicted = _predict(model, start, part)
        energies.append(absolute_difference(predicted, start.following).mean(dim=(1, 2)))
        changes.append(absolute_difference(predicted, expected).mean(dim=(1, 2)))
    return EvaluatedActions(*(torch.cat(parts).cpu().numpy().astype(np.float64) for parts in (energies, changes)))


def _start(batch: LatentBatch, row: int, clip: int, ends: tuple[int, int], action: Tensor) -> RolloutStart:
    """Return two frames of a clip, and the action that leads from the first to the second, as a start."""
    first, last = ends
    return RolloutStart(
        clip=clip,
        episode_id=batch.episode_ids[row],
        first_step=batch.starts[row],
        frame=batch.latents[row, first].clone(),
        following=batch.latents[row, last].clone(),
        state=batch.states[row, first],
        action=action,
        extrinsics=None if batch.extrinsics is None else batch.extrinsics[row, first],
    )


def _predict(
    model: Predictor, start: RolloutStart, actions: Float[Tensor, "samples action_dim"]
) -> Float[Tensor, "samples tokens dim"]:
    """Return the predictions in float32. Keys are not shared: the only frame has its action beside it."""
    count = len(actions)
    camera = None if start.extrinsics is None else start.extrinsics.expand(count, 1, -1)
    frames = start.frame.expand(count, 1, *start.frame.shape)
    return model.predict(frames, actions[:, None], start.state.expand(count, 1, -1), camera)[:, 0].float()


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

    def of_others(self, start: RolloutStart, generator: np.random.Generator) -> Float[np.ndarray, "samples action_dim"]:
        """Draw actions of other episodes, with replacement; of the same one if there is no other."""
        others = np.flatnonzero(np.array(self.episode_ids) != start.episode_id)
        chosen = generator.choice(others if len(others) else np.arange(len(self.actions)), size=self.samples)
        return np.asarray(self.actions[chosen])

    def in_box(self, start: RolloutStart, generator: np.random.Generator) -> Float[np.ndarray, "samples action_dim"]:
        """Draw uniformly: for poses (dx, dy, dz) in the box, the rest being true; for vectors every number."""
        true, half = start.true, np.abs(self.actions).max(axis=0)
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
        true, moved = start.true, self.space.sized
        unit = np.ones(len(true))
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
        generator = start.generator(pool.seed)
        drawn = pool.of_others(start, generator), pool.in_box(start, generator)
        evaluated = evaluate_actions(model, start, np.concatenate([start.true[None], *drawn]), at_once=at_once)
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


def pool_of(moves: Sequence[RolloutStart], space: ActionSpace, *, reach: float, samples: int, seed: int) -> ActionPool:
    """Return how other actions are drawn for moves: of vectors, the largest of each number bounds the box."""
    return ActionPool(
        np.stack([move.true for move in moves]), tuple(move.episode_id for move in moves), space, reach, samples, seed
    )


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
        drawn = np.concatenate([move.true[None], pool.in_box(move, generator), pool.on_shell(move, generator)])
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


_ROOM = 1.25  # extent of the grid relative to the largest true action
_AXES = slice(0, 3)  # of the grid: of poses, the position


@dataclass(frozen=True)
class LandscapeGrid:
    """A grid of actions over their first three numbers."""

    space: ActionSpace  # of the actions; positions are reported in cm
    nodes: int  # along each axis, three or more
    reach: float  # it spans at least -reach .. reach (metres; of vectors: in its own numbers)


def measure_landscapes(
    model: Predictor,
    starts: Sequence[RolloutStart],
    grid: LandscapeGrid,
    *,
    at_once: int,
    progress: Progress = no_progress,
) -> Landscapes:
    """Compute the energy over a grid of the first three numbers of the action, the others being the true ones.

    Args:
        model: The predictor.
        starts: One frame of each clip; one or more, with actions of three numbers or more.
        grid: The actions.
        at_once: Samples per batch.
        progress: Called with the number of finished starts.
    """
    nodes, unit = grid.nodes, grid.space.shown_factor
    trues = np.stack([start.true[_AXES] for start in starts])
    half = max(grid.reach, _ROOM * float(np.abs(trues).max())) or 1.0  # vectors that are all zero
    maps = []
    for done, (start, true) in enumerate(zip(starts, trues, strict=True), start=1):
        maps.append(_landscape(model, start, grid_axes(true, half, nodes), true, unit, at_once))
        progress(done, len(starts))
    first, second, third = grid.space.names[_AXES]
    return _summary(tuple(maps), (first, second, third), grid.space.shown_unit, least=unit * half / (nodes - 1))


def grid_axes(true: Float[np.ndarray, " 3"], half: float, nodes: int) -> Float[np.ndarray, "3 nodes"]:
    """Return the values along each axis: equally spaced, from about -half to half, one of them exactly the true one."""
    distance = 2 * half / (nodes - 1)
    place = np.clip(np.round((true + half) / distance), 0, nodes - 1)
    return true[:, None] + distance * (np.arange(nodes)[None] - place[:, None])


def lowest(energy: Float[np.ndarray, ...]) -> Bool[np.ndarray, ...]:
    """Return where the energy is lowest; everywhere, if it is flat."""
    least = energy.min()
    return np.asarray(energy <= least + _SAME * abs(least))


def _landscape(
    model: Predictor, start: RolloutStart, axes: np.ndarray, true: np.ndarray, unit: float, at_once: int
) -> Landscape:
    nodes = axes.shape[1]
    evaluated = np.tile(start.true, (nodes**3, 1))
    evaluated[:, _AXES] = _places(axes)
    energy = evaluate_actions(model, start, evaluated, at_once=at_once).energy.reshape(nodes, nodes, nodes)
    minimum = evaluated[lowest(energy).ravel(), _AXES].mean(axis=0)
    return Landscape(
        episode_id=start.episode_id,
        start=start.first_step,
        axes=axes * unit,
        energy=energy,
        true=true * unit,
        minimum=minimum * unit,
        distance=float(np.linalg.norm(minimum - true)) * unit,
    )


def _summary(maps: tuple[Landscape, ...], names: tuple[str, str, str], unit: str, *, least: float) -> Landscapes:
    ids = tuple(one.episode_id for one in maps)
    chance = np.mean([np.linalg.norm(_places(one.axes) - one.true, axis=1).mean() for one in maps])
    agreements, chances, counts = zip(*(_signs(maps, axis, least) for axis in range(3)), strict=True)
    return Landscapes(
        axis_names=names,
        unit=unit,
        maps=maps,
        distance=mean_of(np.array([one.distance for one in maps]), ids),
        chance_distance=float(chance),
        sign_agreement=agreements,
        sign_chance=chances,
        sign_clips=counts,
        sign_least=least,
    )


def _signs(maps: Sequence[Landscape], axis: int, least: float) -> tuple[Estimate, float, int]:
    """Return how often the minimum has the true action's sign, the same of any node, and the number of clips.

    Clips that hardly move along the axis are not counted.
    """
    counted = [one for one in maps if abs(one.true[axis]) >= least]
    if not counted:
        return Estimate(np.nan, np.nan, np.nan), np.nan, 0
    agreeing, by_chance = [], []
    for one in counted:
        right = np.sign(_places(one.axes)[:, axis]) == np.sign(one.true[axis])
        agreeing.append(right[lowest(one.energy).ravel()].mean())
        by_chance.append(right.mean())
    return mean_of(np.array(agreeing), [one.episode_id for one in counted]), float(np.mean(by_chance)), len(counted)


def _places(axes: Float[np.ndarray, "3 nodes"]) -> Float[np.ndarray, "places 3"]:
    """Return every node, the third axis fastest: the order of a flattened energy."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
