"""Energy landscapes: the energy over a grid of (dx, dy, dz), and its minimum.

Source: facebookresearch/vjepa2 @ c2963a4, notebooks/energy_landscape_example.ipynb: the energy of a grid of actions
after one step from one frame. There the grid is centred on zero; here it also has a node at the true action.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, evaluate_actions
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.result import Landscape, Landscapes
from vjepa2_ac.intervals import Estimate, mean_of
from vjepa2_ac.spaces import ActionSpace

_ROOM = 1.25  # extent of the grid relative to the largest true action
_SAME = 1e-6  # energies this close, as a share, are equally low
_AXES = slice(0, 3)  # of the grid: of poses, the position


@dataclass(frozen=True)
class LandscapeGrid:
    """A grid of actions over their first three numbers."""

    space: ActionSpace  # of the actions; positions are reported in cm
    nodes: int  # along each axis
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
        starts: One frame of each clip; one or more.
        grid: The actions.
        at_once: Samples per batch.
        progress: Called with the number of finished starts.

    Raises:
        ValueError: No starts, fewer than three nodes, or actions of fewer than three numbers.
    """
    nodes, unit = grid.nodes, grid.space.shown_factor
    if not starts or nodes < 3 or len(starts[0].action) < 3:
        raise ValueError(f"{len(starts)} starts, {nodes} nodes")
    trues = np.stack([start.action[_AXES].cpu().numpy().astype(np.float64) for start in starts])
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
    evaluated = np.tile(start.action.cpu().numpy().astype(np.float64), (nodes**3, 1))
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
