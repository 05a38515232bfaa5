"""Energy slices: energies around the first action of a plan, over two axes at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.planning.interfaces import Cost, reporting
from vjepa2_ac.planning.search_space import SearchSpace

_BEYOND = 1.25  # how far a slice reaches beyond the limits
_LEAST = 0.05  # metres: half the width of a slice along an axis that is held
FEWEST_NODES, _MOST_NODES = 5, 13  # of those that are chosen by what they cost


@dataclass(frozen=True)
class EnergySlice:
    """Energies over two numbers of the first action, all other components of the plan unchanged."""

    axes: tuple[int, int]  # which they are
    across: Float[np.ndarray, " nodes"]  # values along the first of them
    up: Float[np.ndarray, " nodes"]
    energy: Float[np.ndarray, "nodes nodes"]  # [up, across]; NaN where the model gives none


def sequences_of_slices(nodes: int, axes: int) -> int:
    """Return how many action sequences the slices over each pair of some axes evaluate."""
    return comb(axes, 2) * nodes**2


def fitting_nodes(sequences: int, axes: int) -> int:
    """Return the nodes along each axis of slices that evaluate no more than so many action sequences; 0: none do.

    They are odd, so that no motion is one of them, and 5 to 13.
    """
    choices = range(_MOST_NODES, FEWEST_NODES - 1, -2)
    return next((nodes for nodes in choices if sequences_of_slices(nodes, axes) <= sequences), 0)


def energy_slices(
    cost: Cost,
    actions: Float[Tensor, "steps dim"],
    space: SearchSpace,
    axes: Sequence[int] = (0, 1, 2),
    *,
    nodes: int,
    progress: Progress = no_progress,
) -> tuple[EnergySlice, ...]:
    """Return the energy around a plan's first action: over each pair of some numbers of it, such as dx and dy.

    Limits are ignored, to show what is beyond them. A first action that is repeated changes as one.

    Args:
        cost: The energy of action sequences.
        actions: The plan.
        space: Its limits say how far the slices reach.
        axes: The numbers.
        nodes: Along each axis.
        progress: Called with the number of evaluated action sequences.

    Raises:
        ValueError: Fewer than three nodes.
    """
    if nodes < 3:
        raise ValueError(f"{nodes} nodes")
    total, slices = sequences_of_slices(nodes, len(axes)), []
    progress(0, total)
    for number, pair in enumerate(combinations(axes, 2)):
        with reporting(cost, progress, done=number * nodes**2, share=nodes**2, total=total):
            slices.append(_slice(cost, actions, space, pair, nodes))
    return tuple(slices)


@torch.no_grad()
def _slice(cost: Cost, actions: Tensor, space: SearchSpace, axes: tuple[int, int], nodes: int) -> EnergySlice:
    across, up = (_BEYOND * _half_width(space, axis, axes) * torch.linspace(-1, 1, nodes) for axis in axes)
    evaluated = actions.repeat(nodes * nodes, 1, 1)
    evaluated[:, : space.repeat, axes[0]] = across.repeat(nodes)[:, None]
    evaluated[:, : space.repeat, axes[1]] = up.repeat_interleave(nodes)[:, None]
    energy = cost(evaluated).float().cpu().reshape(nodes, nodes)
    return EnergySlice(axes, across.double().numpy(), up.double().numpy(), energy.double().numpy())


def _half_width(space: SearchSpace, axis: int, axes: Sequence[int]) -> float:
    reach = float(torch.maximum(space.upper[0, axis].abs(), space.lower[0, axis].abs()))
    return reach or max(*(float(space.upper[0, one]) for one in axes), _LEAST)
