"""Parse a message in any of the formats of openpi's clients."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, cast, get_args

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.planning.goals import GripperMode, SubGoal
from vjepa2_ac.policies.score import ChunkForm
from vjepa2_ac.storage.structured import parse_record

IMAGE_KEYS = ("observation/exterior_image_1_left", "observation/exterior_image_0_left", "observation/image")
"""Keys of the camera image (DROID, RoboArena, generic); the first one that a message contains is used."""

MAX_GOALS = 32  # goal images of one request
MAX_STEPS = 10_000  # model steps of one goal
_Steps = Annotated[int, Field(ge=0, le=MAX_STEPS)]

_STATE, _POSE, _GRIPPER = "observation/state", "observation/cartesian_position", "observation/gripper_position"
_GOAL_PREFIX = "goal/"
_GOAL_KEYS = ("goal/image", "goal/images", "goal/name")
_GOAL_OPTIONS = ("goal/rules", "goal/mask")
_ENDPOINTS = ("infer", "reset", "score")
_CHUNKS, _FORM, _FORMS = "policy/chunks", "policy/form", get_args(ChunkForm)
MAX_CHUNKS, MAX_CHUNK_STEPS = 1024, 256  # action chunks of one request, and control steps of a chunk


@dataclass(frozen=True)
class GoalRule:
    """When a goal image applies, and its gripper mode, as in goals.json; all fields are optional."""

    name: str = ""
    at_least: _Steps = 1
    at_most: _Steps | None = None
    share: float | None = None
    gripper: GripperMode | None = None


@dataclass(frozen=True, eq=False)
class GoalRequest:
    """The goal of a request: images with rules, or the name of a goal that is stored on the server."""

    goals: tuple[SubGoal, ...] = ()
    mask: np.ndarray | None = None  # height x width; nonzero where the goal image counts
    name: str | None = None

    @property
    def fingerprint(self) -> str:
        """Hash of the name, or of images, rules and mask; the same for a goal that is sent with every request."""
        digest = hashlib.sha256(repr(self.name).encode())
        for goal in self.goals:
            digest.update(repr((goal.name, goal.at_least, goal.at_most, goal.share, goal.gripper)).encode())
        for array in (*(goal.image for goal in self.goals), *(() if self.mask is None else (self.mask,))):
            digest.update(repr((array.shape, array.dtype.str)).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Request:
    """One message of a client."""

    episode: str | None = None  # session_id of the message; a new value starts an episode
    is_new_episode: bool = False  # whether the message starts an episode (reset)
    goal: GoalRequest | None = None  # None: the previous goal
    frame: UInt8[np.ndarray, "height width 3"] | None = None  # None for the endpoint reset, which returns no action
    state: Float[np.ndarray, " dim"] | None = None  # None for the endpoint reset
    chunks: Float[np.ndarray, "chunks steps dim"] | None = None  # action chunks of a policy, at control rate
    form: ChunkForm = "targets"  # meaning of the numbers in `chunks`
    is_score: bool = False  # whether to score the chunks; otherwise a search starts from them


def read_request(message: Mapping[str, Any], image_keys: Sequence[str] = IMAGE_KEYS) -> Request:
    """Parse a message. Unknown keys are ignored, except those that start with goal/.

    Args:
        message: The decoded message, with the keys of docs/serving_reference.md.
        image_keys: Keys of the camera image; the first one in the message is used.

    Raises:
        InputError: A required value is missing or has a wrong type.
    """
    endpoint, reset, episode = message.get("endpoint", "infer"), message.get("reset", False), message.get("session_id")
    if not isinstance(endpoint, str) or endpoint not in _ENDPOINTS:
        raise _make_error("endpoint", endpoint, " or ".join(_ENDPOINTS))
    if not isinstance(reset, bool):
        raise _make_error("reset", reset, "True or False")
    if episode is not None and not isinstance(episode, str):
        raise _make_error("session_id", episode, "a string that differs between episodes")
    goal = _parse_goal(message)
    if endpoint == "reset":
        return Request(episode, is_new_episode=True, goal=goal)
    key = next((key for key in image_keys if key in message), None)
    if key is None:
        raise _make_missing_key_error(message, f"the camera image under the key {' or '.join(image_keys)}")
    chunks, form = message.get(_CHUNKS), message.get(_FORM, "targets")
    if not isinstance(form, str) or form not in _FORMS:
        raise _make_error(_FORM, form, " or ".join(_FORMS))
    if (chunks is not None or endpoint == "score") and not _is_chunks(chunks):
        needed = f"a float array [chunks up to {MAX_CHUNKS}, control steps up to {MAX_CHUNK_STEPS}, numbers of a state]"
        raise _make_error(_CHUNKS, chunks, needed)
    frame, state = _parse_image(message[key], key), _parse_state(message)
    chunks = None if chunks is None else chunks.astype(np.float64)
    return Request(episode, reset, goal, frame, state, chunks, cast("ChunkForm", form), endpoint == "score")


def _is_chunks(value: Any) -> bool:
    is_array = isinstance(value, np.ndarray) and value.ndim == 3 and value.dtype.kind == "f" and value.size > 0
    return is_array and len(value) <= MAX_CHUNKS and value.shape[1] <= MAX_CHUNK_STEPS


def _parse_image(value: Any, where: str) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.ndim != 3 or value.shape[2] != 3 or value.dtype != np.uint8:
        raise _make_error(where, value, "an RGB image [height, width, 3] of type uint8")
    return value


def _parse_state(message: Mapping[str, Any]) -> np.ndarray:
    if _STATE in message:
        return _parse_numbers(message[_STATE], _STATE)
    if _POSE not in message or _GRIPPER not in message:
        raise _make_missing_key_error(
            message, f"the measured state under the key {_STATE}, or under {_POSE} and {_GRIPPER}"
        )
    pose, gripper = _parse_numbers(message[_POSE], _POSE), _parse_numbers(message[_GRIPPER], _GRIPPER)
    if pose.shape != (6,) or gripper.shape != (1,):
        needed = "6 numbers (x, y, z in metres; roll, pitch, yaw in radians, extrinsic xyz) and 1 (0 open, 1 closed)"
        raise InputError(where=f"{_POSE}, {_GRIPPER}", found=f"{pose.size} and {gripper.size} numbers", needed=needed)
    return np.concatenate([pose, gripper])


def _parse_numbers(value: Any, where: str) -> np.ndarray:
    """Return a one-dimensional float64 array from an array, a list or a single number."""
    numbers = value if isinstance(value, list) else [value]
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "iuf" and value.ndim <= 1:
            return np.atleast_1d(value).astype(np.float64)
    elif all(type(number) in (int, float) for number in numbers):
        return np.array(numbers, dtype=np.float64)
    raise _make_error(where, value, "a one-dimensional array of numbers")


def _parse_goal(message: Mapping[str, Any]) -> GoalRequest | None:
    """Return the goal of a request; without keys that start with goal/, the prompt is the name of the goal."""
    goal_keys = sorted(key for key in message if key.startswith(_GOAL_PREFIX))
    for key in goal_keys:
        if key not in {*_GOAL_KEYS, *_GOAL_OPTIONS}:
            raise _make_error("request", key, "one of " + ", ".join(sorted((*_GOAL_KEYS, *_GOAL_OPTIONS))))
    main_keys = [key for key in _GOAL_KEYS if key in message]
    if len(main_keys) > 1 or (goal_keys and not main_keys):
        raise InputError(
            where="goal", found=", ".join(goal_keys), needed="exactly one of goal/image, goal/images, goal/name"
        )
    if main_keys and main_keys != ["goal/name"]:
        return GoalRequest(
            _make_sub_goals(_parse_images(message, main_keys[0]), message.get("goal/rules")),
            _parse_mask(message.get("goal/mask")),
        )
    if len(goal_keys) > 1:
        problem = ", ".join(goal_keys)
        raise InputError(
            where="goal", found=problem, needed="only goal/name, because a named goal has its own rules and mask"
        )
    key = "goal/name" if main_keys else "prompt"
    name = message.get(key)
    if name is None and not main_keys:
        return None
    if not isinstance(name, str):
        raise _make_error(key, name, "a string: the name of a goal")
    return GoalRequest(name=name)


def _parse_images(message: Mapping[str, Any], key: str) -> tuple[np.ndarray, ...]:
    value = message[key]
    if key == "goal/image":
        return (_parse_image(value, key),)
    images = list(value) if isinstance(value, np.ndarray) and value.ndim == 4 else value
    if not isinstance(images, list) or not 1 <= len(images) <= MAX_GOALS:
        raise _make_error(key, value, f"1 to {MAX_GOALS} images of the same size, in order")
    return tuple(_parse_image(image, f"{key}[{index}]") for index, image in enumerate(images))


def _make_sub_goals(images: Sequence[np.ndarray], rules: Any) -> tuple[SubGoal, ...]:
    """Combine goal images with their rules; without rules the defaults of `GoalRule` apply."""
    keys = ", ".join(field.name for field in fields(GoalRule))
    needed = f"a map with the keys {keys} for each of {counted(len(images), 'image')}"
    rules = [{}] * len(images) if rules is None else rules
    if not isinstance(rules, list) or len(rules) != len(images) or not all(map(_is_rule, rules)):
        raise _make_error("goal/rules", rules, needed)
    goals = []
    for index, (image, values) in enumerate(zip(images, rules, strict=True)):
        rule = parse_record(GoalRule, values, where=f"goal/rules[{index}]", needed=needed)
        name = rule.name or str(index)
        goals.append(SubGoal(image, name, rule.at_least, rule.at_most, rule.share, rule.gripper))
    return tuple(goals)


def _is_rule(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(field, str | int | float | None) for field in value.values())


def _parse_mask(value: Any) -> np.ndarray | None:
    if value is not None and (not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind not in "bu"):
        needed = (
            "a bool or integer array [height, width] of the goal's size, with 0 where the goal image does not count"
        )
        raise _make_error("goal/mask", value, needed)
    return value


def _make_missing_key_error(message: Mapping[str, Any], needed: str) -> InputError:
    problem = f"the keys {', '.join(sorted(map(repr, message)))}" if message else "an empty map"
    return InputError(where="request", found=problem, needed=needed)


def _make_error(where: str, value: Any, needed: str) -> InputError:
    if isinstance(value, np.ndarray):
        return InputError(where=where, found=f"an array of shape {value.shape} and type {value.dtype}", needed=needed)
    text = repr(value)
    return InputError(where=where, found=text if len(text) <= 80 else f"{text[:79]}…", needed=needed)
