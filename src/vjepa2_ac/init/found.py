"""Config values that `init` derived from a data set, each with its reason, and their text as YAML."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import yaml_line
from vjepa2_ac.errors import InputError, escaped

GUESSED = "GUESSED: "
_COLUMN = 34  # text column at which comments start


@dataclass(frozen=True)
class Knob:
    """The value of a config key, the reason for it, and whether it is a guess."""

    value: Any
    why: str = ""
    is_guess: bool = False


Knobs = Mapping[str, "Knob | Knobs"]


def as_yaml(head: Sequence[str], knobs: Knobs) -> str:
    """Format config values as YAML, with a comment at the top and one after each value that has a reason.

    Args:
        head: Lines of the comment at the top.
        knobs: Values by key, nested as in the config.
    """
    lines = [f"# {escaped(line)}".rstrip() for line in head]
    for name, entry in knobs.items():
        if not isinstance(entry, Knob):
            lines.append("")
        lines += _lines({name: entry}, "")
    return "\n".join(lines) + "\n"


def plain(knobs: Knobs) -> dict[str, Any]:
    """Return the values without reasons, as a nested mapping like the parsed YAML."""
    return {name: entry.value if isinstance(entry, Knob) else plain(entry) for name, entry in knobs.items()}


def guesses(knobs: Knobs, prefix: str = "") -> dict[str, str]:
    """Return all guessed values with their reasons as text, by dotted key."""
    texts: dict[str, str] = {}
    for name, entry in knobs.items():
        if not isinstance(entry, Knob):
            texts |= guesses(entry, f"{prefix}{name}.")
        elif entry.is_guess:
            value = yaml_line(name, entry.value).removeprefix(f"{name}: ")
            texts[prefix + name] = f"{value}: {entry.why}" if entry.why else value
    return texts


def _lines(knobs: Knobs, indent: str) -> Iterator[str]:
    for name, entry in knobs.items():
        if not isinstance(entry, Knob):
            yield f"{indent}{name}:"
            yield from _lines(entry, indent + "  ")
            continue
        line, comment = indent + yaml_line(name, entry.value), escaped(GUESSED * entry.is_guess + entry.why)
        yield f"{line:<{_COLUMN}}  # {comment}" if comment else line


@dataclass(frozen=True)
class FoundData:
    """The properties of a data set that were read from its description files."""

    source: str  # value of data.source
    path: str
    knobs: Knobs  # further keys of the section `data`: cameras, names of columns
    rate_hz: Knob  # control steps per second
    states: Literal["pose", "vector"] = "pose"
    episodes: int | None = None
    steps: int | None = None  # control steps of all episodes
    usual_steps: int | None = None  # median number of control steps per episode
    short_steps: int | None = None  # 10th percentile of the number of control steps per episode
    own_splits: tuple[Split, ...] = ()  # the splits among validation and test that the data set defines itself
    idle: Knobs | None = None  # section `data.idle`; None: no rule
    about: tuple[str, ...] = ()  # descriptions for the user


def idle_rule(*, has_velocities: bool) -> Knobs:
    """Return the section `data.idle`, with the rule for commanded velocities if the data set has them."""
    return {"rule": Knob("commands" if has_velocities else "motion", "pauses teach nothing")}


# ---- selection of a camera by its name ----

_AT_THE_HAND = re.compile(r"wrist|hand|eih|gripper", re.I)
_FROM_OUTSIDE = re.compile(r"ext|front|side|third|agent|base|scene|top|over|left|image_0|primary", re.I)
_NOT_SEEN = re.compile(r"depth|disparity|segment|mask|gelsight|tactile", re.I)


def is_no_camera(feature: str) -> bool:
    """Return whether the name of a feature suggests a depth map, a segmentation or a tactile sensor."""
    return _NOT_SEEN.search(feature) is not None


def pick_camera(cameras: Sequence[str]) -> str:
    """Return the camera that is most similar to those of the released weights' training data: an exterior camera."""
    outside = [name for name in cameras if not _AT_THE_HAND.search(name)]
    return next((name for name in outside if _FROM_OUTSIDE.search(name)), (outside or list(cameras))[0])


def camera_knobs(features: Sequence[str], no_cameras: Sequence[str], where: str) -> tuple[Knob, Knob]:
    """Return the config keys `camera` (the selected camera) and `cameras` (the feature of each camera).

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
    """Return a short camera name for each feature: as many last parts of its name as are needed to be unique."""
    parts = {name: [re.sub(r"\W+", "_", part) for part in re.split(r"[./]", name)] for name in features}
    for count in range(1, 1 + max(map(len, parts.values()), default=0)):
        short = {name: "_".join(part[-count:]) or "camera" for name, part in parts.items()}
        if len(set(short.values())) == len(short):
            return short
    return {name: name for name in features}
