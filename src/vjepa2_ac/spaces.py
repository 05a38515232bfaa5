"""State and action spaces: the meaning of the numbers of a robot, their plausible ranges, and how states change.

A pose has a position, a rotation and a gripper (conventions: `vjepa2_ac.episode`). For a vector, such as the
joints of a robot, two arms or a mobile base, only the width is known. `space.position` is None for a space without a
position.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

MAX_POSITION_M = 5.0  # larger positions are not in metres
MAX_ANGLE_RAD = 2 * math.pi + 0.1  # larger angles are not in radians
_GIMBAL_LOCK = 1e-6  # cos(pitch) below which only roll - yaw or roll + yaw is determined
GRIPPER_SLACK = 0.1  # a measured gripper position may exceed 0 .. 1 by this
CONVERSIONS = {  # conversions from other units to metres and radians
    "millimetres": "divide them by 1000",
    "centimetres": "divide them by 100",
    "degrees": "multiply them by pi / 180",
}
_MAX_CM, _MAX_MM, _MAX_DEGREES = 100.0, 5000.0, 360.5  # largest values that are recognised as these units

ActionEffect = Literal["change", "target", "unknown"]


# ---- poses, as NumPy arrays or tensors; rotations are subtracted as matrices, because Euler angles wrap at pi ----


def matrices_from_euler(angles: Any) -> Any:
    """Return rotation matrices [*batch 3 3] of extrinsic xyz Euler angles [*batch 3] in radians.

    R = Rz(yaw) @ Ry(pitch) @ Rx(roll). Arrays are converted by SciPy, as in the official code.
    """
    if isinstance(angles, np.ndarray):
        return Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_matrix().reshape(*angles.shape[:-1], 3, 3)
    torch = sys.modules["torch"]
    (sr, sp, sy), (cr, cp, cy) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    rows = [
        torch.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], -1),
        torch.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], -1),
        torch.stack([-sp, cp * sr, cp * cr], -1),
    ]
    return torch.stack(rows, -2)


def euler_from_matrices(matrices: Any) -> Any:
    """Return extrinsic xyz Euler angles [*batch 3] in radians of rotation matrices [*batch 3 3].

    Roll and yaw are in (-pi, pi], pitch in [-pi/2, pi/2]. Arrays are converted by SciPy, as in the official code. For
    tensors gradients are finite everywhere, and the yaw is zero where the pitch is pi/2 or -pi/2.
    """
    if isinstance(matrices, np.ndarray):
        return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_euler("xyz").reshape(*matrices.shape[:-2], 3)
    torch = sys.modules["torch"]
    is_locked = torch.hypot(matrices[..., 0, 0], matrices[..., 1, 0]) < _GIMBAL_LOCK  # cos(pitch) is never negative
    cosine = torch.hypot(*(torch.where(is_locked, 1.0, matrices[..., row, 0]) for row in (0, 1)))
    pitch = torch.atan2(-matrices[..., 2, 0], torch.where(is_locked, 0.0, cosine))
    roll = torch.atan2(
        torch.where(is_locked, -matrices[..., 1, 2], matrices[..., 2, 1]),
        torch.where(is_locked, matrices[..., 1, 1], matrices[..., 2, 2]),
    )
    yaw = torch.atan2(
        torch.where(is_locked, 0.0, matrices[..., 1, 0]), torch.where(is_locked, 1.0, matrices[..., 0, 0])
    )
    return torch.stack([roll, pitch, yaw], -1)


def actions_from_states(states: Float[np.ndarray, "time 7"]) -> Float[np.ndarray, "time-1 7"]:
    """Return the action from each state to the next.

    Positions and grippers are subtracted. The rotation is R[t+1] @ R[t].T as extrinsic xyz Euler angles, so an action
    is multiplied from the left. Conventions of states and actions: `vjepa2_ac.episode`.

    Raises:
        ValueError: Fewer than two states.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/droid.py, poses_to_diffs.
    """
    return POSE.compute_differences(states)


def rotation_differences(angles: Float[np.ndarray, "time 3"]) -> Float[np.ndarray, "time-1 3"]:
    """Return R[t+1] @ R[t].T as extrinsic xyz Euler angles."""
    rotations = matrices_from_euler(angles)
    return np.asarray(euler_from_matrices(rotations[1:] @ rotations[:-1].swapaxes(-1, -2)))


def rotation_angles(rotations: Float[np.ndarray, "count 3"]) -> Float[np.ndarray, " count"]:
    """Return the angles, in radians, of rotations given by extrinsic xyz Euler angles."""
    return np.asarray(Rotation.from_euler("xyz", rotations).magnitude())


def compute_step_sizes(states: Float[np.ndarray, "time 7"]) -> Float[np.ndarray, "time-1 2"]:
    """Return the distance, in metres, and the angle of the rotation, in radians, from each pose to the next."""
    rotations = Rotation.from_euler("xyz", states[:, 3:6])
    moved, turned = np.diff(states[:, :3], axis=0), (rotations[1:] * rotations[:-1].inv()).magnitude()
    return np.column_stack([np.linalg.norm(moved, axis=1), turned])


def apply_action(state: Any, action: Any) -> Any:
    """Return the poses [*batch 7] after actions [*batch 7]: xyz and gripper are added, and R' = R_delta @ R.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, compute_new_pose.
    """
    rotation = matrices_from_euler(action[..., 3:6]) @ matrices_from_euler(state[..., 3:6])
    parts = [state[..., :3] + action[..., :3], euler_from_matrices(rotation), state[..., 6:] + action[..., 6:]]
    return np.concatenate(parts, -1) if isinstance(state, np.ndarray) else sys.modules["torch"].cat(parts, -1)


def states_in_camera_frame(
    states: Float[np.ndarray, "time 7"], extrinsics: Float[np.ndarray, "time 6"]
) -> Float[np.ndarray, "time 7"]:
    """Return states whose pose is given in the camera's frame: inverse(camera pose) @ pose. The gripper is unchanged.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/droid.py, transform_frame.
    """
    camera = matrices_from_euler(extrinsics[:, 3:6]).swapaxes(-1, -2)
    position = (camera @ (states[:, :3] - extrinsics[:, :3])[..., None])[..., 0]
    rotation = euler_from_matrices(camera @ matrices_from_euler(states[:, 3:6]))
    return np.concatenate([position, rotation, states[:, 6:]], axis=-1)


# ---- spaces ----


@dataclass(frozen=True)
class Space:
    """The numbers of a state or an action, and which of them are position, rotation and gripper."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    position: slice | None = None  # metres
    rotation: slice | None = None  # extrinsic xyz Euler angles
    gripper: int | None = None  # gripper position, 0 open .. 1 closed

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_pose(self) -> bool:
        """Whether position, rotation and gripper have the indices of a pose."""
        return (self.position, self.rotation, self.gripper) == (slice(0, 3), slice(3, 6), 6)

    @property
    def size_axes(self) -> slice:
        """Indices of the components whose norm is the size of a motion: the position, or all components."""
        return slice(None) if self.position is None else self.position

    @property
    def display_unit(self) -> str:
        """Unit in which sizes of motions are displayed: cm for a position, else empty."""
        return "" if self.position is None else "cm"

    @property
    def display_factor(self) -> float:
        """Factor from metres to the displayed unit."""
        return 1.0 if self.position is None else 100.0

    def compute_display_size(self, numbers: Float[np.ndarray, "*batch dim"]) -> Float[np.ndarray, "*batch"]:
        """Return the sizes of motions in the displayed unit."""
        return np.asarray(np.linalg.norm(numbers[..., self.size_axes], axis=-1) * self.display_factor)


@dataclass(frozen=True)
class StateSpace(Space):
    """The numbers of a state."""

    frame: Literal["base", "camera"] = "base"  # of poses

    @property
    def is_base_pose(self) -> bool:
        """Whether states are poses in the robot base frame, in which directions have names."""
        return self.is_pose and self.frame == "base"

    def compute_path_length(self, states: Float[np.ndarray, "time dim"]) -> float:
        """Return the sum of the sizes of all motions between consecutive states: in metres for poses."""
        return float(np.linalg.norm(np.diff(states[:, self.size_axes], axis=0), axis=1).sum())

    @property
    def change_names(self) -> tuple[str, ...]:
        """Names of the changes: dx, dy, ... for a pose, the names of the components for a vector."""
        return self.names if self.position is None else tuple(f"d{name}" for name in self.names)

    def compute_differences(self, states: Float[np.ndarray, "time dim"]) -> Float[np.ndarray, "time-1 dim"]:
        """Return the change from each state to the next: R[t+1] @ R[t].T for rotations, else the difference.

        Raises:
            ValueError: Fewer than two states.
        """
        if len(states) < 2:
            raise ValueError(f"expected at least two states, got {len(states)}")
        changes = np.diff(states, axis=0)
        if self.rotation is not None:
            changes[:, self.rotation] = rotation_differences(states[:, self.rotation])
        return changes

    def require_plausible(
        self,
        states: Float[np.ndarray, "steps dim"],
        where: str,
        *,
        fix: str = "",
        conversions: Mapping[str, str] = CONVERSIONS,
    ) -> None:
        """Refuse implausible states: numbers that are not finite, or that seem to have other units.

        Args:
            states: One for each control step.
            where: File and episode, for messages.
            fix: The settings to check, for messages.
            conversions: Name of a unit that the numbers may have, and how to convert from it.

        Raises:
            InputError: There are no states, or a state is implausible. The message has its step, its numbers, and the
                units that the states seem to have.
        """
        if len(states) == 0:
            raise no_steps_error(where)
        for is_wrong, needed in self._check_rules(states):
            if is_wrong.any():
                step = int(is_wrong.argmax())
                position = f"{where}: step {step}" if len(states) > 1 else where
                problem = f"the numbers {np.array2string(states[step], precision=4, max_line_width=200)}"
                guesses = [
                    f"The {part} look like {unit}: {conversions[unit]}"
                    for part, unit in self._guess_units(states)
                    if unit in conversions
                ]
                raise InputError(
                    where=position, found=problem, needed=needed, fix=". ".join(filter(None, [*guesses, fix]))
                )

    def require_state(self, numbers: np.ndarray, where: str) -> None:
        """Refuse an array that is not a state, or an implausible state.

        Raises:
            InputError: The array is not a plausible state.
        """
        if numbers.shape != (len(self),):
            names = (f"{name} ({unit})" if unit else name for name, unit in zip(self.names, self.units, strict=True))
            problem = f"{numbers.size} numbers with shape {numbers.shape}"
            raise InputError(where=where, found=problem, needed=f"{len(self)}: {', '.join(names)}")
        self.require_plausible(numbers[None], where)

    def _check_rules(self, states: Float[np.ndarray, "steps dim"]) -> list[tuple[np.ndarray, str]]:
        """Return, for each rule, a mask of the steps that violate the rule, and the expected values."""
        checks = [(~np.isfinite(states).all(axis=1), "finite numbers")]
        if self.position is not None:
            is_far = abs(states[:, self.position]).max(axis=1) > MAX_POSITION_M
            checks.append((is_far, f"a position within {MAX_POSITION_M:g} m of the base, in metres"))
        if self.rotation is not None:
            checks.append((abs(states[:, self.rotation]).max(axis=1) > MAX_ANGLE_RAD, "angles in radians"))
        if self.gripper is not None:
            gripper_position = states[:, self.gripper]
            is_beyond = (gripper_position < -GRIPPER_SLACK) | (gripper_position > 1 + GRIPPER_SLACK)
            checks.append((is_beyond, "a gripper between 0 and 1: 0 for open, 1 for closed"))
        return checks

    def _guess_units(self, states: Float[np.ndarray, "steps dim"]) -> list[tuple[str, str]]:
        """Return the parts of a pose that look like another unit than metres and radians, each with that unit.

        Most steps must be too large, because a few wrong steps are outliers that do not show the unit.
        """
        units = []
        if self.position is not None:
            usual = float(np.median(abs(states[:, self.position]).max(axis=1)))
            if MAX_POSITION_M < usual <= _MAX_MM:
                units.append(("positions", "centimetres" if usual < _MAX_CM else "millimetres"))
        if self.rotation is not None:
            angles = abs(states[:, self.rotation]).max(axis=1)
            if np.median(angles) > MAX_ANGLE_RAD and angles.max() <= _MAX_DEGREES:
                units.append(("angles", "degrees"))
        return units


@dataclass(frozen=True)
class ActionSpace(Space):
    """The numbers of an action, and its effect on the state."""

    effect: ActionEffect = "change"  # change: the action is added to the state; target: it is the next state


def no_steps_error(where: str) -> InputError:
    """Return the error of an episode without steps."""
    return InputError(where=where, found="no steps", needed="one or more")


_AXES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
_UNITS = ("m", "m", "m", "rad", "rad", "rad", "")
POSE = StateSpace(_AXES, _UNITS, slice(0, 3), slice(3, 6), 6)
CAMERA_POSE = StateSpace(_AXES, _UNITS, slice(0, 3), slice(3, 6), 6, "camera")
EXTRINSICS = StateSpace(_AXES[:6], _UNITS[:6], slice(0, 3), slice(3, 6))
POSE_CHANGE = ActionSpace(tuple(f"d{axis}" for axis in _AXES), _UNITS, slice(0, 3), slice(3, 6), 6)


def make_vector_states(width: int) -> StateSpace:
    """Return the space of states whose numbers have no known meaning."""
    return StateSpace(tuple(f"state {number}" for number in range(width)), ("",) * width)


def require_finite(numbers: Float[np.ndarray, "steps dim"], where: str, *, fix: str) -> None:
    """Refuse numbers of unknown meaning that are not finite, and an episode without steps.

    Raises:
        InputError: As `StateSpace.require_plausible`.
    """
    make_vector_states(numbers.shape[1]).require_plausible(numbers, where, fix=fix)


def make_vector_actions(width: int, effect: ActionEffect) -> ActionSpace:
    """Return the space of actions whose numbers have no known meaning."""
    return ActionSpace(tuple(f"action {number}" for number in range(width)), ("",) * width, effect=effect)


@dataclass(frozen=True)
class Spaces:
    """The spaces of a robot's states and actions."""

    state: StateSpace
    action: ActionSpace

    @property
    def widths(self) -> Widths:
        """Widths of state and action."""
        return Widths(len(self.state), len(self.action))

    @classmethod
    def from_widths(cls, widths: Widths, joined: str | None) -> Spaces:
        """Return the spaces of vectors.

        Args:
            widths: Widths of state and action.
            joined: "difference" for differences of states; else how recorded actions were joined (`data.join_actions`):
                "sum" of changes, or the "last" target state.
        """
        effects: dict[str | None, ActionEffect] = {"difference": "change", "sum": "change", "last": "target"}
        effect: ActionEffect = effects.get(joined, "unknown") if widths.state == widths.action else "unknown"
        return cls(make_vector_states(widths.state), make_vector_actions(widths.action, effect))


POSES = Spaces(POSE, POSE_CHANGE)


# ---- states after a sequence of changes ----


def apply_actions(
    states: Float[Tensor, "*batch dim"], actions: Float[Tensor, "*batch dim"], space: StateSpace = POSE
) -> Float[Tensor, "*batch dim"]:
    """Return the states after changes, on any device and differentiable: a gripper is clipped to 0 .. 1.

    For poses this is `apply_action` with a clipped gripper; for vectors it is addition. Autocast is disabled because
    bfloat16 is too imprecise for rotations.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, compute_new_pose.
    """
    torch = sys.modules["torch"]
    with torch.autocast(states.device.type, enabled=False):
        after = states + actions if space.rotation is None else apply_action(states, actions)
    if space.gripper is None:
        return after
    gripper_position = after[..., space.gripper :].clamp(0.0, 1.0)  # the last number
    return torch.cat([after[..., : space.gripper], gripper_position], dim=-1)  # type: ignore[no-any-return]  # untyped


def integrate_changes(
    state: Float[Tensor, " dim"], changes: Float[Tensor, "samples steps dim"], space: StateSpace = POSE
) -> Float[Tensor, "samples steps+1 dim"]:
    """Return the states before and after every change, starting from one state."""
    states = [state.expand(len(changes), -1)]
    for step in range(changes.shape[1]):
        states.append(apply_actions(states[-1], changes[:, step], space))
    return sys.modules["torch"].stack(states, dim=1)  # type: ignore[no-any-return]  # untyped


def integrate_states(
    state: Float[np.ndarray, " state_dim"], actions: Float[np.ndarray, "steps state_dim"], space: StateSpace = POSE
) -> Float[np.ndarray, "steps+1 state_dim"]:
    """Return the states before and after actions that were not executed, integrated from the first in double precision.

    Recorded states must not be used instead, because they would reveal the recorded motion to the model. The gripper is
    clipped to 0 .. 1. The lag of a real arm, which covers about 95 % of a commanded step, is not modelled.
    """
    import torch  # imported here because some commands that import `spaces` do not need it

    first, changes = (torch.from_numpy(np.array(values, dtype=np.float64)) for values in (state, actions))
    return integrate_changes(first, changes[None], space)[0].numpy()


def clip_gripper_changes(
    state: Float[np.ndarray, " state_dim"], actions: Float[np.ndarray, "steps state_dim"], space: StateSpace = POSE
) -> Float[np.ndarray, "steps state_dim"]:
    """Return actions whose gripper changes stay within the range 0 .. 1 of gripper position, as in `integrate_states`.

    A measured gripper position does not exceed its range, so the training data contain no changes beyond it.
    """
    feasible = np.array(actions, dtype=np.float64)
    if space.gripper is not None:
        feasible[:, space.gripper] = np.diff(integrate_states(state, actions, space)[:, space.gripper])
    return feasible
