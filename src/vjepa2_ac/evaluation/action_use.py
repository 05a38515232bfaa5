"""Action use: action-ranking error and energy landscapes, to measure whether the model distinguishes actions.

An action is a change of the pose, or a vector: any other list of numbers, without position and rotation.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vjepa2_ac.distributed import gather_shared, map_shared
from vjepa2_ac.episode import LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import SAME_ENERGY, ActionRanking, Landscape, Landscapes
from vjepa2_ac.intervals import estimate_mean, estimate_ratio
from vjepa2_ac.model.distances import absolute_difference
from vjepa2_ac.spaces import POSE, ActionSpace, make_vector_states

_MARGIN = 1.25  # half-width of a landscape's grid relative to the largest true action
_AXES = slice(0, 3)  # components of an action that span the grid; the position for poses


@dataclass(frozen=True)
class RolloutStart:
    """One prediction to evaluate: a frame of a held-out clip, an action, and the true frame after this action."""

    episode_id: str
    first_step: int  # control step at which the clip begins
    frame: Float[Tensor, "tokens dim"]
    following: Float[Tensor, "tokens dim"]  # the frame after the action
    state: Float[Tensor, " state_dim"]
    action: Float[Tensor, " action_dim"]
    extrinsics: Float[Tensor, " 6"] | None

    @property
    def true(self) -> Float[np.ndarray, " action_dim"]:
        """The true action in float64."""
        return np.asarray(self.action.cpu().numpy().astype(np.float64))

    @property
    def persistence(self) -> float:
        """The L1 error of persistence."""
        return float(absolute_difference(self.frame, self.following).mean())

    def generator(self, seed: int) -> np.random.Generator:
        """Return a random generator that depends only on the seed and on the episode and first step of this clip."""
        digest = hashlib.blake2b(f"{self.episode_id} {self.first_step}".encode(), digest_size=8).digest()
        return np.random.default_rng([seed, int.from_bytes(digest, "big")])


def rollout_start(
    batch: LatentBatch, row: int, step: int, *, end: int | None = None, action: Tensor | None = None
) -> RolloutStart:
    """Return frame `step` of a clip in a batch as a start.

    Args:
        batch: The clips.
        row: Index of the clip in the batch.
        step: Index of the frame.
        end: Index of the frame after the action; None: the next frame.
        action: The action between the two frames; None: the recorded action of this step.
    """
    return RolloutStart(
        episode_id=batch.episode_ids[row],
        first_step=batch.starts[row],
        frame=batch.latents[row, step].clone(),
        following=batch.latents[row, step + 1 if end is None else end].clone(),
        state=batch.states[row, step],
        action=batch.actions[row, step] if action is None else action,
        extrinsics=None if batch.extrinsics is None else batch.extrinsics[row, step],
    )


def gather_starts(starts: Sequence[RolloutStart], device: torch.device) -> list[RolloutStart]:
    """Return the starts of all processes that share the work, on the device of this process."""
    return [_on(device, start) for start in gather_shared([_on("cpu", start) for start in starts])]


def _on(device: torch.device | str, start: RolloutStart) -> RolloutStart:
    moved: dict[str, Any] = {name: value.to(device) for name, value in vars(start).items() if isinstance(value, Tensor)}
    return replace(start, **moved)


def select_moves(batch: LatentBatch, row: int, space: ActionSpace, reach: float) -> tuple[RolloutStart, ...]:
    """Return the largest move of a clip within reach, forwards and backwards in time, as two starts.

    A move is the change of the state between two frames of the clip, used as one action. If the arm is slow, the scene
    depends only on its pose: two frames several steps apart show the effect of one larger action, and in reverse order
    the effect of the opposite action. (Falling objects break this assumption; such clips are equally hard for all
    models.) If all moves exceed the reach, the shortest move is used. Actions that are not changes of the state cannot
    be added up or reversed; then only the clip's largest single step is returned.

    Args:
        batch: The clips.
        row: Index of the clip in the batch.
        space: Meaning of the actions.
        reach: Largest length of a move, in metres; not used for vectors.
    """
    if space.effect != "change":
        return (rollout_start(batch, row, int(batch.actions[row].norm(dim=-1).argmax())),)
    states = batch.states[row].cpu().numpy().astype(np.float64)
    state_space = make_vector_states(states.shape[1]) if space.position is None else POSE
    pairs = [(first, last) for first in range(len(states)) for last in range(first + 1, len(states))]
    changes = np.concatenate([state_space.compute_differences(states[[first, last]]) for first, last in pairs])
    lengths = np.linalg.norm(changes[:, state_space.size_axes], axis=1)
    within = lengths <= (np.inf if space.position is None else reach)
    ends = pairs[int(np.where(within, lengths, -1.0).argmax() if within.any() else lengths.argmin())]
    moves = []
    for first, last in (ends, ends[::-1]):
        change = torch.from_numpy(state_space.compute_differences(states[[first, last]])[0]).to(batch.actions)
        moves.append(rollout_start(batch, row, first, end=last, action=change))
    return tuple(moves)


@torch.no_grad()
def evaluate_actions(
    model: Predictor, start: RolloutStart, actions: Float[np.ndarray, "samples action_dim"], *, at_once: int
) -> Float[np.ndarray, "2 samples"]:
    """Predict one step from a frame with each action, and return the predictions' distances to two references.

    Args:
        model: The predictor.
        start: The frame, with its state and camera pose.
        actions: The actions, in the units of the data.
        at_once: Samples per batch; limits the memory.

    Returns:
        Energies and changes: the L1 distance of each prediction to the true next frame, and to the prediction for the
        true action.
    """
    expected = _predict(model, start, start.action[None])[0]
    parts = []
    for part in torch.from_numpy(actions.astype(np.float32)).to(start.action).split(at_once):  # type: ignore[no-untyped-call]  # torch
        predicted = _predict(model, start, part)
        references = (start.following, expected)
        distances = [absolute_difference(predicted, reference).mean(dim=(1, 2)) for reference in references]
        parts.append(torch.stack(distances))
    return np.asarray(torch.cat(parts, dim=1).cpu().numpy().astype(np.float64))


def _predict(
    model: Predictor, start: RolloutStart, actions: Float[Tensor, "samples action_dim"]
) -> Float[Tensor, "samples tokens dim"]:
    """Return the predictions in float32. Samples cannot share attention keys, since the frame attends to the action."""
    count = len(actions)
    camera = None if start.extrinsics is None else start.extrinsics.expand(count, 1, -1)
    frames = start.frame.expand(count, 1, *start.frame.shape)
    return model.predict(frames, actions[:, None], start.state.expand(count, 1, -1), camera)[:, 0].float()


def draw_alternatives(
    true: Float[np.ndarray, " action_dim"],
    largest: Float[np.ndarray, " action_dim"],
    space: ActionSpace,
    probes: ProbeOptions,
    generator: np.random.Generator,
) -> Float[np.ndarray, "twice_samples action_dim"]:
    """Draw alternative actions for a move: first uniform ones in the box, then the same number on the shell.

    Box: for poses (dx, dy, dz) within reach, other components as in the true action; for vectors all components within
    their largest sizes. Shell: actions as long as the true action in random directions; for poses (dx, dy, dz), other
    components as in the true action. A model that only predicts whether the robot moves ranks the true action well in
    the box, but at chance level on the shell. Each component of a vector is measured in units of its largest size.

    Args:
        true: The action of the move.
        largest: The largest size of each component in all moves; bounds the box for vectors.
        space: Meaning of the actions.
        probes: Number of `samples` of each type, and `reach_cm`.
        generator: Random generator.
    """
    box, shell = (np.tile(true, (probes.samples, 1)) for _ in range(2))
    drawn = generator.uniform(-1.0, 1.0, size=box.shape)
    if space.position is None:
        box, unit = drawn * largest, largest[space.size_axes]
    else:
        box[:, space.position] = drawn[:, space.position] * (probes.reach_cm / 100)
        unit = np.ones(len(true))[space.size_axes]
    drawn = generator.normal(size=(probes.samples, len(unit))) * (unit > 0)
    length = np.linalg.norm(true[space.size_axes] / np.where(unit > 0, unit, 1.0))
    shell[:, space.size_axes] = drawn * unit * length / np.maximum(np.linalg.norm(drawn, axis=1), 1e-12)[:, None]
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
    """Measure the action-ranking error: rank the true action of each move among `draw_alternatives`.

    Args:
        model: The predictor.
        moves: One or more; for vectors, the largest size of each component bounds the box.
        space: Meaning of the actions.
        probes: `reach_cm`, half the width of the box (poses only), `samples` of each type, and `at_once`.
        seed: Seed of the alternatives, which do not depend on the other moves.
        progress: Called with the number of finished moves.
    """
    ids = tuple(move.episode_id for move in moves)
    largest = np.abs([move.true for move in moves]).max(axis=0)

    def ranked(move: RolloutStart) -> tuple[float, ...]:
        drawn = draw_alternatives(move.true, largest, space, probes, move.generator(seed))
        evaluated = np.concatenate([move.true[None], drawn])
        (true, *energies_of_alternatives), (_, *changes) = evaluate_actions(
            model, move, evaluated, at_once=probes.at_once
        )
        energies = np.reshape(energies_of_alternatives, (2, -1))
        is_same = np.abs(energies - true) <= SAME_ENERGY * max(abs(true), 1e-12)
        # If the prediction for the true action is not finite, all alternatives count as closer.
        is_closer = energies < true if np.isfinite(true) else np.ones_like(energies)
        box, shell = np.where(is_same, 0.5, is_closer).mean(axis=1)
        return box, shell, np.mean(changes[: probes.samples]), energies[0].std(), move.persistence

    in_box, on_shell, change, spread, persistence = np.array(map_shared(moves, ranked, progress)).T
    ranks = (in_box + on_shell) / 2
    return ActionRanking(
        samples=probes.samples,
        reach=probes.reach_cm / 100,
        episode_ids=ids,
        ranks=ranks,
        rank=estimate_mean(ranks, ids),
        box=estimate_mean(in_box, ids),
        shell=estimate_mean(on_shell, ids),
        spread=estimate_ratio(spread, persistence, ids),
        change=estimate_ratio(change, persistence, ids),
    )


def measure_landscapes(
    model: Predictor,
    starts: Sequence[RolloutStart],
    space: ActionSpace,
    probes: ProbeOptions,
    progress: Progress = no_progress,
) -> Landscapes:
    """Compute the energy over a grid of the action's first three components; the other components are the true ones.

    Args:
        model: The predictor.
        starts: One frame of each clip; one or more, whose actions have at least three components.
        space: Meaning of the actions; positions are reported in cm.
        probes: `nodes` of the grid along each axis, three or more, and `at_once`. For poses the grid spans at least
            `reach_cm` in both directions.
        progress: Called with the number of finished starts.
    """
    trues = np.stack([start.true[_AXES] for start in starts])
    nodes, reach = probes.nodes, 0.0 if space.position is None else probes.reach_cm / 100
    half = max(reach, _MARGIN * float(np.abs(trues).max())) or 1.0  # 1: all true actions are zero

    def landscape(start: RolloutStart) -> Landscape:
        true = start.true[_AXES]
        return _landscape(model, start, grid_axes(true, half, nodes), true, space.display_factor, probes.at_once)

    maps = map_shared(starts, landscape, progress)
    chance = np.mean([np.linalg.norm(_nodes_of(each.axes) - each.true, axis=1).mean() for each in maps])
    return Landscapes(
        axis_names=space.names[_AXES],
        unit=space.display_unit,
        maps=tuple(maps),
        chance_distance=float(chance),
    )


def grid_axes(true: Float[np.ndarray, " 3"], half: float, nodes: int) -> Float[np.ndarray, "3 nodes"]:
    """Return equally spaced values along each axis, from about -half to half, that include exactly the true value."""
    distance = 2 * half / (nodes - 1)
    true_node = np.clip(np.round((true + half) / distance), 0, nodes - 1)
    return true[:, None] + distance * (np.arange(nodes)[None] - true_node[:, None])


def minimum_mask(energy: Float[np.ndarray, ...]) -> Bool[np.ndarray, ...]:
    """Return a mask of the nodes with the lowest energy, up to rounding; all nodes if the energy is flat."""
    least = energy.min()
    return np.asarray(energy <= least + SAME_ENERGY * abs(least))


def _landscape(
    model: Predictor, start: RolloutStart, axes: np.ndarray, true: np.ndarray, unit: float, at_once: int
) -> Landscape:
    nodes = axes.shape[1]
    evaluated = np.tile(start.true, (nodes**3, 1))
    evaluated[:, _AXES] = _nodes_of(axes)
    energy = evaluate_actions(model, start, evaluated, at_once=at_once)[0].reshape(nodes, nodes, nodes)
    minimum = evaluated[minimum_mask(energy).ravel(), _AXES].mean(axis=0)
    return Landscape(
        episode_id=start.episode_id,
        start=start.first_step,
        axes=axes * unit,
        energy=energy,
        true=true * unit,
        minimum=minimum * unit,
    )


def _nodes_of(axes: Float[np.ndarray, "3 nodes"]) -> Float[np.ndarray, "all_nodes 3"]:
    """Return the coordinates of all nodes in the order of a flattened energy: the third axis varies fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
