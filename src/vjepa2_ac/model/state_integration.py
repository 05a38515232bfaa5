"""State integration: states after a sequence of changes, batched, on any device, and differentiable.

For poses the same as `spaces.apply_action`, except that the gripper is limited to between open and closed. Vectors add.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.spaces import POSE, StateSpace, apply_action


def apply_actions(
    states: Float[Tensor, "*batch dim"], actions: Float[Tensor, "*batch dim"], space: StateSpace = POSE
) -> Float[Tensor, "*batch dim"]:
    """Return the states after changes: numbers add, rotations R' = R_delta @ R, a gripper is clipped to 0 .. 1.

    Autocast is disabled here: bfloat16 has too few digits for rotations.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, compute_new_pose.
    """
    with torch.autocast(states.device.type, enabled=False):
        after: Tensor = states + actions if space.rotation is None else apply_action(states, actions)
    if space.gripper is None:
        return after
    closed = after[..., space.gripper :].clamp(0.0, 1.0)  # the last number
    return torch.cat([after[..., : space.gripper], closed], dim=-1)


def states_along(
    state: Float[Tensor, " dim"], changes: Float[Tensor, "samples steps dim"], space: StateSpace = POSE
) -> Float[Tensor, "samples steps+1 dim"]:
    """Return the states before and after every change, starting from one state."""
    states = [state.expand(len(changes), -1)]
    for step in range(changes.shape[1]):
        states.append(apply_actions(states[-1], changes[:, step], space))
    return torch.stack(states, dim=1)


def counterfactual_states(
    state: Float[np.ndarray, " state_dim"], actions: Float[np.ndarray, "steps state_dim"], space: StateSpace = POSE
) -> Float[np.ndarray, "steps+1 state_dim"]:
    """Return the states before and after actions that were not taken: integrated from the first, in double precision.

    Never take them from a recording: later states of what did happen would give the model the truth. The gripper stays
    within 0 .. 1. Of poses without the lag of a real arm, which covers some 95 % of a commanded step.
    """
    first, changes = (torch.from_numpy(np.array(one, dtype=np.float64)) for one in (state, actions))
    return states_along(first, changes[None], space)[0].numpy()


def feasible_actions(
    state: Float[np.ndarray, " state_dim"], actions: Float[np.ndarray, "steps state_dim"], space: StateSpace = POSE
) -> Float[np.ndarray, "steps state_dim"]:
    """Return actions whose gripper changes only as far as it can: those of `counterfactual_states`, as data would have.

    A measured closedness does not change any more at its end, so a model has never seen further changes there.
    """
    feasible = np.array(actions, dtype=np.float64)
    if space.gripper is not None:
        feasible[:, space.gripper] = np.diff(counterfactual_states(state, actions, space)[:, space.gripper])
    return feasible
