"""The spaces of a data set's states and actions, as its config says."""

from __future__ import annotations

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import Widths
from vjepa2_ac.spaces import CAMERA_POSE, POSE, POSE_CHANGE, Spaces, StateSpace, vector_states


def measured_space(config: DataConfig, width: int) -> StateSpace:
    """Return the space of the states that a source reads: of poses in the base frame, or of vectors so wide."""
    return POSE if config.states == "pose" else vector_states(width)


def spaces_of(config: DataConfig, widths: Widths) -> Spaces:
    """Return the spaces of the states and actions of clips."""
    if config.states == "pose":
        return Spaces(POSE if config.pose_frame == "base" else CAMERA_POSE, POSE_CHANGE)
    return Spaces.of_vectors(widths, "difference" if config.actions == "difference" else config.join_actions)
