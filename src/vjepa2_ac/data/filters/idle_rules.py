"""Idle rules: ranges where the robot stands still, from commanded joint velocities or measured motion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.config import IdleConfig
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError
from vjepa2_ac.geometry import actions_from_states
from vjepa2_ac.spaces import POSE


def kept_ranges(episode: Episode, config: IdleConfig) -> list[tuple[int, int]]:
    """Return the ranges [start, end) of steps that an episode keeps under the rule `commands` or `motion`.

    Raises:
        InputError: The rule is `commands` and the episode has no joint velocities, or some that are not finite.
    """
    if config.rule == "motion":
        return moving_ranges(idle_by_motion(episode.states, config), config)
    velocities = episode.joint_velocities
    if velocities is None:
        raise InputError(
            where=f"episode {episode.info.id}",
            found="no commanded joint velocities",
            needed="them, for data.idle.rule commands",
            fix="Set data.idle.rule: motion, which needs only poses, or name the feature with the velocities",
        )
    if not np.isfinite(velocities).all():
        raise InputError(
            where=f"episode {episode.info.id}", found="a joint velocity that is not finite", needed="finite numbers"
        )
    return moving_ranges(idle_by_commands(velocities, config), config)


def idle_by_commands(velocities: Float[np.ndarray, "steps joints"], config: IdleConfig) -> Bool[np.ndarray, " steps"]:
    """Return the steps at which no commanded joint velocity differs from the step before; never the first.

    Source: Physical-Intelligence/openpi @ 15a9616, examples/droid/compute_droid_nonidle_ranges.py.
    """
    still = (abs(np.diff(velocities, axis=0)) < config.velocity_change_rad_s).all(axis=1)
    return np.concatenate([np.zeros(min(1, len(velocities)), bool), still])


def idle_by_motion(states: Float[np.ndarray, "steps 7"], config: IdleConfig) -> Bool[np.ndarray, " steps"]:
    """Return the steps at which the measured pose hardly differs from the step before; never the first."""
    if len(states) < 2:
        return np.zeros(len(states), bool)
    motion = actions_from_states(states.astype(np.float64))
    still = (
        (np.linalg.norm(motion[:, POSE.position], axis=1) < config.translation_m)
        & (Rotation.from_euler("xyz", motion[:, POSE.rotation]).magnitude() < config.rotation_rad)
        & (abs(motion[:, POSE.gripper]) < config.gripper)
    )
    return np.concatenate([[False], still])


def moving_ranges(idle: Bool[np.ndarray, " steps"], config: IdleConfig) -> list[tuple[int, int]]:
    """Return the ranges that remain without long idle runs, short ranges between them, and the last steps of each.

    Source: Physical-Intelligence/openpi @ 15a9616, examples/droid/compute_droid_nonidle_ranges.py.
    """
    moving = np.ones(len(idle), bool)
    for start, end in _runs(idle):
        moving[start:end] = end - start < config.shortest_idle_steps
    ranges = [(start, end) for start, end in _runs(moving) if end - start >= config.shortest_kept_steps]
    cut = config.cut_last_steps
    return [(start, end - cut) for start, end in ranges if end - cut > start]


def _runs(mask: Bool[np.ndarray, " steps"]) -> list[tuple[int, int]]:
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))
