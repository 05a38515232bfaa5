"""Recognise the pose of the robot among the columns of a data set: by names, by widths, and by the numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.sources import RotationFormat
from vjepa2_ac.data.rotation_formats import rotation_speeds, smoother_format
from vjepa2_ac.init.found import Knob, Knobs
from vjepa2_ac.spaces import ANGLE_RAD, REACH_M

Numbers = Float[np.ndarray, "steps _"]
Samples = Mapping[str, Sequence[Numbers]]  # the numbers of some episodes, by column; without a column: not read
Kind = Literal["position", "euler", "degrees", "rotation_vector", "quaternion", "rotation", "gripper"]

DROID_STATE = ("cartesian_position", "gripper_position")  # 6 and 1 numbers, at the end of their names
_NO_STATE = re.compile(r"action|timestamp|index|reward|done|joint|qpos|velocity|torque|effort|force|current", re.I)
_COMMANDED = re.compile(r"target|cmd|command(ed)?|goal|desired|des|setpoint|action|ref(erence)?")
_POSE = re.compile(r"cartesian|ee_?f?(_|\.|$|pose|pos)|tcp|pose|state", re.I)
_GRIPPER = re.compile(r"grip|finger", re.I)
_JOINT = re.compile(r"joint|motor|shoulder|elbow|wrist|waist|\.pos$", re.I)
_NO_POSE = re.compile(r"joint|motor|vel|speed|force|torque|effort|accel|wrench|current", re.I)

_WHY_BY_WIDTH = "by the width of the column, whose numbers have no names; if they are joints, set states: vector"
_MAX_RAD_S = 10.0  # no hand turns faster
_METRES, _UNIT = 0.15, 1.05  # largest values of a gripper's opening in metres, and of a share

_AXES = ("xyz", "123", "012", ("roll", "pitch", "yaw"))
_PARTS: tuple[tuple[Kind, str], ...] = (  # by the end of a number's name, the first that fits
    ("euler", r"(?:^|_)(roll|pitch|yaw)$"),
    ("rotation_vector", r"(?:axis_?angle|axang|rot_?vec|rotation_vector|rvec)_?([xyz0-3])$"),
    ("euler", r"(?:euler|rpy|angle|theta)_?([xyz0-3])$"),
    ("rotation_vector", r"(?:^|_)w([xyz])$"),
    ("quaternion", r"(?:^|_)(?:q|quat_?|quaternion_?)([xyzw])$"),
    ("quaternion", r"(?:quat|quaternion)_?([0-4])$"),
    ("rotation", r"(?:^|_)(?:r|rot_?|rotation_?|ori_?|orient_?|orientation_?)([xyzw0-3])$"),
    ("quaternion", r"(?:^|_)(w)$"),
    ("position", r"(?:^|_)(?:(?:pos|position|trans|translation|xyz|p|t)_?)?([xyz])$"),
    ("position", r"(?:pos|position|trans|translation|xyz)_?([0-3])$"),
)
_UNIT_AT_END = re.compile(r"_(mm|cm|m|rad|radians|deg|degrees)$")
_NEUTRAL = re.compile(  # parts of names that do not tell arms apart
    r"pos|position|ee|eef|end|effector|tcp|pose|rot|rotation|ori|orient|orientation|quat|quaternion|euler|rpy|state|obs|"
    r"observations?|steps|measured|actual|cartesian|robot|arm|flange|hand|tool|gripper|fingers?|width|opening|qpos|"
    r"closed|closedness|open|openness|value|values|axis|angle|axisangle|rotvec|joints?|motor"
)


@dataclass(frozen=True)
class Column:
    """A column of numbers: its width per step, and the names of the numbers if the data set has them."""

    width: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Pose:
    """Columns and numbers that probably are the measured pose, and how they are written."""

    columns: tuple[str, ...]
    rotation: RotationFormat
    why: str
    is_guess: bool
    select: tuple[int, ...] | None = None
    gripper: tuple[str, int] = ("", 0)  # column, and index of the number in it
    why_rotation: str = ""
    is_rotation_guess: bool = False
    position_unit: Literal["m", "cm", "mm"] = "m"
    why_unit: str = ""  # empty: the names say so, or it is metres

    def knobs(self, gripper: Knobs) -> Knobs:
        """Return the keys of a config section that read this pose."""
        names = {} if self.select is None else {"select": Knob(list(self.select), self.why, self.is_guess)}
        unit = Knob(self.position_unit, self.why_unit, is_guess=bool(self.why_unit))
        return {
            "state": Knob(list(self.columns), self.why, self.is_guess),
            **names,
            "rotation": Knob(self.rotation, self.why_rotation, self.is_rotation_guess),
            **({} if self.position_unit == "m" else {"position_unit": unit}),
            **gripper,
        }


@dataclass(frozen=True)
class _Number:
    """One number of a column, and what its name says."""

    column: str
    index: int
    name: str
    kind: Kind
    axis: str = ""  # within its kind: x, y, z, w, a digit, roll, pitch, yaw
    rest: str = ""  # of its name
    unit: str = ""
    is_named: bool = True  # False: recognised by the width of its column

    @cached_property
    def _tokens(self) -> list[str]:
        tokens = f"{_words(self.column)}_{self.rest}".split("_")
        return [token for token in dict.fromkeys(tokens) if token and not _NEUTRAL.fullmatch(token)]

    @property
    def group(self) -> str:
        """The part of its name that tells arms apart; empty: nothing does."""
        return "_".join(self._tokens)

    @property
    def is_commanded(self) -> bool:
        """Whether it is a target rather than a measurement."""
        return any(map(_COMMANDED.fullmatch, self._tokens))


@dataclass(frozen=True)
class _Candidate:
    """The numbers of one arm."""

    group: str
    position: tuple[_Number, ...]
    rotation: tuple[_Number, ...]
    gripper: _Number
    why: str  # how they were recognised
    is_guess: bool

    @property
    def numbers(self) -> tuple[_Number, ...]:
        return (*self.position, *self.rotation, self.gripper)


def find_pose(
    columns: Mapping[str, Column], samples: Samples | None = None, *, control_rate_hz: float = 10.0
) -> Pose | None:
    """Return where the measured pose probably is: by DROID's columns, by names of numbers, or by widths.

    Args:
        columns: All columns of numbers.
        samples: The numbers of some episodes, against which the names are checked; None: not read.
        control_rate_hz: Control steps per second.
    """
    measured = measured_columns(columns)
    droid = [next((name for name in measured if re.split(r"[./]", name)[-1] == end), "") for end in DROID_STATE]
    if all(droid) and [columns[name].width for name in droid] == [6, 1]:
        return Pose(tuple(droid), "euler_xyz", "called as DROID's columns", is_guess=False, gripper=(droid[1], 0))
    samples = samples or {}
    numbers = [number for name, one in measured.items() for number in _numbers_of(name, one, samples.get(name, ()))]
    candidates = list(_candidates(numbers, measured))
    if not candidates:
        return None
    chosen = min(candidates, key=_rank)
    return _judged(chosen, _left_out(chosen, numbers), measured, samples, control_rate_hz)


def measured_columns(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Return the columns that may hold a measured pose: no commands, joints or velocities."""
    return {name: one for name, one in columns.items() if not _NO_STATE.search(name)}


# ---- what each number is ----


def _words(name: str) -> str:
    """Return a name in lower case with single underscores between its words: ee.gripperPos is ee_gripper_pos."""
    return re.sub(r"[^a-z0-9]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()).strip("_")


def _numbers_of(column: str, one: Column, samples: Sequence[Numbers]) -> Iterator[_Number]:
    if len(one.names) == one.width and (one.width > 1 or not _GRIPPER.search(column)):
        if not _names_disagree(one, samples):
            yield from (number for index, name in enumerate(one.names) if (number := _named(column, index, name)))
            return
    elif one.names and any(map(_JOINT.search, one.names)):
        return
    yield from _by_width(column, one.width, samples)


def _named(column: str, index: int, name: str) -> _Number | None:
    words = _words(name)
    unit = next(iter(_UNIT_AT_END.findall(words)), "")
    words = _UNIT_AT_END.sub("", words) or words
    if _GRIPPER.search(words):
        return _Number(column, index, name, "gripper", rest=words.rstrip("_0123456789"))
    if _NO_POSE.search(words):
        return None
    for kind, pattern in _PARTS:
        if match := re.search(pattern, words):
            kind = "degrees" if kind == "euler" and unit.startswith("deg") else kind
            return _Number(column, index, name, kind, match[1], words[: match.start()], unit)
    return None


def _by_width(column: str, width: int, samples: Sequence[Numbers]) -> Iterator[_Number]:
    """Yield the numbers of a column without usable names: their order is the usual one for this width."""
    words = re.split(r"[./]", column)[-1].lower()
    kinds: list[tuple[Kind, str]] = []
    if _GRIPPER.search(words):
        kinds = [("gripper", "")] if width <= 2 else []
    elif width == 3 and re.search(r"euler|rpy", words):
        kinds = [("euler", axis) for axis in "xyz"]
    elif width == 3 and re.search(r"axis_?angle|axang|rot_?vec|rvec", words):
        kinds = [("rotation_vector", axis) for axis in "xyz"]
    elif width in {3, 4} and re.search(r"quat|rot|ori|angle", words):
        kinds = [("rotation" if width == 3 else "quaternion", axis) for axis in "0123"[:width]]
    elif width == 3 and re.search(r"pos|xyz|trans", words):
        kinds = [("position", axis) for axis in "xyz"]
    elif width in {6, 7, 8} and _POSE.search(column):
        kinds = [("position", axis) for axis in "xyz"]
        has_quaternion = width == 8 if not samples else width > 6 and _are_unit(samples, slice(3, 7))
        if not samples and width == 7 and not words.endswith("state"):
            has_quaternion = True
        kinds += [("quaternion", axis) for axis in "0123"] if has_quaternion else [("rotation", axis) for axis in "012"]
        kinds += [("gripper", "")] * (width > len(kinds))
    for index, (kind, axis) in enumerate(kinds):
        yield _Number(column, index, f"{column}[{index}]", kind, axis, is_named=False)


def _names_disagree(one: Column, samples: Sequence[Numbers]) -> bool:
    """Return whether names promise a quaternion and the numbers are not of length 1."""
    named = [number for index, name in enumerate(one.names) if (number := _named("", index, name))]
    groups: dict[str, list[int]] = {}
    for number in named:
        if number.kind in {"quaternion", "rotation"} and number.axis in {"x", "y", "z", "w"}:
            groups.setdefault(number.group, []).append(number.index)
    return any(len(places) == 4 and samples and not _are_unit(samples, places) for places in groups.values())


def _are_unit(samples: Sequence[Numbers], places: slice | list[int]) -> bool:
    lengths = np.linalg.norm(np.concatenate(list(samples))[:, places], axis=1)
    return bool((abs(lengths - 1) < 0.01).mean() > 0.9)


# ---- which numbers belong together ----


def _candidates(numbers: Sequence[_Number], columns: Mapping[str, Column]) -> Iterator[_Candidate]:
    grippers = [number for number in numbers if number.kind == "gripper"]
    for group in dict.fromkeys(number.group for number in numbers):
        members = [number for number in numbers if number.group == group]
        for position in _triples(members, "position"):
            column = position[0].column
            rotations = [one for kind in _ROTATIONS for one in _rotations(members, kind)]
            rotations.sort(key=lambda one: one[0].column != column)
            near = [one for one in grippers if one.group == group] or [one for one in grippers if one.group == ""]
            near = near or (grippers if len(grippers) == 1 else [])
            near = sorted(near, key=lambda one: one.column != column)
            if rotations and near:
                used = (*position, *rotations[0], near[0])
                is_named = all(one.is_named for one in used)
                why = f"by the names {', '.join(one.name for one in used)}" if is_named else _WHY_BY_WIDTH
                if any(columns[one.column].names and not one.is_named for one in used):
                    why = "the names promise a quaternion, and the numbers are not of length 1; read by width"
                is_stray = near[0].group not in {group, ""}
                yield _Candidate(group, position, rotations[0], near[0], why, not is_named or is_stray)


_ROTATIONS: tuple[Kind, ...] = ("euler", "degrees", "quaternion", "rotation_vector", "rotation")


def _triples(members: Sequence[_Number], kind: Kind) -> Iterator[tuple[_Number, ...]]:
    """Yield the three numbers of a kind in the order of their axes, for each column."""
    for column in dict.fromkeys(number.column for number in members):
        inside = {one.axis: one for one in reversed(members) if one.column == column and one.kind == kind}
        for axes in _AXES:
            if all(axis in inside for axis in axes):
                yield tuple(inside[axis] for axis in axes)
                break


def _rotations(members: Sequence[_Number], kind: Kind) -> Iterator[tuple[_Number, ...]]:
    """Yield the numbers of rotations of a kind; with a w, r or rot names four numbers of a quaternion."""
    for column in dict.fromkeys(number.column for number in members):
        inside = [one for one in members if one.column == column]
        of_kind = {one.axis: one for one in reversed(inside) if one.kind == kind}
        w = next((one for one in inside if one.axis == "w"), None)
        is_quaternion = w is not None and kind in {"quaternion", "rotation"} and {"x", "y", "z"} <= of_kind.keys()
        if w is not None and is_quaternion:
            yield (of_kind["x"], of_kind["y"], of_kind["z"], replace(w, kind="quaternion"))
        elif kind == "quaternion":
            digits = sorted(axis for axis in of_kind if axis.isdigit())
            if len(digits) == 4:
                yield tuple(of_kind[axis] for axis in digits)
        else:
            yield from _triples(inside, kind)


def _rank(candidate: _Candidate) -> tuple[bool, bool, bool, int]:
    """Return what decides between candidates: measured, named, without the name of an arm, few columns."""
    columns = {number.column for number in candidate.numbers}
    is_commanded = any(number.is_commanded for number in candidate.numbers)
    is_named = all(number.is_named for number in candidate.numbers)
    return is_commanded, not is_named, bool(candidate.group), len(columns)


def _left_out(chosen: _Candidate, numbers: Sequence[_Number]) -> list[str]:
    """Return the names of numbers that belong to another arm, to commands, or are called like a chosen one."""
    others = {one.group for one in numbers if one.kind == "position"} - {chosen.group}
    columns = {one.column for one in chosen.numbers}
    taken = {(one.column, one.index) for one in chosen.numbers}
    again = [one for one in numbers if one.kind == "position" and one.group == chosen.group and one.column in columns]
    is_repeated = any((one.column, one.index) not in taken for one in again)
    return [
        one.name
        for one in numbers
        if one.group in others or (is_repeated and one.column in columns and (one.column, one.index) not in taken)
    ]


# ---- how the numbers are written ----


def _judged(
    chosen: _Candidate, left_out: Sequence[str], columns: Mapping[str, Column], samples: Samples, control_rate_hz: float
) -> Pose:
    """Return the pose of the chosen numbers, with formats checked against the samples."""
    used = tuple(dict.fromkeys(number.column for number in chosen.numbers))
    starts = dict(zip(used, np.cumsum([0, *(columns[name].width for name in used)]).tolist(), strict=False))
    select = tuple(starts[number.column] + number.index for number in chosen.numbers)
    is_whole = select == tuple(range(sum(columns[name].width for name in used)))
    rotation, why_rotation, is_guess = _format(chosen, samples, control_rate_hz)
    unit, why_unit = _position_unit(chosen, samples)
    why, is_commanded = chosen.why, any(number.is_commanded for number in chosen.numbers)
    if left_out:
        shown = ", ".join(left_out[:8]) + (", …" if len(left_out) > 8 else "")
        why += f"; left out: {shown}. For all numbers of the robot: states: vector"
    if is_commanded:
        why += "; these are commanded values, measured ones were not found"
    return Pose(
        columns=used,
        rotation=rotation,
        why=why,
        is_guess=chosen.is_guess or bool(left_out) or is_commanded,
        select=None if is_whole else select,
        gripper=(chosen.gripper.column, chosen.gripper.index),
        why_rotation=why_rotation,
        is_rotation_guess=is_guess,
        position_unit=unit,
        why_unit=why_unit,
    )


def _values(numbers: Sequence[_Number], samples: Samples) -> list[Numbers]:
    """Return the finite sampled values of some numbers for each episode; empty if a column was not read."""
    if any(number.column not in samples for number in numbers):
        return []
    series = [[episode[:, number.index] for episode in samples[number.column]] for number in numbers]
    episodes = [np.stack(episode, axis=1) for episode in zip(*series, strict=True)]
    return [finite for one in episodes if len(finite := one[np.isfinite(one).all(axis=1)])]


def _usual_size(values: Sequence[Numbers]) -> float:
    """Return the size that 95 % of the steps do not exceed, so that single wrong values do not count."""
    return float(np.quantile(np.concatenate([abs(one).max(axis=1) for one in values]), 0.95)) if values else 0.0


def _format(chosen: _Candidate, samples: Samples, control_rate_hz: float) -> tuple[RotationFormat, str, bool]:
    """Return the rotation's format, why, and whether that is a guess."""
    kind, values = chosen.rotation[-1].kind, _values(chosen.rotation, samples)
    if kind == "quaternion":
        if chosen.rotation[-1].axis == "w":
            return "quaternion_xyzw", "", False
        return "quaternion_xyzw", "w last; the numbers cannot tell it from quaternion_wxyz (w first)", True
    named: dict[Kind, RotationFormat] = {"rotation_vector": "rotation_vector", "degrees": "euler_xyz_degrees"}
    proposed = named.get(kind, "euler_xyz")
    is_guess, why = kind == "rotation", ""
    if is_guess:  # UR robots write rotation vectors as rx, ry, rz; Euler angles are more often called roll, pitch, yaw
        is_r = re.search(r"(?:^|_)r[xyz]$", _words(chosen.rotation[0].name)) is not None
        proposed, other = ("rotation_vector", "euler_xyz") if is_r else ("euler_xyz", "rotation_vector")
        why = f"or {other}: the names fit both"
    if not values:
        return proposed, f"{why}; the numbers were not read" if is_guess else why, is_guess
    largest = _usual_size(values)
    if proposed != "euler_xyz_degrees" and largest > ANGLE_RAD:
        return "euler_xyz_degrees", f"the numbers reach {largest:.0f}, which is too much for radians", is_guess
    values = [one[abs(one).max(axis=1) <= max(largest, ANGLE_RAD)] for one in values]
    smoother = smoother_format(rotation_speeds(values, control_rate_hz), proposed, _MAX_RAD_S)
    if smoother is not None and smoother != proposed:
        name = f"{smoother} moves much more smoothly than {proposed}"
        return smoother, f"{name}, which the names say" if not is_guess else name, True
    return proposed, why, is_guess


def _position_unit(chosen: _Candidate, samples: Samples) -> tuple[Literal["m", "cm", "mm"], str]:
    """Return the unit of the position, and why if that is a guess: no arm reaches 5 m, or 2.5 m in centimetres."""
    named: dict[str, Literal["m", "cm", "mm"]] = {"m": "m", "cm": "cm", "mm": "mm"}
    if (unit := chosen.position[0].unit) in named:
        return named[unit], ""
    largest = _usual_size(_values(chosen.position, samples))
    if largest <= REACH_M:
        return "m", ""
    return ("mm" if largest > 100 * REACH_M / 2 else "cm"), f"the numbers reach {largest:.0f}, too much for metres"


# ---- the gripper ----


def gripper_knobs(name: str, ranges: tuple[float, float] | None) -> Knobs:
    """Return which values are open and closed, by the range of the gripper's numbers and its name.

    Args:
        name: What the data set calls its number.
        ranges: The least and the greatest value; None: not known.
    """
    opened, closed, why = 0.0, 1.0, "the range of its numbers is not known"
    if ranges is not None:
        low, high = ranges
        why = f"its numbers range from {low:.3g} to {high:.3g}"
        largest = max(abs(low), abs(high))
        if 0 < largest <= _METRES:
            opened, closed, why = round(high if high > -low else low, 4), 0.0, f"{why}: probably metres"
        elif high <= _UNIT and low < -0.5:
            opened, closed, why = -1.0, 1.0, f"{why}: probably -1 open, 1 closed"
        elif high > _UNIT:
            opened, closed, why = round(high, 1), max(0.0, round(low, 1)), f"{why}: probably a width or percent"
    is_named = bool(re.search("open", name, re.I)) != bool(re.search("close", name, re.I))
    if (opened, closed) == (0.0, 1.0) and re.search("open", name, re.I) and is_named:
        opened, closed = 1.0, 0.0
    is_certain = is_named and {opened, closed} == {0.0, 1.0} and ranges is not None
    if is_certain:
        return {"gripper_open": Knob(opened, f"by the name {name}"), "gripper_closed": Knob(closed)}
    why = f"{why}; `data check CONFIG --model RUN_OR_MODEL` tests whether it is inverted"
    return {"gripper_open": Knob(opened, why, is_guess=True), "gripper_closed": Knob(closed, "likewise", is_guess=True)}


def range_in(samples: Samples, column: str, number: int) -> tuple[float, float] | None:
    """Return the least and the greatest sampled value of a number; None: the column was not read."""
    values = [one[:, number] for one in samples.get(column, ())]
    return (float(min(map(np.nanmin, values))), float(max(map(np.nanmax, values)))) if values else None
