"""An episode in a record: its identity, steps and states, from the features named in `data.fields`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from vjepa2_ac.config import RldsData, RldsFields
from vjepa2_ac.data.sources.indexed_source import require_as_indexed
from vjepa2_ac.data.sources.rlds.tfrecord import (
    Kind,
    NotAnExampleError,
    Place,
    Read,
    RecordSpan,
    decode_feature,
    iterate_features,
)
from vjepa2_ac.episode import STATE_DIM, Episode, EpisodeInfo, FrameReader
from vjepa2_ac.errors import InputError, did_you_mean
from vjepa2_ac.spaces import POSE, require_finite, zero_steps

IDENTITY_SEPARATOR = "--"  # as in the published lists of DROID's idle ranges
STEP_FLAG = "steps/is_first"
_MOST_BYTES = 1 << 28  # of a feature that is read whole: numbers and texts


class Record:
    """The features of one record, read on request.

    Args:
        read: Returns bytes of the file.
        span: The record's position in it.
        located: The position of each feature, if known already.
    """

    def __init__(self, read: Read, span: RecordSpan, located: dict[str, Place] | None = None) -> None:
        self._read, self._span = read, span
        if located is not None:
            self.located = located

    @cached_property
    def located(self) -> dict[str, Place]:
        """The position of each feature."""
        return self.locate()

    def locate(self, enough: Sequence[set[str]] = ()) -> dict[str, Place]:
        """Return the position of the features up to where all of one of these sets are found.

        Raises:
            InputError: The record is no Example.
        """
        found: dict[str, Place] = {}
        try:
            for name, place in iterate_features(self._read, self._span.data_offset, self._span.length):
                found[name] = place
                if any(found.keys() >= names for names in enough):
                    break
        except NotAnExampleError as error:
            found_text = f"not a tf.train.Example ({error})"
            raise InputError(where=str(self._span), found=found_text, needed="an RLDS data set") from None
        return found

    def place_of(self, name: str) -> Place:
        """Return the position of a feature.

        Raises:
            InputError: The record lacks it; names the features that it has.
        """
        if name not in self.located:
            known = sorted(self.located)
            found = f"no feature {name}; the record has {', '.join(known) or 'none'}"
            raise InputError(where=str(self._span), found=found, fix=f"{did_you_mean(name, known)}Set data.fields")
        return self.located[name]

    def floats(self, name: str) -> Float32[np.ndarray, " values"]:
        """Return the numbers of a feature.

        Raises:
            InputError: There is no such feature, or it has no floats.
        """
        return np.asarray(self.values(name, "float_list"), np.float32)

    def values(self, name: str, *kinds: Kind, texts: int | None = None) -> Sequence[Any] | np.ndarray:
        """Return a feature's values; of texts the first so many.

        Raises:
            InputError: There is no such feature, it has values of another type or too many, or the file ends within it.
        """
        offset, length = self.place_of(name)
        where = f"{self._span}: {name}"
        if length > _MOST_BYTES:
            raise InputError(where=where, found=f"{length:,} bytes", needed=f"at most {_MOST_BYTES:,}")
        data = self._read(offset, length)
        if len(data) < length:
            raise InputError(where=where, found=f"{len(data)} bytes at {offset}", needed=f"{length} bytes")
        try:
            found, values = decode_feature(data, texts)
        except NotAnExampleError as error:
            raise InputError(where=where, found=f"not a feature ({error})", needed="an RLDS data set") from None
        if found is not None and found not in kinds:
            raise InputError(where=where, found=f"a {found}", needed=f"a {' or '.join(kinds)}", fix="Check data.fields")
        return values


def identity_of(record: Record, fields: RldsFields) -> str:
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


def num_steps_of(record: Record, config: RldsData) -> int:
    """Count the steps by their first flag; without it by the states, if these are poses.

    Raises:
        InputError: There is neither.
    """
    if config.states == "vector":  # of any width: only the flag gives the count
        record.place_of(STEP_FLAG)
    if STEP_FLAG in record.located:
        return len(record.values(STEP_FLAG, "int64_list"))
    return sum(len(record.floats(name)) for name in config.fields.state) // STATE_DIM


def episode_of(record: Record, config: RldsData, info: EpisodeInfo, read_frames: FrameReader, where: str) -> Episode:
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
    require_as_indexed(num_steps_of(record, config), info, where)
    steps, velocity, language = info.num_steps, config.fields.joint_velocity, config.fields.language
    return Episode(
        info=info,
        states=states_of(record, config, steps, where),
        read_frames=read_frames,
        control_rate_hz=config.fields.control_rate_hz,
        joint_velocities=_of_every_step(record, velocity, steps, where) if velocity in record.located else None,
        metadata={"language": _first_text(record, language)} if language in record.located else {},
        commands=commands_of(record, config, steps, where),
    )


def states_of(record: Record, config: RldsData, steps: int, where: str) -> Float[np.ndarray, "steps state_dim"]:
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
    record: Record, config: RldsData, steps: int, where: str
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


def _first_text(record: Record, name: str) -> str:
    return "".join(text.decode(errors="replace") for text in record.values(name, "bytes_list", texts=1))


def _of_every_step(record: Record, name: str, steps: int, where: str) -> Float[np.ndarray, "steps width"]:
    values = record.floats(name).astype(np.float64)
    if len(values) == 0 or len(values) % steps:
        found, needed = f"{len(values)} numbers", f"as many for each of {steps} steps"
        raise InputError(where=f"{where}: {name}", found=found, needed=needed)
    return values.reshape(steps, -1)
