"""An episode's identity, steps and states, from the record features named in `data.fields`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import DataConfig, RldsFields
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.validation import require_finite, require_plausible, zero_steps
from vjepa2_ac.episode import STATE_DIM, EpisodeInfo
from vjepa2_ac.errors import InputError

IDENTITY_SEPARATOR = "--"  # as in the published lists of DROID's idle ranges
STEP_FLAG = "steps/is_first"


def identity_of(record: ExampleRecord, fields: RldsFields) -> str:
    """Return what tells an episode from all others, whatever the order of records.

    Raises:
        InputError: A feature of the identity is missing, or neither text nor integers.
    """
    parts: list[str] = []
    for name in fields.identity:
        values = record.values(name, "bytes_list", "int64_list")
        parts += [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]
    return IDENTITY_SEPARATOR.join(parts)


def info_of(identity: str, num_steps: int) -> EpisodeInfo:
    """Return what is known of an episode; DROID says in the path whether it succeeded, other sets do not say."""
    success = True if "/success/" in identity else False if "/failure/" in identity else None
    return EpisodeInfo(id=identity, num_steps=num_steps, success=success)


def features_of_steps(config: DataConfig) -> tuple[str, ...]:
    """Return the features that states and recorded actions are made of."""
    return config.fields.state + (config.fields.action if config.actions == "recorded" else ())


def num_steps_of(record: ExampleRecord, config: DataConfig) -> int:
    """Count the steps by their first flag; a data set without it by its states, where these are poses.

    Raises:
        InputError: Neither is there.
    """
    if config.states == "vector":  # of any width: only the flag tells
        record.require([STEP_FLAG])
    if STEP_FLAG in record.located:
        return record.count_integers(STEP_FLAG)
    return sum(len(record.floats(name)) for name in config.fields.state) // STATE_DIM


def states_of(
    record: ExampleRecord, config: DataConfig, steps: int, where: str
) -> Float[np.ndarray, "steps state_dim"]:
    """Return the measured states (legend: `vjepa2_ac.episode`), which are what a robot's can be.

    Raises:
        InputError: A feature is missing, is not of one shape for all steps, or holds what cannot be states.
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
        raise InputError(
            where=f"{where}: data.fields.state", found=found, needed=f"{STATE_DIM} numbers a step: xyz, Euler, gripper"
        )
    require_plausible(states, where, fix="Check data.fields.state")
    if fields.gripper == "openness":
        states[:, 6] = 1.0 - states[:, 6]
    return states


def commands_of(
    record: ExampleRecord, config: DataConfig, steps: int, where: str
) -> Float[np.ndarray, "steps action_dim"] | None:
    """Return the recorded actions where `data.actions` asks for them.

    Raises:
        InputError: A feature is missing, is not of one shape for all steps, or holds numbers that are not finite.
    """
    if config.actions != "recorded":
        return None
    commands = np.concatenate([_of_every_step(record, name, steps, where) for name in config.fields.action], axis=1)
    require_finite(commands, f"{where}: {', '.join(config.fields.action)}", fix="Check data.fields.action")
    return commands


def joint_velocities_of(
    record: ExampleRecord, fields: RldsFields, steps: int, where: str
) -> Float[np.ndarray, "steps joints"] | None:
    """Return the commanded joint velocities, or None where the data set has none.

    Raises:
        InputError: There is not the same number for every step.
    """
    if fields.joint_velocity is None or fields.joint_velocity not in record.located:
        return None
    return _of_every_step(record, fields.joint_velocity, steps, where)


def language_of(record: ExampleRecord, fields: RldsFields) -> dict[str, str]:
    """Return the instruction as metadata; nothing where there is none.

    Raises:
        InputError: The feature is no text.
    """
    if fields.language is None or fields.language not in record.located:
        return {}
    return {"language": record.first_text(fields.language)}


def _of_every_step(record: ExampleRecord, name: str, steps: int, where: str) -> Float[np.ndarray, "steps width"]:
    values = record.floats(name).astype(np.float64)
    if len(values) == 0 or len(values) % steps:
        raise InputError(
            where=f"{where}: {name}", found=f"{len(values)} numbers", needed=f"as many for each of {steps} steps"
        )
    return values.reshape(steps, -1)
