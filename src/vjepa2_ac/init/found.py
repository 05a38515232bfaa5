"""What was found in a data set, as values of a config with their reasons, and their text as YAML."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vjepa2_ac.config.loading import yaml_line

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
    lines = [f"# {line}".rstrip() for line in head]
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            lines.append("")
        lines += _lines({name: one}, "")
    return "\n".join(lines) + "\n"


def plain(knobs: Knobs) -> dict[str, Any]:
    """Return the values alone, as reading their text gives them."""
    return {name: one.value if isinstance(one, Knob) else plain(one) for name, one in knobs.items()}


def guesses(knobs: Knobs, prefix: str = "") -> dict[str, str]:
    """Return the reasons of all guesses, by dotted key."""
    found: dict[str, str] = {}
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            found |= guesses(one, f"{prefix}{name}.")
        elif one.is_guess:
            found[prefix + name] = one.why
    return found


def _lines(knobs: Knobs, indent: str) -> Iterator[str]:
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            yield f"{indent}{name}:"
            yield from _lines(one, indent + "  ")
            continue
        line, comment = indent + yaml_line(name, one.value), GUESSED * one.is_guess + one.why
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
    idle: Knobs | None = None  # of `data.idle`; None: no rule
    about: tuple[str, ...] = ()  # what a person should know of it


def idle_rule(*, has_velocities: bool) -> Knobs:
    """Return the section of `data.idle`: by the commanded velocities if there are any."""
    return {"rule": Knob("commands" if has_velocities else "motion", "pauses teach nothing")}


# ---- what columns and cameras are probably called: guesses, from names and widths ----

Rotation = Literal["euler_xyz", "quaternion_wxyz", "quaternion_xyzw"]

DROID_STATE = ("cartesian_position", "gripper_position")  # 6 and 1 numbers, at the end of their names
_NO_STATE = re.compile(r"action|timestamp|index|reward|done|joint|qpos|velocity|torque|effort|force|current", re.I)
_POSE = re.compile(r"cartesian|ee_?f?(_|\.|$|pose|pos)|tcp|pose|state", re.I)
_GRIPPER = re.compile(r"grip|finger", re.I)
_JOINT = re.compile(r"joint|motor|shoulder|elbow|wrist|waist|\.pos$", re.I)
_AT_THE_HAND = re.compile(r"wrist|hand|eih|gripper", re.I)
_FROM_OUTSIDE = re.compile(r"ext|front|side|third|agent|base|scene|top|over|left|image_0|primary", re.I)
_ANGLES = (("roll", "pitch", "yaw"), ("rx", "ry", "rz"))
_QUATERNIONS: tuple[tuple[tuple[str, ...], Rotation], ...] = (
    (("qx", "qy", "qz", "qw"), "quaternion_xyzw"),
    (("qw", "qx", "qy", "qz"), "quaternion_wxyz"),
)


@dataclass(frozen=True)
class Column:
    """A column of numbers: how many a step, and what they are called, where that is said."""

    width: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Pose:
    """Where the pose and the gripper probably are."""

    columns: tuple[str, ...]
    rotation: Rotation
    why: str
    is_guess: bool
    select: tuple[int, ...] | None = None
    gripper: tuple[str, int] = ("", 0)  # column, and number in it


def find_pose(columns: Mapping[str, Column]) -> Pose | None:
    """Return where the measured pose probably is: by the names of numbers, by DROID's columns, or by widths."""
    measured = {name: one for name, one in columns.items() if not _NO_STATE.search(name)}
    droid = [next((name for name in measured if re.split(r"[./]", name)[-1] == end), "") for end in DROID_STATE]
    if all(droid) and [columns[name].width for name in droid] == [6, 1]:
        return Pose(tuple(droid), "euler_xyz", "called as DROID's columns", is_guess=False, gripper=(droid[1], 0))
    named = (_by_names(name, one) for name, one in measured.items())
    return next((one for one in named if one), None) or _by_widths(measured)


def pick_camera(cameras: Sequence[str]) -> str:
    """Return the camera that most resembles what the released weights saw: one that looks on from outside."""
    outside = [name for name in cameras if not _AT_THE_HAND.search(name)]
    return next((name for name in outside if _FROM_OUTSIDE.search(name)), (outside or list(cameras))[0])


def short_name(feature: str) -> str:
    """Return a name for a camera: the last part of its feature's."""
    return re.sub(r"\W+", "_", re.split(r"[./]", feature)[-1]) or "camera"


def _by_names(column: str, one: Column) -> Pose | None:
    if len(one.names) != one.width:
        return None
    parts = [re.split(r"[._/ -]", name.lower())[-1] for name in one.names]
    gripper = next((place for place, name in enumerate(one.names) if _GRIPPER.search(name)), None)
    if gripper is None or not {"x", "y", "z"} <= set(parts):
        return None
    turns: list[tuple[tuple[str, ...], Rotation]] = [*((names, "euler_xyz") for names in _ANGLES), *_QUATERNIONS]
    for names, rotation in turns:
        if set(names) <= set(parts):
            select = (*(parts.index(name) for name in ("x", "y", "z", *names)), gripper)
            whole = select == tuple(range(one.width))
            why = f"by the names of its numbers: {', '.join(one.names)}"
            return Pose((column,), rotation, why, names[0] == "rx", None if whole else select, (column, gripper))
    return None


def _by_widths(measured: Mapping[str, Column]) -> Pose | None:
    poses = {
        name: one.width
        for name, one in measured.items()
        if _POSE.search(name) and not _GRIPPER.search(name) and not any(map(_JOINT.search, one.names))
    }
    grippers = [name for name, one in measured.items() if _GRIPPER.search(name) and one.width == 1]
    of_width: dict[int, tuple[Rotation, str]] = {
        6: ("euler_xyz", "position and three angles, radians, extrinsic xyz"),
        7: ("quaternion_xyzw", "position and a quaternion, w last"),
    }
    for name, width in poses.items():
        if grippers and width in of_width:
            rotation, why = of_width[width]
            return Pose((name, grippers[0]), rotation, why, is_guess=True, gripper=(grippers[0], 0))
    of_whole: dict[int, tuple[Rotation, str]] = {
        7: ("euler_xyz", "x, y, z, three angles, the gripper"),
        8: ("quaternion_xyzw", "x, y, z, a quaternion, the gripper"),
    }
    for name, width in poses.items():
        if width in of_whole:
            rotation, why = of_whole[width]
            return Pose((name,), rotation, f"{why}; or are these joints?", is_guess=True, gripper=(name, width - 1))
    return None
