"""Action use: does the model distinguish the true action from others?"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vjepa2_ac.distributed import gathered, shared
from vjepa2_ac.episode import LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import SAME_ENERGY, ActionRanking, Landscape, Landscapes
from vjepa2_ac.intervals import mean_of, ratio
from vjepa2_ac.model.distances import absolute_difference
from vjepa2_ac.spaces import POSE, ActionSpace, vector_states

_ROOM = 1.25  # extent of a landscape's grid relative to the largest true action
_AXES = slice(0, 3)  # of the grid: of poses, the position


@dataclass(frozen=True)
class RolloutStart:
    """One frame of a held-out clip, and the true next frame: the state of a planner before an action."""

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
        """Return a random generator that depends only on the seed and the name of this clip, not on those before it."""
        digest = hashlib.blake2b(f"{self.episode_id} {self.first_step}".encode(), digest_size=8).digest()
        return np.random.default_rng([seed, int.from_bytes(digest, "big")])


def start_of(
    batch: LatentBatch, row: int, step: int, *, end: int | None = None, action: Tensor | None = None
) -> RolloutStart:
    """Return a step of a clip in a batch as a start; or two of its frames, and the action that leads to the second."""
    return RolloutStart(
        episode_id=batch.episode_ids[row],
        first_step=batch.starts[row],
        frame=batch.latents[row, step].clone(),
        following=batch.latents[row, step + 1 if end is None else end].clone(),
        state=batch.states[row, step],
        action=batch.actions[row, step] if action is None else action,
        extrinsics=None if batch.extrinsics is None else batch.extrinsics[row, step],
    )


def gathered_starts(starts: Sequence[RolloutStart], device: torch.device) -> list[RolloutStart]:
    """Return the starts of all processes that share work, on the device of this one."""
    return [_on(device, one) for one in gathered([_on("cpu", one) for one in starts])]


def _on(device: torch.device | str, start: RolloutStart) -> RolloutStart:
    moved: dict[str, Any] = {name: one.to(device) for name, one in vars(start).items() if isinstance(one, Tensor)}
    return replace(start, **moved)


def moves_of(batch: LatentBatch, row: int, space: ActionSpace, reach: float) -> tuple[RolloutStart, ...]:
    """Return two moves of a clip as starts: the longest within reach, from one of its frames to another, and back.

    The world around an arm that moves slowly is what its pose makes it: frames that are several steps apart show what
    one larger action does, and in reverse order what the opposite one does. (What falls or was dropped does not go
    back: such clips are harder for every model alike.) If all moves are longer, the shortest is taken. Commands that
    are no changes of the state cannot be joined or turned back: then it is the clip's largest step, as it is.

    Args:
        batch: Of clips.
        row: The clip's, in the batch.
        space: Of its actions.
        reach: Of a move, in metres; of vectors every move is within it.
    """
    if space.follows != "change":
        return (start_of(batch, row, int(batch.actions[row].norm(dim=-1).argmax())),)
    states = batch.states[row].cpu().numpy().astype(np.float64)
    kind = vector_states(states.shape[1]) if space.position is None else POSE
    pairs = [(first, last) for first in range(len(states)) for last in range(first + 1, len(states))]
    changes = np.concatenate([kind.differences(states[[first, last]]) for first, last in pairs])
    lengths = np.linalg.norm(changes[:, kind.sized], axis=1)
    within = lengths <= (np.inf if space.position is None else reach)
    ends = pairs[int(np.where(within, lengths, -1.0).argmax() if within.any() else lengths.argmin())]
    found = []
    for first, last in (ends, ends[::-1]):
        change = torch.from_numpy(kind.differences(states[[first, last]])[0]).to(batch.actions)
        found.append(start_of(batch, row, first, end=last, action=change))
    return tuple(found)


@torch.no_grad()
def evaluate_actions(
    model: Predictor, start: RolloutStart, actions: Float[np.ndarray, "samples action_dim"], *, at_once: int
) -> Float[np.ndarray, "2 samples"]:
    """Predict one step from one frame under each action; with the true state and camera.

    Args:
        model: The predictor.
        start: The frame.
        actions: In the units of the data.
        at_once: Samples per batch: limits the memory.

    Returns:
        Energies, and changes: the L1 distances of each prediction to the true next frame, and to the prediction with
        the true action.
    """
    expected = _predict(model, start, start.action[None])[0]
    found = []
    for part in torch.from_numpy(actions.astype(np.float32)).to(start.action).split(at_once):  # type: ignore[no-untyped-call]  # torch
        predicted = _predict(model, start, part)
        distances = [absolute_difference(predicted, to).mean(dim=(1, 2)) for to in (start.following, expected)]
        found.append(torch.stack(distances))
    return np.asarray(torch.cat(found, dim=1).cpu().numpy().astype(np.float64))


def _predict(
    model: Predictor, start: RolloutStart, actions: Float[Tensor, "samples action_dim"]
) -> Float[Tensor, "samples tokens dim"]:
    """Return the predictions in float32. Keys are not shared: the only frame has its action beside it."""
    count = len(actions)
    camera = None if start.extrinsics is None else start.extrinsics.expand(count, 1, -1)
    frames = start.frame.expand(count, 1, *start.frame.shape)
    return model.predict(frames, actions[:, None], start.state.expand(count, 1, -1), camera)[:, 0].float()


def alternatives(
    true: Float[np.ndarray, " action_dim"],
    largest: Float[np.ndarray, " action_dim"],
    space: ActionSpace,
    probes: ProbeOptions,
    generator: np.random.Generator,
) -> Float[np.ndarray, "twice_samples action_dim"]:
    """Draw actions for a move: first some that are uniform in the box, then as many on the shell.

    The box: for poses (dx, dy, dz) within reach, the rest being true; for vectors every number. The shell: as long as
    the true action, in any direction; of poses (dx, dy, dz), the rest being true. A model that only knows whether the
    robot moves ranks the true action high in the box, and by chance on the shell. Each number of a vector is measured
    in its largest size.

    Args:
        true: The action of the move.
        largest: The largest size of each number in all moves; of vectors it bounds the box.
        space: Of the actions.
        probes: Their `samples` of each kind, and `reach_cm`.
        generator: Of the draws.
    """
    box, shell = (np.tile(true, (probes.samples, 1)) for _ in range(2))
    drawn = generator.uniform(-1.0, 1.0, size=box.shape)
    if space.position is None:
        box, unit = drawn * largest, largest[space.sized]
    else:
        box[:, space.position] = drawn[:, space.position] * (probes.reach_cm / 100)
        unit = np.ones(len(true))[space.sized]
    drawn = generator.normal(size=(probes.samples, len(unit))) * (unit > 0)
    length = np.linalg.norm(true[space.sized] / np.where(unit > 0, unit, 1.0))
    shell[:, space.sized] = drawn * unit * length / np.maximum(np.linalg.norm(drawn, axis=1), 1e-12)[:, None]
    return np.concatenate([box, shell])


def rank_actions(
    model: Predictor,
    moves: Sequence[RolloutStart],
    space: ActionSpace,
    probes: ProbeOptions,
    *,
    seed: int,
    progress: Progress = no_progress,
) -> ActionRanking:
    """Rank the true action of each move among alternatives in the box and of the same length.

    Args:
        model: The predictor.
        moves: One or more; of vectors, the largest of each number bounds the box.
        space: Of the actions.
        probes: Their `reach_cm`, half the width of the box (of poses only), `samples` of each kind, and `at_once`.
        seed: Of the alternatives: a move gets the same ones whatever else is measured.
        progress: Called with the number of finished moves.
    """
    ids = tuple(move.episode_id for move in moves)
    largest = np.abs([move.true for move in moves]).max(axis=0)

    def ranked(move: RolloutStart) -> tuple[float, ...]:
        drawn = alternatives(move.true, largest, space, probes, move.generator(seed))
        evaluated = np.concatenate([move.true[None], drawn])
        (true, *others), (_, *changes) = evaluate_actions(model, move, evaluated, at_once=probes.at_once)
        energies = np.reshape(others, (2, -1))
        is_same = np.abs(energies - true) <= SAME_ENERGY * max(abs(true), 1e-12)
        # A prediction that is not finite is the farthest: of the true action, no alternative is farther.
        is_closer = energies < true if np.isfinite(true) else np.ones_like(energies)
        box, shell = np.where(is_same, 0.5, is_closer).mean(axis=1)
        return box, shell, np.mean(changes[: probes.samples]), energies[0].std(), move.persistence

    in_box, on_shell, change, spread, now = np.array(shared(moves, ranked, progress)).T
    ranks = (in_box + on_shell) / 2
    return ActionRanking(
        samples=probes.samples,
        reach=probes.reach_cm / 100,
        episode_ids=ids,
        ranks=ranks,
        rank=mean_of(ranks, ids),
        box=mean_of(in_box, ids),
        shell=mean_of(on_shell, ids),
        spread=ratio(spread, now, ids),
        change=ratio(change, now, ids),
    )


def measure_landscapes(
    model: Predictor,
    starts: Sequence[RolloutStart],
    space: ActionSpace,
    probes: ProbeOptions,
    progress: Progress = no_progress,
) -> Landscapes:
    """Compute the energy over a grid of the first three numbers of the action, the others being the true ones.

    Args:
        model: The predictor.
        starts: One frame of each clip; one or more, with actions of three numbers or more.
        space: Of the actions; positions are reported in cm.
        probes: Their `nodes` of the grid along each axis, three or more, and `at_once`; of poses the grid spans at
            least `reach_cm` in both directions.
        progress: Called with the number of finished starts.
    """
    trues = np.stack([start.true[_AXES] for start in starts])
    nodes, reach = probes.nodes, 0.0 if space.position is None else probes.reach_cm / 100
    half = max(reach, _ROOM * float(np.abs(trues).max())) or 1.0  # vectors that are all zero

    def landscape(start: RolloutStart) -> Landscape:
        true = start.true[_AXES]
        return _landscape(model, start, grid_axes(true, half, nodes), true, space.shown_factor, probes.at_once)

    maps = shared(starts, landscape, progress)
    chance = np.mean([np.linalg.norm(_places_of(one.axes) - one.true, axis=1).mean() for one in maps])
    return Landscapes(
        axis_names=space.names[_AXES],
        unit=space.shown_unit,
        maps=tuple(maps),
        chance_distance=float(chance),
    )


def grid_axes(true: Float[np.ndarray, " 3"], half: float, nodes: int) -> Float[np.ndarray, "3 nodes"]:
    """Return the values along each axis: equally spaced, from about -half to half, one of them exactly the true one."""
    distance = 2 * half / (nodes - 1)
    place = np.clip(np.round((true + half) / distance), 0, nodes - 1)
    return true[:, None] + distance * (np.arange(nodes)[None] - place[:, None])


def lowest(energy: Float[np.ndarray, ...]) -> Bool[np.ndarray, ...]:
    """Return where the energy is lowest; everywhere, if it is flat."""
    least = energy.min()
    return np.asarray(energy <= least + SAME_ENERGY * abs(least))


def _landscape(
    model: Predictor, start: RolloutStart, axes: np.ndarray, true: np.ndarray, unit: float, at_once: int
) -> Landscape:
    nodes = axes.shape[1]
    evaluated = np.tile(start.true, (nodes**3, 1))
    evaluated[:, _AXES] = _places_of(axes)
    energy = evaluate_actions(model, start, evaluated, at_once=at_once)[0].reshape(nodes, nodes, nodes)
    minimum = evaluated[lowest(energy).ravel(), _AXES].mean(axis=0)
    return Landscape(
        episode_id=start.episode_id,
        start=start.first_step,
        axes=axes * unit,
        energy=energy,
        true=true * unit,
        minimum=minimum * unit,
    )


def _places_of(axes: Float[np.ndarray, "3 nodes"]) -> Float[np.ndarray, "places 3"]:
    """Return every node, the third axis fastest: the order of a flattened energy."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
