"""State integration: states after a sequence of changes, batched, on any device, and differentiable.

Of poses the same as `spaces.apply_action` (NumPy, SciPy), except that the gripper is limited to between open and
closed. Vectors add.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.spaces import POSE, StateSpace

_LOCKED = 1e-6  # cos(pitch) below which only roll - yaw or roll + yaw is determined


def apply_actions(
    states: Float[Tensor, "*batch dim"], actions: Float[Tensor, "*batch dim"], space: StateSpace = POSE
) -> Float[Tensor, "*batch dim"]:
    """Return the states after changes: numbers add, rotations R' = R_delta @ R, a gripper is clipped to 0 .. 1.

    Autocast is disabled here: bfloat16 has too few digits for rotations.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, compute_new_pose.
    """
    after = list((states + actions).unbind(dim=-1))
    if space.rotation is not None:
        with torch.autocast(states.device.type, enabled=False):
            turn, now = (matrices_from_euler(one[..., space.rotation]) for one in (actions, states))
            rotation = turn @ now
        after[space.rotation] = euler_from_matrices(rotation).unbind(dim=-1)
    if space.gripper is not None:
        after[space.gripper] = after[space.gripper].clamp(0.0, 1.0)
    return torch.stack(after, dim=-1)


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


def matrices_from_euler(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return rotation matrices of extrinsic xyz Euler angles in radians: R = Rz(yaw) @ Ry(pitch) @ Rx(roll)."""
    (sr, sp, sy), (cr, cp, cy) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    rows = [
        torch.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], dim=-1),
        torch.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], dim=-1),
        torch.stack([-sp, cp * sr, cp * cr], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def euler_from_matrices(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return extrinsic xyz Euler angles in radians; where the pitch is pi/2 or -pi/2, the yaw is zero.

    Gradients are finite everywhere.
    """
    flat = torch.hypot(matrices[..., 0, 0], matrices[..., 1, 0])  # cos(pitch), which is never negative
    locked = flat < _LOCKED
    cosine = torch.hypot(*(torch.where(locked, 1.0, matrices[..., row, 0]) for row in (0, 1)))
    pitch = torch.atan2(-matrices[..., 2, 0], torch.where(locked, 0.0, cosine))
    roll = torch.atan2(
        torch.where(locked, -matrices[..., 1, 2], matrices[..., 2, 1]),
        torch.where(locked, matrices[..., 1, 1], matrices[..., 2, 2]),
    )
    yaw = torch.atan2(torch.where(locked, 0.0, matrices[..., 1, 0]), torch.where(locked, 1.0, matrices[..., 0, 0]))
    return torch.stack([roll, pitch, yaw], dim=-1)
