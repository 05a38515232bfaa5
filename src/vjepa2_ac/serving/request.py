"""Requests: what a client asks for, in the dialects of openpi's clients, as one record."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, cast, get_args

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.planning.goals import GripperMode, SubGoal
from vjepa2_ac.policies.score import ChunkForm
from vjepa2_ac.storage.structured import record_of

IMAGE_KEYS = ("observation/exterior_image_1_left", "observation/exterior_image_0_left", "observation/image")
"""Where the picture of the camera is looked for: the first that is there. DROID's, RoboArena's, everybody's."""

MOST_GOALS = 32  # of one request

_STATE, _POSE, _GRIPPER = "observation/state", "observation/cartesian_position", "observation/gripper_position"
_GOAL = "goal/"
_WAYS = ("goal/image", "goal/images", "goal/name")
_MORE = ("goal/rules", "goal/mask")
_ENDPOINTS = ("infer", "reset", "score")
_CHUNKS, _FORM, _FORMS = "policy/chunks", "policy/form", get_args(ChunkForm)
MOST_CHUNKS, MOST_CHUNK_STEPS = 1024, 256  # of one request; control steps of each


@dataclass(frozen=True)
class GoalRule:
    """What applies to one goal image, as in goals.json; all may be left out."""

    name: str = ""
    at_least: int = 1
    at_most: int | None = None
    share: float | None = None
    gripper: GripperMode | None = None


@dataclass(frozen=True, eq=False)
class GivenGoal:
    """A goal whose pictures came with the request; or the name of one that the server keeps."""

    goals: tuple[SubGoal, ...] = ()
    mask: np.ndarray | None = None  # height x width, true or 1 where it counts
    name: str | None = None

    @property
    def fingerprint(self) -> str:
        """The same for the same name, or bytes: a client may send its goal with every request."""
        digest = hashlib.sha256(repr(self.name).encode())
        for goal in self.goals:
            digest.update(repr((goal.name, goal.at_least, goal.at_most, goal.share, goal.gripper)).encode())
        for one in (*(goal.image for goal in self.goals), *(() if self.mask is None else (self.mask,))):
            digest.update(repr((one.shape, one.dtype.str)).encode())
            digest.update(np.ascontiguousarray(one).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Request:
    """One message of a client."""

    episode: str | None = None  # its session_id: a new one begins an episode
    begins: bool = False  # whether it begins an episode: reset
    goal: GivenGoal | None = None  # None: the one of before
    frame: UInt8[np.ndarray, "height width 3"] | None = None  # None: a reset, which asks for no action
    state: Float[np.ndarray, " dim"] | None = None  # likewise
    chunks: Float[np.ndarray, "chunks steps dim"] | None = None  # what a policy would do, at control rate
    form: ChunkForm = "targets"  # what their numbers mean
    is_score: bool = False  # the chunks are to be scored; else a search starts from them


def read_request(message: Mapping[str, Any], image_keys: Sequence[str] = IMAGE_KEYS) -> Request:
    """Return what a message asks for. Other keys than these are another policy's, and do not matter here.

    Args:
        message: From the wire: keys as in docs/serving_reference.md.
        image_keys: Where the camera's picture may be, in the order in which they are looked for.

    Raises:
        InputError: Something that is needed is missing, or of another kind.
    """
    endpoint, reset, episode = message.get("endpoint", "infer"), message.get("reset", False), message.get("session_id")
    if not isinstance(endpoint, str) or endpoint not in _ENDPOINTS:
        raise _wrong("endpoint", endpoint, " or ".join(_ENDPOINTS))
    if not isinstance(reset, bool):
        raise _wrong("reset", reset, "True or False")
    if episode is not None and not isinstance(episode, str):
        raise _wrong("session_id", episode, "a text, another one for each episode")
    goal = _goal(message)
    if endpoint == "reset":
        return Request(episode, begins=True, goal=goal)
    key = next((key for key in image_keys if key in message), None)
    if key is None:
        raise _missing(message, f"the picture of the camera, as {' or '.join(image_keys)}")
    chunks, form = message.get(_CHUNKS), message.get(_FORM, "targets")
    if not isinstance(form, str) or form not in _FORMS:
        raise _wrong(_FORM, form, " or ".join(_FORMS))
    if (chunks is not None or endpoint == "score") and not _is_chunks(chunks):
        needed = f"floats, up to {MOST_CHUNKS} chunks x up to {MOST_CHUNK_STEPS} control steps x numbers of a state"
        raise _wrong(_CHUNKS, chunks, needed)
    frame, state = _image(message[key], key), _state(message)
    chunks = None if chunks is None else chunks.astype(np.float64)
    return Request(episode, reset, goal, frame, state, chunks, cast("ChunkForm", form), endpoint == "score")


def _is_chunks(found: Any) -> bool:
    is_array = isinstance(found, np.ndarray) and found.ndim == 3 and found.dtype.kind == "f" and found.size > 0
    return is_array and len(found) <= MOST_CHUNKS and found.shape[1] <= MOST_CHUNK_STEPS


def _image(found: Any, where: str) -> np.ndarray:
    if not isinstance(found, np.ndarray) or found.ndim != 3 or found.shape[2] != 3 or found.dtype != np.uint8:
        raise _wrong(where, found, "an RGB image: height x width x 3, uint8")
    return found


def _state(message: Mapping[str, Any]) -> np.ndarray:
    if _STATE in message:
        return _numbers(message[_STATE], _STATE)
    if _POSE not in message or _GRIPPER not in message:
        raise _missing(message, f"the measured state, as {_STATE}, or as {_POSE} with {_GRIPPER}")
    pose, gripper = _numbers(message[_POSE], _POSE), _numbers(message[_GRIPPER], _GRIPPER)
    if pose.shape != (6,) or gripper.shape != (1,):
        found = f"{pose.size} and {gripper.size} numbers"
        needed = "six (x, y, z in metres; roll, pitch, yaw in radians, extrinsic xyz), and one (0 open, 1 closed)"
        raise InputError(where=f"{_POSE}, {_GRIPPER}", found=found, needed=needed)
    return np.concatenate([pose, gripper])


def _numbers(found: Any, where: str) -> np.ndarray:
    """Return one row of float64 numbers; a number alone is a row of one."""
    plain = found if isinstance(found, list) else [found]
    if isinstance(found, np.ndarray):
        if found.dtype.kind in "iuf" and found.ndim <= 1:
            return np.atleast_1d(found).astype(np.float64)
    elif all(type(one) in (int, float) for one in plain):
        return np.array(plain, dtype=np.float64)
    raise _wrong(where, found, "a row of numbers")


def _goal(message: Mapping[str, Any]) -> GivenGoal | None:
    """Return the goal of a request; a prompt is a goal's name, unless the request says its goal in another way."""
    given = sorted(key for key in message if key.startswith(_GOAL))
    for key in given:
        if key not in {*_WAYS, *_MORE}:
            raise _wrong("request", key, ", ".join(sorted((*_WAYS, *_MORE))))
    ways = [key for key in _WAYS if key in message]
    if len(ways) > 1 or (given and not ways):
        raise InputError(where="goal", found=", ".join(given), needed="one of goal/image, goal/images, goal/name")
    if ways and ways != ["goal/name"]:
        return GivenGoal(
            _in_order(_images(message, ways[0]), message.get("goal/rules")), _mask(message.get("goal/mask"))
        )
    if len(given) > 1:
        found = ", ".join(given)
        raise InputError(where="goal", found=found, needed="goal/name alone: the server knows the rest")
    key = "goal/name" if ways else "prompt"
    name = message.get(key)
    if name is None and not ways:
        return None
    if not isinstance(name, str):
        raise _wrong(key, name, "a text: the name of a goal")
    return GivenGoal(name=name)


def _images(message: Mapping[str, Any], key: str) -> tuple[np.ndarray, ...]:
    found = message[key]
    if key == "goal/image":
        return (_image(found, key),)
    rows = list(found) if isinstance(found, np.ndarray) and found.ndim == 4 else found
    if not isinstance(rows, list) or not 1 <= len(rows) <= MOST_GOALS:
        raise _wrong(key, found, f"1 to {MOST_GOALS} images of one size, in order")
    return tuple(_image(image, f"{key}[{place}]") for place, image in enumerate(rows))


def _in_order(images: Sequence[np.ndarray], rules: Any) -> tuple[SubGoal, ...]:
    """Return images as goals with their rules; without rules none has a bound."""
    needed = f"a map for each of {counted(len(images), 'image')}: {', '.join(field.name for field in fields(GoalRule))}"
    rules = [{}] * len(images) if rules is None else rules
    if not isinstance(rules, list) or len(rules) != len(images) or not all(map(_is_rule, rules)):
        raise _wrong("goal/rules", rules, needed)
    goals = []
    for place, (image, values) in enumerate(zip(images, rules, strict=True)):
        rule = record_of(GoalRule, values, where=f"goal/rules[{place}]", needed=needed)
        name = rule.name or str(place)
        goals.append(SubGoal(image, name, rule.at_least, rule.at_most, rule.share, rule.gripper))
    return tuple(goals)


def _is_rule(found: Any) -> bool:
    return isinstance(found, dict) and all(isinstance(one, str | int | float | None) for one in found.values())


def _mask(found: Any) -> np.ndarray | None:
    if found is not None and (not isinstance(found, np.ndarray) or found.ndim != 2 or found.dtype.kind not in "bu"):
        needed = "height x width, of the goal's size, bool or whole numbers: 0 where the image does not count"
        raise _wrong("goal/mask", found, needed)
    return found


def _missing(message: Mapping[str, Any], needed: str) -> InputError:
    found = f"the keys {', '.join(sorted(map(repr, message)))}" if message else "an empty map"
    return InputError(where="request", found=found, needed=needed)


def _wrong(where: str, found: Any, needed: str) -> InputError:
    if isinstance(found, np.ndarray):
        return InputError(where=where, found=f"an array of shape {found.shape} and type {found.dtype}", needed=needed)
    text = repr(found)
    return InputError(where=where, found=text if len(text) <= 80 else f"{text[:79]}…", needed=needed)
