"""Action use: action-ranking error and energy landscapes, to measure whether the model distinguishes actions.

An action is a change of the pose, or a vector. A vector is any other list of numbers, without position and rotation.
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
class Transition:
    """A frame of a held-out clip, an action, and the true frame after this action."""

    episode_id: str
    first_step: int  # control step at which the clip begins
    frame: Float[Tensor, "tokens dim"]
    next_frame: Float[Tensor, "tokens dim"]  # the true frame after the action
    state: Float[Tensor, " state_dim"]
    action: Float[Tensor, " action_dim"]
    extrinsics: Float[Tensor, " 6"] | None

    @property
    def true_action(self) -> Float[np.ndarray, " action_dim"]:
        """The action as a float64 array."""
        return np.asarray(self.action.cpu().numpy().astype(np.float64))

    @property
    def persistence(self) -> float:
        """The L1 error of persistence, which predicts `frame`."""
        return float(absolute_difference(self.frame, self.next_frame).mean())

    def make_generator(self, seed: int) -> np.random.Generator:
        """Return a random generator that depends only on the seed, the episode, and the first step of the clip."""
        digest = hashlib.blake2b(f"{self.episode_id} {self.first_step}".encode(), digest_size=8).digest()
        return np.random.default_rng([seed, int.from_bytes(digest, "big")])


def make_transition(
    batch: LatentBatch, row: int, step: int, *, end: int | None = None, action: Tensor | None = None
) -> Transition:
    """Return a transition of a clip in a batch.

    Args:
        batch: The clips.
        row: Index of the clip in the batch.
        step: Index of the frame before the action.
        end: Index of the frame after the action; None: the next frame.
        action: The action between the two frames; None: the recorded action of this step.
    """
    return Transition(
        episode_id=batch.episode_ids[row],
        first_step=batch.starts[row],
        frame=batch.latents[row, step].clone(),
        next_frame=batch.latents[row, step + 1 if end is None else end].clone(),
        state=batch.states[row, step],
        action=batch.actions[row, step] if action is None else action,
        extrinsics=None if batch.extrinsics is None else batch.extrinsics[row, step],
    )


def gather_transitions(transitions: Sequence[Transition], device: torch.device) -> list[Transition]:
    """Return the transitions of all processes that share the work, on the device of this process."""
    on_cpu = [_copy_to("cpu", transition) for transition in transitions]
    return [_copy_to(device, transition) for transition in gather_shared(on_cpu)]


def _copy_to(device: torch.device | str, transition: Transition) -> Transition:
    tensors = {name: value for name, value in vars(transition).items() if isinstance(value, Tensor)}
    copies: dict[str, Any] = {name: tensor.to(device) for name, tensor in tensors.items()}
    return replace(transition, **copies)


def select_moves(batch: LatentBatch, row: int, space: ActionSpace, max_length_m: float) -> tuple[Transition, ...]:
    """Return the longest move of a clip up to a maximum length, forwards and backwards in time.

    A *move* is a transition between any two frames of a clip. Its action is the change of the state between them. If
    the arm is slow, the scene depends only on the pose of the arm. Two frames several steps apart then show the effect
    of one larger action, and in reverse order the effect of the opposite action. Falling objects break this assumption,
    but such clips are equally hard for all models. If all moves are too long, the shortest move is returned. Actions
    that are not changes of the state cannot be added up or reversed: then the single step with the largest action is
    returned.

    Args:
        batch: The clips.
        row: Index of the clip in the batch.
        space: Meaning of the actions.
        max_length_m: Maximum length of a move, in metres; not used for vectors.
    """
    if space.effect != "change":
        return (make_transition(batch, row, int(batch.actions[row].norm(dim=-1).argmax())),)
    states = batch.states[row].cpu().numpy().astype(np.float64)
    state_space = make_vector_states(states.shape[1]) if space.position is None else POSE
    pairs = [(first, last) for first in range(len(states)) for last in range(first + 1, len(states))]
    changes = np.concatenate([state_space.compute_differences(states[[first, last]]) for first, last in pairs])
    lengths = np.linalg.norm(changes[:, state_space.size_axes], axis=1)
    is_allowed = lengths <= (np.inf if space.position is None else max_length_m)
    ends = pairs[int(np.where(is_allowed, lengths, -1.0).argmax() if is_allowed.any() else lengths.argmin())]
    moves = []
    for first, last in (ends, ends[::-1]):
        change = torch.from_numpy(state_space.compute_differences(states[[first, last]])[0]).to(batch.actions)
        moves.append(make_transition(batch, row, first, end=last, action=change))
    return tuple(moves)


@torch.no_grad()
def evaluate_actions(
    model: Predictor, transition: Transition, actions: Float[np.ndarray, "samples action_dim"], *, at_once: int
) -> Float[np.ndarray, "2 samples"]:
    """Predict the frame after each action, and return the distances of the predictions to two references.

    Args:
        model: The predictor.
        transition: The frame before the action, the true action, and the true next frame.
        actions: The actions, in the units of the data.
        at_once: Samples per batch; limits the memory.

    Returns:
        Energies and changes: the L1 distance of each prediction to the true next frame, and to the prediction for the
        true action.
    """
    references = transition.next_frame, _predict(model, transition, transition.action[None])[0]
    distances = []
    for part in torch.from_numpy(actions.astype(np.float32)).to(transition.action).split(at_once):  # type: ignore[no-untyped-call]  # torch
        predicted = _predict(model, transition, part)
        differences = [absolute_difference(predicted, reference) for reference in references]
        distances.append(torch.stack([difference.mean(dim=(1, 2)) for difference in differences]))
    return np.asarray(torch.cat(distances, dim=1).cpu().numpy().astype(np.float64))


def _predict(
    model: Predictor, transition: Transition, actions: Float[Tensor, "samples action_dim"]
) -> Float[Tensor, "samples tokens dim"]:
    """Return the predicted next frame for each action, in float32."""
    # The frame is repeated for each action: its attention keys cannot be shared, because it attends to the action.
    num_samples, frame = len(actions), transition.frame
    camera = None if transition.extrinsics is None else transition.extrinsics.expand(num_samples, 1, -1)
    frames, states = frame.expand(num_samples, 1, *frame.shape), transition.state.expand(num_samples, 1, -1)
    return model.predict(frames, actions[:, None], states, camera)[:, 0].float()


def draw_alternatives(
    true_action: Float[np.ndarray, " action_dim"],
    largest: Float[np.ndarray, " action_dim"],
    space: ActionSpace,
    probes: ProbeOptions,
    generator: np.random.Generator,
) -> Float[np.ndarray, "twice_samples action_dim"]:
    """Draw alternative actions for a move: first from the box, then the same number from the shell.

    Actions in the box are distributed uniformly: the position of poses within ±`probes.reach_cm`, all components of
    vectors within ±`largest`. Actions on the shell have the length of the true action and a random direction. Only the
    position of poses is drawn; the other components are those of the true action. Each component of a vector is
    measured in units of `largest`. A model that only predicts whether the robot moves ranks the true action well in the
    box, but at chance level on the shell.

    Args:
        true_action: The action of the move.
        largest: The largest absolute value of each component in all moves.
        space: Meaning of the actions.
        probes: `samples`, the number of alternatives of each type, and `reach_cm`.
        generator: Random generator.
    """
    box, shell = (np.tile(true_action, (probes.samples, 1)) for _ in range(2))
    uniform = generator.uniform(-1.0, 1.0, size=box.shape)
    if space.position is None:
        box, unit = uniform * largest, largest[space.size_axes]
    else:
        box[:, space.position] = uniform[:, space.position] * (probes.reach_cm / 100)
        unit = np.ones(len(true_action))[space.size_axes]
    normal = generator.normal(size=(probes.samples, len(unit))) * (unit > 0)
    length = np.linalg.norm(true_action[space.size_axes] / np.where(unit > 0, unit, 1.0))
    shell[:, space.size_axes] = normal * unit * length / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    return np.concatenate([box, shell])


def rank_actions(
    model: Predictor,
    moves: Sequence[Transition],
    space: ActionSpace,
    probes: ProbeOptions,
    *,
    seed: int,
    progress: Progress = no_progress,
) -> ActionRanking:
    """Measure the action-ranking error: rank the true action of each move among alternative actions.

    Args:
        model: The predictor.
        moves: One or more moves (`select_moves`).
        space: Meaning of the actions.
        probes: The options `samples`, `reach_cm` (see `draw_alternatives`) and `at_once`.
        seed: Seed of the alternatives. Those of a pose do not depend on the other moves.
        progress: Called with the number of finished moves.
    """
    ids = tuple(move.episode_id for move in moves)
    largest = np.abs([move.true_action for move in moves]).max(axis=0)

    def rank_move(move: Transition) -> tuple[float, ...]:
        alternatives = draw_alternatives(move.true_action, largest, space, probes, move.make_generator(seed))
        actions = np.concatenate([move.true_action[None], alternatives])
        energies, changes = evaluate_actions(model, move, actions, at_once=probes.at_once)
        true_energy, energies = energies[0], energies[1:].reshape(2, -1)
        is_equal = np.abs(energies - true_energy) <= SAME_ENERGY * max(abs(true_energy), 1e-12)
        # If the prediction for the true action is not finite, all alternatives count as closer.
        is_closer = energies < true_energy if np.isfinite(true_energy) else np.ones_like(energies)
        box, shell = np.where(is_equal, 0.5, is_closer).mean(axis=1)
        return box, shell, changes[1 : 1 + probes.samples].mean(), energies[0].std(), move.persistence

    in_box, on_shell, change, spread, persistence = np.array(map_shared(moves, rank_move, progress)).T
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
    transitions: Sequence[Transition],
    space: ActionSpace,
    probes: ProbeOptions,
    progress: Progress = no_progress,
) -> Landscapes:
    """Compute the energy over a grid of the action's first three components; the other components are the true ones.

    Args:
        model: The predictor.
        transitions: One transition of each clip, at least one, whose actions have at least three components.
        space: Meaning of the actions; positions are reported in cm.
        probes: The options `nodes` (three or more along each axis), `at_once` and `reach_cm`. For poses the grid spans
            at least `reach_cm` in both directions.
        progress: Called with the number of finished transitions.
    """
    true_actions = np.stack([transition.true_action[_AXES] for transition in transitions])
    reach = 0.0 if space.position is None else probes.reach_cm / 100
    half_width = max(reach, _MARGIN * float(np.abs(true_actions).max())) or 1.0  # 1: all true actions are zero

    def compute_landscape(transition: Transition) -> Landscape:
        axes = make_grid_axes(transition.true_action[_AXES], half_width, probes.nodes)
        return _compute_landscape(model, transition, axes, space.display_factor, probes.at_once)

    maps = map_shared(transitions, compute_landscape, progress)
    chance = np.mean([np.linalg.norm(_list_nodes(each.axes) - each.true, axis=1).mean() for each in maps])
    return Landscapes(
        axis_names=space.names[_AXES],
        unit=space.display_unit,
        maps=tuple(maps),
        chance_distance=float(chance),
    )


def make_grid_axes(true: Float[np.ndarray, " 3"], half_width: float, nodes: int) -> Float[np.ndarray, "3 nodes"]:
    """Return equally spaced values along each axis, approximately within ±half_width, that include the true value."""
    distance = 2 * half_width / (nodes - 1)
    true_node = np.clip(np.round((true + half_width) / distance), 0, nodes - 1)
    return true[:, None] + distance * (np.arange(nodes)[None] - true_node[:, None])


def find_minimum(energy: Float[np.ndarray, ...]) -> Bool[np.ndarray, ...]:
    """Return a mask of the nodes with the lowest energy, up to rounding; all nodes if the energy is flat."""
    lowest = energy.min()
    return np.asarray(energy <= lowest + SAME_ENERGY * abs(lowest))


def _compute_landscape(
    model: Predictor, transition: Transition, axes: Float[np.ndarray, "3 nodes"], display_factor: float, at_once: int
) -> Landscape:
    nodes = axes.shape[1]
    actions = np.tile(transition.true_action, (nodes**3, 1))
    actions[:, _AXES] = _list_nodes(axes)
    energy = evaluate_actions(model, transition, actions, at_once=at_once)[0].reshape(nodes, nodes, nodes)
    minimum = actions[find_minimum(energy).ravel(), _AXES].mean(axis=0)
    return Landscape(
        episode_id=transition.episode_id,
        start=transition.first_step,
        axes=axes * display_factor,
        energy=energy,
        true=transition.true_action[_AXES] * display_factor,
        minimum=minimum * display_factor,
    )


def _list_nodes(axes: Float[np.ndarray, "3 nodes"]) -> Float[np.ndarray, "all_nodes 3"]:
    """Return the coordinates of all nodes in the order of a flattened energy: the third axis varies fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
