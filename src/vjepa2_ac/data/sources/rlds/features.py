"""An episode's identity, steps and states, from the record features named in `data.fields`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import RldsData, RldsFields
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.episode import STATE_DIM, Episode, EpisodeInfo, FrameReader
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import POSE, require_finite, zero_steps

IDENTITY_SEPARATOR = "--"  # as in the published lists of DROID's idle ranges
STEP_FLAG = "steps/is_first"


def identity_of(record: ExampleRecord, fields: RldsFields) -> str:
    """Return the identity of an episode, which does not depend on the order of records.

    Raises:
        InputError: A feature of the identity is missing, or neither text nor integers.
    """
    parts: list[str] = []
    for name in fields.identity:
        values = record.values(name, "bytes_list", "int64_list")
        parts += [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]
    return IDENTITY_SEPARATOR.join(parts)


def info_of(identity: str, num_steps: int) -> EpisodeInfo:
    """Return the facts about an episode; its success is known for DROID only, from the path."""
    success = True if "/success/" in identity else False if "/failure/" in identity else None
    return EpisodeInfo(id=identity, num_steps=num_steps, success=success)


def step_features(config: RldsData) -> tuple[str, ...]:
    """Return the features of states and recorded actions."""
    return config.fields.state + (config.fields.action if config.actions == "recorded" else ())


def num_steps_of(record: ExampleRecord, config: RldsData) -> int:
    """Count the steps by their first flag; without it by the states, if these are poses.

    Raises:
        InputError: There is neither.
    """
    if config.states == "vector":  # of any width: only the flag gives the count
        record.require([STEP_FLAG])
    if STEP_FLAG in record.located:
        return record.count_integers(STEP_FLAG)
    return sum(len(record.floats(name)) for name in config.fields.state) // STATE_DIM


def episode_of(
    record: ExampleRecord, config: RldsData, info: EpisodeInfo, read_frames: FrameReader, where: str
) -> Episode:
    """Return the episode in a record; without joint velocities and instruction if the record has none.

    Args:
        record: The record.
        config: Names of the features, and what a state is.
        info: The episode as the index describes it.
        read_frames: Reads the images of its camera.
        where: File, record and identity, for messages.

    Raises:
        InputError: The record does not match the index, lacks a feature, or has implausible numbers.
    """
    found = info_of(identity_of(record, config.fields), num_steps_of(record, config))
    if found != info:
        text = f"the episode {found.id} of {found.num_steps} steps"
        needed = f"{info.num_steps} steps of {info.id}, says the index"
        raise InputError(where=where, found=text, needed=needed, fix="Start again")
    steps, velocity, language = info.num_steps, config.fields.joint_velocity, config.fields.language
    return Episode(
        info=info,
        states=states_of(record, config, steps, where),
        read_frames=read_frames,
        control_rate_hz=config.fields.control_rate_hz,
        joint_velocities=_of_every_step(record, velocity, steps, where) if velocity in record.located else None,
        metadata={"language": record.first_text(language)} if language in record.located else {},
        commands=commands_of(record, config, steps, where),
    )


def check_record(
    record: ExampleRecord, config: RldsData, cameras: Sequence[str], where: str
) -> tuple[int, Float[np.ndarray, "steps state_dim"]]:
    """Return number of steps and states of a record that has everything an episode needs.

    Args:
        record: The record.
        config: Names of the features, and what a state is.
        cameras: Image features that it must have.
        where: File, record and identity, for messages.

    Raises:
        InputError: A feature is missing, has no uniform shape over all steps, or has implausible numbers.
    """
    record.require([*config.fields.identity, *step_features(config), *cameras])
    steps = num_steps_of(record, config)
    states = states_of(record, config, steps, where)
    commands_of(record, config, steps, where)
    return steps, states


def states_of(record: ExampleRecord, config: RldsData, steps: int, where: str) -> Float[np.ndarray, "steps state_dim"]:
    """Return the measured states (legend: `vjepa2_ac.episode`), checked for plausibility.

    Raises:
        InputError: A feature is missing, has no uniform shape over all steps, or has implausible states.
    """
    if steps == 0:
        raise zero_steps(where)
    fields = config.fields
    columns = [_of_every_step(record, name, steps, where) for name in fields.state]
    states = np.concatenate(columns, axis=1)
    if config.states == "vector":
        require_finite(states, where, fix="Check data.fields.state, or leave the episode out")
        return states
    if states.shape[1] != STATE_DIM:
        found = " + ".join(f"{name} [{column.shape[1]}]" for name, column in zip(fields.state, columns, strict=True))
        needed = f"{STATE_DIM} numbers a step: xyz, Euler, gripper"
        raise InputError(where=f"{where}: data.fields.state", found=found, needed=needed)
    POSE.require_plausible(states, where, fix="Check data.fields.state")
    if fields.gripper == "openness":
        states[:, POSE.gripper] = 1.0 - states[:, POSE.gripper]
    return states


def commands_of(
    record: ExampleRecord, config: RldsData, steps: int, where: str
) -> Float[np.ndarray, "steps action_dim"] | None:
    """Return the recorded actions, if `data.actions` requests them.

    Raises:
        InputError: A feature is missing, has no uniform shape over all steps, or has numbers that are not finite.
    """
    if config.actions != "recorded":
        return None
    commands = np.concatenate([_of_every_step(record, name, steps, where) for name in config.fields.action], axis=1)
    require_finite(commands, f"{where}: {', '.join(config.fields.action)}", fix="Check data.fields.action")
    return commands


def _of_every_step(record: ExampleRecord, name: str, steps: int, where: str) -> Float[np.ndarray, "steps width"]:
    values = record.floats(name).astype(np.float64)
    if len(values) == 0 or len(values) % steps:
        found, needed = f"{len(values)} numbers", f"as many for each of {steps} steps"
        raise InputError(where=f"{where}: {name}", found=found, needed=needed)
    return values.reshape(steps, -1)
