"""The action of a model step: a difference of states, or the recorded commands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.configured_spaces import measured_space
from vjepa2_ac.episode import Episode, Widths
from vjepa2_ac.errors import InputError


def actions_of(
    states: Float[np.ndarray, "time state_dim"],
    commands: Float[np.ndarray, "steps action_dim"] | None,
    steps: Sequence[int],
    config: DataConfig,
) -> Float[np.ndarray, "time-1 action_dim"]:
    """Return the actions between consecutive model steps of a clip.

    Args:
        states: At these steps, in the config's coordinate frame.
        commands: The recorded ones of all control steps of the episode; used for `data.actions: recorded` only.
        steps: Control steps of the clip, equally spaced.
        config: The definition of an action.

    Raises:
        ValueError: Commands are required and there are none.
    """
    if config.actions == "difference":
        return measured_space(config, states.shape[1]).differences(states)
    if commands is None:
        raise ValueError("no commands: a source gives them where data.actions is recorded")
    return joined(commands[steps[0] : steps[-1]], config.model_stride, config.join_actions)


def joined(
    commands: Float[np.ndarray, "steps action_dim"], stride: int, how: str | None
) -> Float[np.ndarray, "model_steps action_dim"]:
    """Return one action for each `stride` commands: their sum, their mean, or the last of them.

    The command of a control step is sent after that step is measured: the model step from control step t to t + stride
    has the commands of t .. t + stride - 1.
    """
    groups = commands.reshape(-1, stride, commands.shape[1])
    if how == "sum":
        return np.asarray(groups.sum(axis=1))
    if how == "mean":
        return np.asarray(groups.mean(axis=1))
    return groups[:, -1]  # the only one at stride 1


def widths_of(episode: Episode) -> Widths:
    """Return the widths of an episode's states and actions."""
    state = int(episode.states.shape[1])
    return Widths(state, state if episode.commands is None else int(episode.commands.shape[1]))


def require_widths(episode: Episode, widths: Widths) -> None:
    """Refuse an episode whose widths differ from those of the others.

    Raises:
        InputError: Names both.
    """
    found = widths_of(episode)
    if found != widths:
        raise InputError(
            where=f"episode {episode.info.id}",
            found=f"states of {found.state} and actions of {found.action} numbers",
            needed=f"{widths.state} and {widths.action}, as in the others",
            fix="Keep the recordings of different robots in different data sets",
        )
