"""Requests: what a client asks for, in the dialects of openpi's clients, as one record."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import GripperMode, SubGoal

IMAGE_KEYS = ("observation/exterior_image_1_left", "observation/exterior_image_0_left", "observation/image")
"""Where the picture of the camera is looked for: the first that is there. DROID's, RoboArena's, everybody's."""

MOST_GOALS = 32  # of one request
MOST_STEPS = 10_000  # of one goal

_STATE, _POSE, _GRIPPER = "observation/state", "observation/cartesian_position", "observation/gripper_position"
_GOAL = "goal/"
_WAYS = ("goal/image", "goal/images", "goal/name")
_IN_ORDER = ("goal/durations", "goal/at_least", "goal/shares", "goal/floors", "goal/grippers")
_GOAL_KEYS = frozenset({*_WAYS, *_IN_ORDER, "goal/mask"})
_MODES = get_args(GripperMode)
_ENDPOINTS = ("infer", "reset")


@dataclass(frozen=True, eq=False)
class GivenGoal:
    """A goal whose pictures came with the request."""

    goals: tuple[SubGoal, ...]
    mask: np.ndarray | None = None  # height x width, true or 1 where it counts

    @property
    def fingerprint(self) -> str:
        """The same for the same bytes: a client may send its goal with every request."""
        digest = hashlib.sha256()
        for goal in self.goals:
            digest.update(repr((goal.at_least, goal.at_most, goal.share, goal.gripper, goal.floor)).encode())
        for one in (*(goal.image for goal in self.goals), *(() if self.mask is None else (self.mask,))):
            digest.update(repr((one.shape, one.dtype.str)).encode())
            digest.update(np.ascontiguousarray(one).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class NamedGoal:
    """A goal that the server keeps."""

    name: str

    @property
    def fingerprint(self) -> str:
        """The same for the same name."""
        return f"name {self.name}"


@dataclass(frozen=True, eq=False)
class Request:
    """One message of a client."""

    episode: str | None = None  # its session_id: a new one begins an episode
    begins: bool = False  # whether it begins an episode: reset
    is_reset_only: bool = False  # and asks for no action
    goal: GivenGoal | NamedGoal | None = None  # None: the one of before
    frame: UInt8[np.ndarray, "height width 3"] | None = None  # None if is_reset_only
    state: Float[np.ndarray, " dim"] | None = None  # None if is_reset_only


def read_request(message: Mapping[str, Any], image_keys: Sequence[str] = IMAGE_KEYS) -> Request:
    """Return what a message asks for. Other keys than these are another policy's, and do not matter here.

    Args:
        message: From the wire: keys as in docs/serving.md.
        image_keys: Where the camera's picture may be, in the order in which they are looked for.

    Raises:
        InputError: Something that is needed is missing, or of another kind.
    """
    endpoint = message.get("endpoint", "infer")
    if not isinstance(endpoint, str) or endpoint not in _ENDPOINTS:
        raise InputError(where="endpoint", found=_shown(endpoint), needed=" or ".join(_ENDPOINTS))
    reset = message.get("reset", False)
    if not isinstance(reset, bool):
        raise InputError(where="reset", found=_shown(reset), needed="True or False")
    episode = message.get("session_id")
    if episode is not None and not isinstance(episode, str):
        raise InputError(where="session_id", found=_shown(episode), needed="a text, another one for each episode")
    goal = _goal(message)
    if endpoint == "reset":
        return Request(episode, begins=True, is_reset_only=True, goal=goal)
    return Request(episode, reset, goal=goal, frame=_frame(message, image_keys), state=_state(message))


def _frame(message: Mapping[str, Any], keys: Sequence[str]) -> np.ndarray:
    key = next((key for key in keys if key in message), None)
    if key is None:
        needed = f"the picture of the camera, as {' or '.join(keys)}"
        raise InputError(where="request", found=_keys(message), needed=needed)
    return _image(message[key], key)


def _image(found: Any, where: str) -> np.ndarray:
    if not isinstance(found, np.ndarray) or found.ndim != 3 or found.shape[2] != 3 or found.dtype != np.uint8:
        raise InputError(where=where, found=_shown(found), needed="an RGB image: height x width x 3, uint8")
    return found


def _state(message: Mapping[str, Any]) -> np.ndarray:
    if _STATE in message:
        return _numbers(message[_STATE], _STATE)
    if _POSE in message and _GRIPPER in message:
        pose, gripper = _numbers(message[_POSE], _POSE), _numbers(message[_GRIPPER], _GRIPPER)
        if pose.shape != (6,) or gripper.shape != (1,):
            found = f"{pose.size} and {gripper.size} numbers"
            needed = "six (x, y, z in metres; roll, pitch, yaw in radians, extrinsic xyz), and one (0 open, 1 closed)"
            raise InputError(where=f"{_POSE}, {_GRIPPER}", found=found, needed=needed)
        return np.concatenate([pose, gripper])
    needed = f"the measured state, as {_STATE}, or as {_POSE} with {_GRIPPER}"
    raise InputError(where="request", found=_keys(message), needed=needed)


def _numbers(found: Any, where: str) -> np.ndarray:
    """Return one row of float64 numbers; a number alone is a row of one."""
    plain = found if isinstance(found, list) else [found]
    if isinstance(found, np.ndarray):
        if found.dtype.kind in "iuf" and found.ndim <= 1:
            return np.atleast_1d(found).astype(np.float64)
    elif plain and all(type(one) in (int, float) for one in plain):
        return np.array(plain, dtype=np.float64)
    raise InputError(where=where, found=_shown(found), needed="a row of numbers")


def _goal(message: Mapping[str, Any]) -> GivenGoal | NamedGoal | None:
    """Return the goal of a request; a prompt is a goal's name, unless the request says its goal in another way."""
    given = sorted(key for key in message if key.startswith(_GOAL))
    unknown = [key for key in given if key not in _GOAL_KEYS]
    if unknown:
        raise InputError(where="request", found=_shown(unknown[0]), needed=", ".join(sorted(_GOAL_KEYS)))
    ways = [key for key in _WAYS if key in message]
    if len(ways) > 1 or (given and not ways):
        raise InputError(where="goal", found=", ".join(given), needed="one of goal/image, goal/images, goal/name")
    if not ways:
        prompt = message.get("prompt")
        return None if prompt is None else NamedGoal(_name(prompt, "prompt"))
    if ways == ["goal/name"]:
        if len(given) > 1:
            found = ", ".join(given)
            raise InputError(where="goal", found=found, needed="goal/name alone: the server knows the rest")
        return NamedGoal(_name(message["goal/name"], "goal/name"))
    images = _images(message, ways[0])
    return GivenGoal(_in_order(images, message), _mask(message.get("goal/mask")))


def _in_order(images: Sequence[np.ndarray], message: Mapping[str, Any]) -> tuple[SubGoal, ...]:
    """Return goals with their rules: bounds on their steps, shares of energy, gripper modes.

    Durations alone are exact; where shares or least steps are given, they are the most.
    """
    many = len(images)
    shares = _row(message, "goal/shares", many, lambda one: 0 <= one < 1, "a number below 1 for each goal; 0: none")
    needed = f"a whole number from 1 to {MOST_STEPS:,} for each goal: its fewest model steps"
    least = _row(message, "goal/at_least", many, _is_steps, needed)
    is_bounded = shares is not None and all(shares[:-1])
    most = _durations(message.get("goal/durations"), many, is_bounded=is_bounded)
    if least is None:
        least = [1.0] * many if shares or not most else [*most, 1]
    grippers = _grippers(message.get("goal/grippers"), many)
    needed = "an energy of 0 or more for each goal: the noise of camera and encoder"
    floors = _row(message, "goal/floors", many, lambda one: 0 <= one < math.inf, needed) or [0.0] * many
    bounds: list[int | None] = [*most] if most else [None] * (many - 1)
    rows = zip(images, least, [*bounds, None], shares or [0.0] * many, grippers, floors, strict=True)
    return tuple(
        SubGoal(image, str(place), int(fewest), bound, share or None, gripper, floor)
        for place, (image, fewest, bound, share, gripper, floor) in enumerate(rows)
    )


def _row(
    message: Mapping[str, Any], key: str, many: int, is_right: Callable[[float], bool], needed: str
) -> list[float] | None:
    found = message.get(key)
    if found is None:
        return None
    numbers: list[float] = _numbers(found, key).tolist()
    if len(numbers) != many or not all(map(is_right, numbers)):
        raise InputError(where=key, found=_shown(found), needed=needed)
    return numbers


def _is_steps(number: float) -> bool:
    return number.is_integer() and 1 <= number <= MOST_STEPS


def _grippers(found: Any, many: int) -> list[GripperMode | None]:
    if found is None:
        return [None] * many
    is_row = isinstance(found, list) and len(found) == many and all(isinstance(one, str) for one in found)
    if not is_row or not all(one in {"", *_MODES} for one in found):
        needed = f"for each goal one of {', '.join(_MODES)}; an empty text: planning.limits.gripper_mode"
        raise InputError(where="goal/grippers", found=_shown(found), needed=needed)
    return [one or None for one in found]


def _images(message: Mapping[str, Any], key: str) -> tuple[np.ndarray, ...]:
    found = message[key]
    if key == "goal/image":
        return (_image(found, key),)
    rows = list(found) if isinstance(found, np.ndarray) and found.ndim == 4 else found
    if not isinstance(rows, list) or not 1 <= len(rows) <= MOST_GOALS:
        needed = f"1 to {MOST_GOALS} images of one size, in order"
        raise InputError(where=key, found=_shown(found), needed=needed)
    return tuple(_image(image, f"{key}[{place}]") for place, image in enumerate(rows))


def _durations(found: Any, goals: int, *, is_bounded: bool) -> list[int]:
    """Return the model steps of each goal but the last; none where they may be left out, and are."""
    if found is None and (goals == 1 or is_bounded):
        return []
    numbers = [] if found is None or len(np.atleast_1d(found)) == 0 else _numbers(found, "goal/durations").tolist()
    if len(numbers) != goals - 1 or not all(map(_is_steps, numbers)):
        needed = f"{goals - 1} whole numbers from 1 to {MOST_STEPS:,}: model steps of each goal but the last"
        raise InputError(where="goal/durations", found=_shown(found), needed=needed)
    return list(map(int, numbers))


def _mask(found: Any) -> np.ndarray | None:
    if found is None:
        return None
    if not isinstance(found, np.ndarray) or found.ndim != 2 or found.dtype.kind not in "bu":
        needed = "height x width, of the goal's size, bool or whole numbers: 0 where the image does not count"
        raise InputError(where="goal/mask", found=_shown(found), needed=needed)
    return found


def _name(found: Any, where: str) -> str:
    if not isinstance(found, str):
        raise InputError(where=where, found=_shown(found), needed="a text: the name of a goal")
    return found


def _keys(message: Mapping[str, Any]) -> str:
    return f"the keys {', '.join(sorted(map(repr, message)))}" if message else "an empty map"


def _shown(found: Any) -> str:
    if isinstance(found, np.ndarray):
        return f"an array of shape {found.shape} and type {found.dtype}"
    text = repr(found)
    return text if len(text) <= 80 else f"{text[:79]}…"
