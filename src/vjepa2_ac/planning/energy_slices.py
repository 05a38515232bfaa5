"""Energy slices: energies around the first action of a plan, over two axes at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.planning.interfaces import Cost
from vjepa2_ac.planning.search_space import SearchSpace

_BEYOND = 1.25  # how far a slice reaches beyond the limits
_LEAST = 0.05  # metres: half the width of a slice along an axis that is held


@dataclass(frozen=True)
class EnergySlice:
    """Energies over two numbers of the first action, all other components of the plan unchanged."""

    axes: tuple[int, int]  # which they are
    across: Float[np.ndarray, " nodes"]  # values along the first of them
    up: Float[np.ndarray, " nodes"]
    energy: Float[np.ndarray, "nodes nodes"]  # [up, across]; NaN where the model gives none


def energy_slices(
    cost: Cost, actions: Float[Tensor, "steps dim"], space: SearchSpace, axes: Sequence[int] = (0, 1, 2), *, nodes: int
) -> tuple[EnergySlice, ...]:
    """Return the energy around a plan's first action: over each pair of some numbers of it, such as dx and dy.

    Limits are ignored, to show what is beyond them. A first action that is repeated changes as one.

    Raises:
        ValueError: Fewer than three nodes.
    """
    if nodes < 3:
        raise ValueError(f"{nodes} nodes")
    return tuple(_slice(cost, actions, space, pair, nodes) for pair in combinations(axes, 2))


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
