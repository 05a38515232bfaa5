"""What was found in a data set, as values of a config with their reasons, and their text as YAML."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import yaml_line
from vjepa2_ac.errors import InputError, escaped

GUESSED = "GUESSED: "
_COLUMN = 34  # of the comments


@dataclass(frozen=True)
class Knob:
    """A value, why it is that, and whether it was guessed."""

    value: Any
    why: str = ""
    is_guess: bool = False


Knobs = Mapping[str, "Knob | Knobs"]


def as_yaml(head: Sequence[str], knobs: Knobs) -> str:
    """Return knobs as the text of a config: a comment at the top, and one behind each value that has a reason."""
    lines = [f"# {escaped(line)}".rstrip() for line in head]
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            lines.append("")
        lines += _lines({name: one}, "")
    return "\n".join(lines) + "\n"


def plain(knobs: Knobs) -> dict[str, Any]:
    """Return the values alone, as reading their text gives them."""
    return {name: one.value if isinstance(one, Knob) else plain(one) for name, one in knobs.items()}


def guesses(knobs: Knobs, prefix: str = "") -> dict[str, str]:
    """Return the value and the reason of all guesses, by dotted key."""
    found: dict[str, str] = {}
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            found |= guesses(one, f"{prefix}{name}.")
        elif one.is_guess:
            value = yaml_line(name, one.value).removeprefix(f"{name}: ")
            found[prefix + name] = f"{value}: {one.why}" if one.why else value
    return found


def _lines(knobs: Knobs, indent: str) -> Iterator[str]:
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            yield f"{indent}{name}:"
            yield from _lines(one, indent + "  ")
            continue
        line, comment = indent + yaml_line(name, one.value), escaped(GUESSED * one.is_guess + one.why)
        yield f"{line:<{_COLUMN}}  # {comment}" if comment else line


@dataclass(frozen=True)
class FoundData:
    """A data set, as far as its descriptions tell."""

    source: str  # form of data
    path: str
    knobs: Knobs  # of `data`, beyond source and path: cameras, names of columns
    rate_hz: Knob  # control steps per second
    states: Literal["pose", "vector"] = "pose"
    episodes: int | None = None
    steps: int | None = None  # control steps of all episodes
    usual_steps: int | None = None  # of an episode: the median
    short_steps: int | None = None  # nine of ten episodes have more
    own_splits: tuple[Split, ...] = ()  # validation and test, if the data set has them itself
    idle: Knobs | None = None  # of `data.idle`; None: no rule
    about: tuple[str, ...] = ()  # what a person should know of it


def idle_rule(*, has_velocities: bool) -> Knobs:
    """Return the section of `data.idle`: by the commanded velocities if there are any."""
    return {"rule": Knob("commands" if has_velocities else "motion", "pauses teach nothing")}


# ---- which camera: a guess, from its name ----

_AT_THE_HAND = re.compile(r"wrist|hand|eih|gripper", re.I)
_FROM_OUTSIDE = re.compile(r"ext|front|side|third|agent|base|scene|top|over|left|image_0|primary", re.I)
_NOT_SEEN = re.compile(r"depth|disparity|segment|mask|gelsight|tactile", re.I)


def is_no_camera(feature: str) -> bool:
    """Return whether a feature is called like a depth map or a segmentation."""
    return _NOT_SEEN.search(feature) is not None


def pick_camera(cameras: Sequence[str]) -> str:
    """Return the camera that most resembles what the released weights saw: one that looks on from outside."""
    outside = [name for name in cameras if not _AT_THE_HAND.search(name)]
    return next((name for name in outside if _FROM_OUTSIDE.search(name)), (outside or list(cameras))[0])


def camera_knobs(features: Sequence[str], no_cameras: Sequence[str], where: str) -> tuple[Knob, Knob]:
    """Return the keys `camera` and `cameras` of a config: the camera that is used, and the feature of each camera.

    Raises:
        InputError: There is no feature with images of a camera.
    """
    if not features:
        found = f"no camera, only depth maps ({', '.join(no_cameras)})" if no_cameras else "no camera"
        raise InputError(where=where, found=found, needed="videos or images of the robot at each step")
    names = camera_names(features)
    why = f"of {', '.join(names.values())}; the released weights were trained on DROID's exterior_1_left"
    is_guess = len(names) > 1
    camera = Knob(names[pick_camera(features)], why if is_guess else "", is_guess)
    return camera, Knob({name: feature for feature, name in names.items()})


def camera_names(features: Sequence[str]) -> dict[str, str]:
    """Return a short name for the camera of each feature: the last parts of the feature's name, as many as differ."""
    parts = {name: [re.sub(r"\W+", "_", part) for part in re.split(r"[./]", name)] for name in features}
    for count in range(1, 1 + max(map(len, parts.values()), default=0)):
        short = {name: "_".join(part[-count:]) or "camera" for name, part in parts.items()}
        if len(set(short.values())) == len(short):
            return short
    return {name: name for name in features}
