"""Recognise the measured pose among the columns of a data set, by column names, widths and sampled values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from vjepa2_ac.data.poses import FORMATS, find_smoother_format, measure_rotation_speeds
from vjepa2_ac.errors import InputError
from vjepa2_ac.init.draft_values import DraftValue
from vjepa2_ac.inspection.motion import FASTEST_RAD_S
from vjepa2_ac.spaces import MAX_ANGLE_RAD, MAX_POSITION_M

Numbers = Float[np.ndarray, "steps _"]
Samples = Mapping[str, Sequence[Numbers]]  # values of some episodes, by column; columns that were not read are missing
Range = tuple[float, float]  # minimum and maximum

_NAMES_OF_DROID = ["x", "y", "z", "roll", "pitch", "yaw"]
_MAX_GRIPPER_M, _MAX_FRACTION = 0.15, 1.05  # largest gripper opening in metres, and as a fraction

_RATE_WORDS = r"vel|speed|force|torque|effort|accel|wrench|current(?!_?(?:tcp|ee|pose|cart|pos|state))"
_RATE_NAME = re.compile(_RATE_WORDS, re.I)
_NON_POSE = re.compile(rf"joint|motor|shoulder|elbow|qpos|{_RATE_WORDS}", re.I)
_NON_STATE = re.compile(r"action|timestamp|index|reward|done", re.I)
_NOT_MEASURED = re.compile(  # words of poses that are commanded, of another time, or relative
    r"target|cmd|command(ed)?|goal|desired|des|setpoint|action|ref(erence)?|prev(ious)?|last|next|delta|rel|relative|"
    r"err|error|start|init|initial|demo|leader|master"
)
_NON_HAND = re.compile(r"object|obj|cube|block|camera|cam|base|mobile|head|torso|world|tag|marker|aruco")
_HAND = re.compile(r"|left|right|l|r|(robot|arm)_?\d*")  # names of groups that certainly belong to an end effector
_POSE = re.compile(r"cartesian|ee_?f?(_|\.|$|pose|pos)|tcp|pose|state", re.I)
_GRIPPER = re.compile(r"grip|finger", re.I)

_KINDS = (  # kind of a number by the end of its name; the regex group is the axis
    ("euler_xyz", r"(?:^|_)(roll|pitch|yaw)$"),
    ("rotation_vector", r"(?:axis_?angle|axang|rot_?vec|rotation_vector|rvec)_?([xyz0-3])$"),
    ("rotation_vector", r"(?:^|_)w([xyz])$"),
    ("euler_xyz", r"(?:euler|rpy)_?([xyz0-3])$"),
    ("euler_xyz", r"(?:angles?|theta)_?([xyz])$"),  # with digits these are joints
    ("quaternion", r"(?:(?:^|_)q|quat_?|quaternion_?)([xyzw])$"),
    ("quaternion", r"(?:quat|quaternion)_?([0-4])$"),
    ("rotation", r"(?:^|_)(?:r|rot_?|rotation_?|ori_?|orient_?|orientation_?)([xyzw0-3])$"),
    ("position", r"(?:pos|position|trans|translation|xyz)_?([xyz0-3])$"),
    ("position", r"(?:^|_)(?:p_?)?([xyz])$"),
)
_NUM_AXES = {"rotation": (3, 4), "quaternion": (4,)}  # valid numbers of axes; 3 for all other kinds
_AXES = {"roll": "x", "pitch": "y", "yaw": "z"}
_UNITS = frozenset({"mm", "cm", "m", "rad", "radians", "deg", "degrees"})
_NEUTRAL = re.compile(  # parts of names that do not distinguish arms
    r"pos|position|ee|eef|end|effector|tcp|pose|rot|rotation|ori|orient|orientation|quat|quaternion|euler|rpy|state|obs|"
    r"observations?|steps|measured|actual|cartesian|robot|arm|flange|hand|tool|gripper|fingers?|width|opening|qpos|"
    r"closed|closedness|open|openness|value|values|axis|angle|axisangle|rotvec|joints?|motor"
)


@dataclass(frozen=True)
class Column:
    """A column of numbers: its width per control step, and the names of the numbers if the data set defines them."""

    width: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Number:
    """One number of a column, with the properties that its name implies."""

    column: str
    index: int
    name: str
    kind: str  # position, gripper, quaternion, rotation (names that fit several formats), or a rotation format
    axis: str = ""  # x, y, z, w or a digit
    group: str = ""  # the part of the name that distinguishes arms; may be empty
    prefix: str = ""  # the part of the name before the kind
    unit: str = ""
    is_named: bool = True  # False: recognised by the width of its column


def find_pose(
    columns: Mapping[str, Column], samples: Samples | None = None, *, control_rate_hz: float = 10.0
) -> dict[str, DraftValue] | None:
    """Return the keys of a config section that select the measured pose; None if no pose is recognised.

    Args:
        columns: All columns of numbers.
        samples: Values of some episodes, with which the interpretation of the names is checked; None: not read.
        control_rate_hz: Control steps per second.
    """
    measured, samples = select_measured_columns(columns), samples or {}
    numbers = [
        number for name, column in measured.items() for number in _find_numbers(name, column, samples.get(name, ()))
    ]
    chosen = min(_find_candidates(numbers), key=_make_sort_key, default=None)
    if chosen is None:
        return None
    keys = _make_pose_values(chosen, _list_unused(chosen, numbers), measured, samples, control_rate_hz)
    column, index = chosen[-1].column, chosen[-1].index
    names = measured[column].names
    name = names[index] if index < len(names) else _last_part(column)
    values = np.concatenate(_get_finite_values(chosen[-1:], samples) or [np.zeros((0, 1))])
    return {**keys, **guess_gripper_values(name, (float(values.min()), float(values.max())) if len(values) else None)}


def select_vector_state(columns: Mapping[str, Column], where: str) -> dict[str, DraftValue]:
    """Return the key that selects a state vector if no pose is recognised: the column named `state`, or the widest one.

    Raises:
        InputError: No column contains measured numbers of the robot.
    """
    measured = [name for name in columns if re.search(r"observation|\bstate", name)]
    if not measured:
        raise InputError(
            where=where,
            found=f"no column with measured numbers ({', '.join(columns) or 'no columns'})",
            needed="columns of the robot's state, named observation… or state, of type float, int or bool",
        )
    chosen = max(measured, key=lambda name: (_last_part(name) == "state", columns[name].width))
    reason = (
        f"no pose was recognised. This column has {columns[chosen].width} numbers. All columns: {', '.join(measured)}"
    )
    return {"state": DraftValue([chosen], reason, is_guess=True)}


def select_measured_columns(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Return the columns that may contain a measured pose or gripper: no actions, joints or velocities."""
    return {
        name: column
        for name, column in columns.items()
        if not _NON_STATE.search(name) and not (_RATE_NAME if _GRIPPER.search(name) else _NON_POSE).search(name)
    }


# ---- the kind of each number ----


def _last_part(column: str) -> str:
    return re.split(r"[./]", column)[-1]


def _to_snake_case(name: str) -> str:
    """Return a name in snake case: ee.gripperPos becomes ee_gripper_pos."""
    return re.sub(r"[^a-z0-9]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()).strip("_")


def _find_group(words: str) -> str:
    words = re.sub(r"_?(?:in|to|wrt|from)_(?:base|world|robot)(?:_frame)?", "", words)
    parts = dict.fromkeys(words.split("_"))
    return "_".join(part for part in parts if part and not _NEUTRAL.fullmatch(part))


def _find_numbers(name: str, column: Column, samples: Sequence[Numbers]) -> list[_Number]:
    """Return the numbers in a column that may be part of a pose, by their names, or else by the column's width."""
    if len(column.names) == column.width and (column.width > 1 or not _GRIPPER.search(name)):
        numbers = _parse_names(name, column.names)
        quaternions = [vector for vector in _group_axes(numbers) if len(vector) == 4]
        if not samples or all(_have_unit_norm(samples, [number.index for number in vector]) for vector in quaternions):
            return numbers
    elif any(map(_NON_POSE.search, column.names)):
        return []
    names = _propose_names(name, column.width, samples)
    is_named = len(names) == 1 or names == _NAMES_OF_DROID  # a single number is a gripper
    return [replace(number, name=f"{name}[{number.index}]", is_named=is_named) for number in _parse_names(name, names)]


def _parse_names(column: str, names: Sequence[str]) -> list[_Number]:
    """Return the numbers of a column whose names are those of a position, a rotation or a gripper."""
    numbers = []
    all_words = [_to_snake_case(name) for name in names]
    has_rates = any(re.search(r"(?:^|_)v[xyz]$", words) for words in all_words)
    has_matrix = any(re.search(r"(?:^|_)(?:r|rot|rotation)_?[4-9]$", words) for words in all_words)
    for index, (name, words) in enumerate(zip(names, all_words, strict=True)):
        head, _, unit = words.rpartition("_")
        words = head if unit in _UNITS else words
        words = f"{_to_snake_case(_last_part(column))}_{words}" if words in {"x", "y", "z", "w"} else words
        kind, axis, prefix = _parse_kind(words)
        if kind == "euler_xyz" and unit.startswith("deg"):
            kind = "euler_xyz_degrees"
        is_rate = has_rates and re.search(r"(?:^|_)w[xyz]$", words)  # next to a velocity: an angular velocity
        is_matrix_entry = has_matrix and kind == "rotation"  # six numbers of a rotation matrix
        if kind and not is_rate and not is_matrix_entry:
            group = _find_group(f"{_to_snake_case(column)}_{prefix}")
            numbers.append(_Number(column, index, name, kind, axis, group, prefix, unit))
    return numbers


def _parse_kind(words: str) -> tuple[str, str, str]:
    """Return kind, axis and prefix of a number from its name in snake case; an empty kind means no part of a pose."""
    if _GRIPPER.search(words):
        return ("", "", "") if _RATE_NAME.search(words) else ("gripper", "", words.rstrip("0123456789"))
    words = re.sub(r"_(?:pos|position)$", "", words)
    if not _NON_POSE.search(words):
        for kind, pattern in _KINDS:
            if match := re.search(pattern, words):
                return kind, _AXES.get(match[1], match[1]), words[: match.start()]
    return "", "", ""


def _propose_names(column: str, width: int, samples: Sequence[Numbers]) -> list[str]:
    """Return the usual names of the numbers in an unnamed column, from its name, width and sampled values."""
    name = _last_part(column)
    if _GRIPPER.search(name):
        return [name] if width <= 2 else []
    if width in {3, 4}:
        return [f"{name}_{index}" for index in range(width)]
    if width == 6 and name == "cartesian_position":
        return _NAMES_OF_DROID
    if width not in {6, 7, 8} or not _POSE.search(column) or re.search(r"rot|axis|euler|quat|angle", name, re.I):
        return []
    if samples:
        has_quaternion = width > 6 and _have_unit_norm(samples, [3, 4, 5, 6])
    else:
        has_quaternion = width == 8 or (width == 7 and not name.lower().endswith("state"))
    rotation = ["quat_0", "quat_1", "quat_2", "quat_3"] if has_quaternion else ["rot_0", "rot_1", "rot_2"]
    is_padded = width == 8 and len(rotation) == 3 and not any(np.ptp(episode[:, 6]) for episode in samples)
    return ["pos_0", "pos_1", "pos_2", *rotation, *["padding"] * is_padded, "gripper"][:width]


def _have_unit_norm(samples: Sequence[Numbers], indexes: list[int]) -> bool:
    """Return whether the vectors at some indexes have length 1 at 90 % of the steps, without NaN and zero vectors."""
    lengths = np.linalg.norm(np.concatenate(list(samples))[:, indexes], axis=1)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    return len(lengths) > 0 and bool((abs(lengths - 1) < 0.01).mean() > 0.9)


# ---- grouping of numbers into poses ----

_Numbers = tuple[_Number, ...]  # a candidate: position (3), rotation (3 or 4), gripper (1)


def _group_axes(numbers: Sequence[_Number]) -> Iterator[_Numbers]:
    """Yield positions and rotations: the numbers of one arm, column and kind in the order of their axes, w last."""
    vectors: dict[tuple[str, str, str, str], dict[str, _Number]] = {}
    for number in numbers:
        key = number.group, number.column, number.kind, number.prefix
        vectors.setdefault(key, {}).setdefault(number.axis, number)
    for (_, _, kind, _), by_axis in vectors.items():
        if len(by_axis) in _NUM_AXES.get(kind, (3,)):
            yield tuple(by_axis[axis] for axis in "01234xyzw" if axis in by_axis)


def _find_candidates(numbers: Sequence[_Number]) -> Iterator[_Numbers]:
    """Yield position, rotation and gripper of each arm."""
    vectors, all_grippers = list(_group_axes(numbers)), [number for number in numbers if number.kind == "gripper"]
    positions = [vector for vector in vectors if vector[0].kind == "position"]
    for position in (vector for vector in positions if not any(map(_NON_HAND.fullmatch, vector[0].group.split("_")))):
        group, column = position[0].group, position[0].column
        rotations = [vector for vector in vectors if vector[0].kind != "position" and vector[0].group == group]
        grippers = [number for number in all_grippers if number.group in {group, ""} or len(all_grippers) == 1]
        if rotations and grippers:
            rotation = min(
                rotations,
                key=lambda vector: (vector[0].column != column, _may_be_rate(vector[0]), vector[0].kind not in FORMATS),
            )
            gripper = min(grippers, key=lambda number: (number.group != group, number.column != column))
            yield (*position, *rotation, gripper)


def _may_be_rate(number: _Number) -> bool:
    """Return whether a number is named wx, wy or wz, which is an angular velocity or part of a rotation vector."""
    return re.search(r"(?:^|_)w[xyz]$", _to_snake_case(number.name)) is not None


def _make_sort_key(candidate: _Numbers) -> tuple[bool, bool, bool, int]:
    """Return a sort key that prefers measured poses, then named numbers, then no arm name, then few columns."""
    is_named = all(number.is_named for number in candidate)
    columns = {number.column for number in candidate}
    return _is_not_measured(candidate), not is_named, bool(candidate[0].group), len(columns)


def _is_not_measured(candidate: _Numbers) -> bool:
    return any(_NOT_MEASURED.fullmatch(part) for number in candidate for part in number.group.split("_"))


def _list_unused(chosen: _Numbers, numbers: Sequence[_Number]) -> list[str]:
    """Return the names of the numbers of other poses: of other arms, of commands, and in the same columns."""
    columns, group = {number.column for number in chosen}, chosen[0].group
    remaining = [
        number for number in numbers if number not in chosen and (number.group != group or number.column in columns)
    ]
    groups = {number.group for number in remaining if number.kind == "position"}
    unused = [number for number in remaining if number.group in groups]
    return [number.name if number.column in columns else f"{number.column}: {number.name}" for number in unused]


# ---- units and rotation formats ----


def _make_pose_values(
    chosen: _Numbers, unused: Sequence[str], columns: Mapping[str, Column], samples: Samples, control_rate_hz: float
) -> dict[str, DraftValue]:
    """Return the config keys that select the chosen numbers, with formats that were checked with the samples."""
    pose_columns = list(dict.fromkeys(number.column for number in chosen))
    column_numbers = [(name, index) for name in pose_columns for index in range(columns[name].width)]
    select = [column_numbers.index((number.column, number.index)) for number in chosen]
    unnamed_columns = [columns[number.column] for number in chosen if not number.is_named]
    group = chosen[0].group
    doubts = []
    names = dict.fromkeys(re.sub(r"\[\d+\]$", "", number.name) for number in chosen)
    reason = f"recognised by the names {', '.join(names)}"
    if unnamed_columns:
        reason = "recognised by the number of values, because the names do not match a quaternion"
        if not all(column.names for column in unnamed_columns):
            reason = "recognised by the number of values, which have no names"
        doubts.append("If they are joint positions, set states: vector")
    if chosen[-1].group not in {group, ""}:
        doubts.append(f"The gripper is {chosen[-1].name}")
    if _is_not_measured(chosen):
        doubts.append(f"No measured pose was found: {group or chosen[0].name} may be commanded or relative")
    elif not _HAND.fullmatch(group):
        doubts.append(f"If {group} is not the end effector, set states: vector")
    if unused:
        shown = ", ".join(unused[:8]) + (", …" if len(unused) > 8 else "")
        doubts += [f"Unused: {shown}", "To use all numbers, set states: vector"]
    reason = ". ".join([reason, *doubts])
    is_guess = bool(unnamed_columns or doubts)
    keys = {"state": DraftValue(pose_columns, reason, is_guess)}
    if select != list(range(len(column_numbers))):
        keys["select"] = DraftValue(select, "indices of the pose's numbers in the columns of state", is_guess)
    keys["rotation"] = _choose_rotation_format(chosen[3:-1], samples, control_rate_hz)
    unit = _choose_position_unit(chosen[:3], samples)
    return keys if unit.value == "m" else {**keys, "position_unit": unit}


def _get_finite_values(numbers: _Numbers, samples: Samples) -> list[Numbers]:
    """Return the finite sampled values of numbers of one column, by episode; empty if the column was not read."""
    indexes = [number.index for number in numbers]
    episodes = [episode[:, indexes] for episode in samples.get(numbers[0].column, ())]
    return [finite for episode in episodes if len(finite := episode[np.isfinite(episode).all(axis=1)])]


def _measure_magnitude(values: Sequence[Numbers]) -> float:
    """Return the 95th percentile over steps of the largest absolute value; single wrong values do not affect it."""
    return float(np.quantile(np.concatenate([abs(episode).max(axis=1) for episode in values]), 0.95)) if values else 0.0


def _choose_rotation_format(rotation: _Numbers, samples: Samples, control_rate_hz: float) -> DraftValue:
    if len(rotation) == 4:
        is_guess = rotation[-1].axis != "w"
        reason = "w is last; quaternion_wxyz (w first) is also possible" if is_guess else ""
        return DraftValue("quaternion_xyzw", reason, is_guess)
    formats = [name for name in FORMATS if name == rotation[0].kind]
    if not formats:  # UR robots write rotation vectors as rx, ry, rz; Euler angles usually are roll, pitch, yaw
        is_r = re.search(r"(?:^|_)r[xyz]$", _to_snake_case(rotation[0].name))
        formats = ["rotation_vector", "euler_xyz"] if is_r else ["euler_xyz", "rotation_vector"]
    values, proposed, is_guess = _get_finite_values(rotation, samples), formats[0], len(formats) > 1
    reason = f"{formats[1]} is also possible" if is_guess else ""
    if is_guess and not values:
        reason += ". The values were not read"
    largest = _measure_magnitude(values)
    if proposed != "euler_xyz_degrees" and largest > MAX_ANGLE_RAD:
        reason = f"the values reach {largest:.0f}, which is too large for radians"
        if proposed == "rotation_vector":
            reason += ". Rotation vectors in degrees are not supported"
        return DraftValue("euler_xyz_degrees", reason, is_guess or proposed == "rotation_vector")
    values = [episode[abs(episode).max(axis=1) <= max(largest, MAX_ANGLE_RAD)] for episode in values]
    smoother = (
        find_smoother_format(measure_rotation_speeds(values, control_rate_hz), proposed, FASTEST_RAD_S)
        if values
        else None
    )
    if smoother in {None, proposed}:
        return DraftValue(proposed, reason, is_guess)
    reason = f"as {smoother} the rotations change much more smoothly than as {proposed}"
    return DraftValue(smoother, reason if is_guess else f"{reason}, which the names suggest", is_guess=True)


def _choose_position_unit(position: _Numbers, samples: Samples) -> DraftValue:
    """Return the unit of the position, from the names or else from the largest values that an arm can reach."""
    if position[0].unit in {"m", "cm", "mm"}:
        return DraftValue(position[0].unit)
    largest = _measure_magnitude(_get_finite_values(position, samples))
    if largest <= MAX_POSITION_M:
        return DraftValue("m")
    unit = "mm" if largest > 100 * MAX_POSITION_M / 2 else "cm"
    return DraftValue(unit, f"the values reach {largest:.0f}, which is too large for metres", is_guess=True)


# ---- the gripper ----


def guess_gripper_values(name: str, value_range: Range | None) -> dict[str, DraftValue]:
    """Return the values of the open and the closed gripper, guessed from its name and the range of its values.

    Args:
        name: Name of the gripper's number in the data set.
        value_range: Minimum and maximum of the gripper's values; None: unknown.
    """
    opened, closed, reason = 0.0, 1.0, "the range of the gripper's values is unknown"
    if value_range is not None:
        low, high = value_range
        reason = f"the gripper's values range from {low:.3g} to {high:.3g}"
        if 0 < max(abs(low), abs(high)) <= _MAX_GRIPPER_M:
            opened, closed, reason = round(high if high > -low else low, 4), 0.0, f"{reason}: probably metres"
        elif high > _MAX_FRACTION:
            opened, closed, reason = round(high, 1), max(0.0, round(low, 1)), f"{reason}: probably a width or percent"
        elif low < -0.5:
            opened, closed, reason = -1.0, 1.0, f"{reason}: probably -1 open, 1 closed"
    words = set(re.findall("open|close", name.lower()))
    if len(words) == 1:
        low, high = sorted((opened, closed))
        opened, closed = (high, low) if words == {"open"} else (low, high)
        if value_range is not None and (low, high) == (0.0, 1.0):
            return {
                "gripper_open": DraftValue(opened, f"recognised by the name {name}"),
                "gripper_closed": DraftValue(closed),
            }
    reason = f"{reason}. `data check CONFIG --model RUN_OR_MODEL` detects an inverted gripper"
    return {
        "gripper_open": DraftValue(opened, reason, is_guess=True),
        "gripper_closed": DraftValue(closed, "see gripper_open", is_guess=True),
    }
