"""Energy slices: energies around the first action of a plan, over two axes at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.planning.action_space import ActionSpace
from vjepa2_ac.planning.interfaces import Cost

AXES = ("dx", "dy", "dz")
PAIRS = ((0, 1), (0, 2), (1, 2))

_BEYOND = 1.25  # how far a slice reaches beyond the limits
_LEAST_M = 0.05  # half the width of a slice along an axis that is held


@dataclass(frozen=True)
class EnergySlice:
    """Energies over two axes of the first action in metres, all other components of the plan unchanged."""

    axes: tuple[int, int]  # of dx, dy, dz
    across: Float[np.ndarray, " nodes"]  # values along the first of them
    up: Float[np.ndarray, " nodes"]
    energy: Float[np.ndarray, "nodes nodes"]  # [up, across]; NaN where the model gives none


def energy_slices(
    cost: Cost, actions: Float[Tensor, "steps 7"], space: ActionSpace, *, nodes: int
) -> tuple[EnergySlice, ...]:
    """Return the energy around a plan's first action: over dx and dy, dx and dz, dy and dz.

    Limits are ignored, to show what is beyond them. A first action that is repeated changes as one.

    Raises:
        ValueError: Fewer than three nodes.
    """
    if nodes < 3:
        raise ValueError(f"{nodes} nodes")
    return tuple(_slice(cost, actions, space, axes, nodes) for axes in PAIRS)


@torch.no_grad()
def _slice(cost: Cost, actions: Tensor, space: ActionSpace, axes: tuple[int, int], nodes: int) -> EnergySlice:
    across, up = (_BEYOND * _half_width(space, axis) * torch.linspace(-1, 1, nodes) for axis in axes)
    evaluated = actions.repeat(nodes * nodes, 1, 1)
    evaluated[:, : space.repeat, axes[0]] = across.repeat(nodes)[:, None]
    evaluated[:, : space.repeat, axes[1]] = up.repeat_interleave(nodes)[:, None]
    energy = cost(evaluated).float().cpu().reshape(nodes, nodes)
    return EnergySlice(axes, across.double().numpy(), up.double().numpy(), energy.double().numpy())


def _half_width(space: ActionSpace, axis: int) -> float:
    reach = float(torch.maximum(space.upper[0, axis].abs(), space.lower[0, axis].abs()))
    return reach or max(float(space.upper[0, : len(AXES)].max()), _LEAST_M)
