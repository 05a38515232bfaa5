"""A folder of goals: goals.json and an image for each. Read from people, so nothing in it is trusted."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_file import decode_image, encode_png
from vjepa2_ac.planning.goals.sub_goals import GripperMode, SubGoal
from vjepa2_ac.planning.input_checks import require_image
from vjepa2_ac.storage import read_bounded, unreadable
from vjepa2_ac.storage.structured import json_text, read_json_object, record_of, shown
from vjepa2_ac.storage.writing import folder_writer

logger = logging.getLogger(__name__)

GOALS_FILE = "goals.json"
FORMAT = 1  # goes up when a reader of the file would have to change

_MOST_GOALS, _MOST_STEPS, _MOST_BYTES = 256, 100_000, 1 << 20
_MOST_IMAGE_BYTES, _MOST_MEMORY = 64 << 20, 1 << 30  # of a file, and of all pixels
_IMAGES = (".png", ".jpg", ".jpeg")
_KEYS = ("format", "goals", "noise", "origin")

Steps = Annotated[int, Field(ge=1, le=_MOST_STEPS)]
Energy = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


@dataclass(frozen=True)
class GoalEntry:
    """What goals.json says of one goal; all but its file may be left out."""

    file: Annotated[str, Field(min_length=1, max_length=200)]
    name: Annotated[str, Field(max_length=200)] = ""
    at_least: Steps = 1
    at_most: Steps | None = None
    share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    gripper: GripperMode | None = None
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None  # of the file; null: not compared
    frame: Annotated[int, Field(ge=0)] | None = None  # of the demonstration
    began: Energy | None = None  # energy of the key frame before, or of the first frame, to this one


@dataclass(frozen=True)
class NoiseFloor:
    """The energy between frames of a resting arm: what camera and encoder cannot tell apart."""

    energy: Energy
    pairs: Annotated[int, Field(ge=1)]  # of frames
    encoder: str  # SHA-256 of its weights: energies of another one mean something else
    distance: str  # as planning.energy.distance


@dataclass(frozen=True, eq=False)
class GoalFolder:
    """Goals as they were written, with what is known of their demonstration."""

    goals: tuple[SubGoal, ...]
    frames: tuple[int | None, ...]  # of the demonstration
    began: tuple[float | None, ...]  # energy of each goal at its beginning, in the demonstration
    noise: NoiseFloor | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)

    def for_model(self, encoder: str, distance: str) -> tuple[SubGoal, ...]:
        """Return the goals with the noise floor, below which no threshold lies, if it was measured with this encoder.

        What is changed or cannot be known is logged as a warning.

        Args:
            encoder: SHA-256 of its weights.
            distance: As planning.energy.distance.
        """
        noise, uses_shares = self.noise, any(goal.share is not None for goal in self.goals)
        if noise is None:
            return self.goals
        if (noise.encoder, noise.distance) != (encoder, distance):
            if uses_shares:
                found = f"{noise.distance} and encoder {noise.encoder[:8]}, not {distance} and encoder {encoder[:8]}"
                logger.warning("the noise floor of these goals is of %s: it does not guard their thresholds", found)
            return self.goals
        for place, (goal, began) in enumerate(zip(self.goals, self.began, strict=True), start=1):
            if goal.share is not None and began is not None and goal.share * began < noise.energy:
                logger.warning(
                    "goal %d: %.0f%% of energy %.4g is below the noise of a resting arm, %.4g: that is its threshold",
                    place, 100 * goal.share, began, noise.energy,
                )  # fmt: skip
        return tuple(replace(goal, floor=noise.energy) for goal in self.goals)


def read_goals(folder: Path) -> tuple[SubGoal, ...]:
    """Return the goals of a folder, in order.

    Raises:
        InputError: As `read_goal_folder`.
    """
    return read_goal_folder(folder).goals


def read_goal_folder(folder: Path) -> GoalFolder:
    """Return the goals of a folder, and what it says about them.

    Raises:
        InputError: There is no goals.json, it says something else or of another format, a file is not an image in the
            folder itself, was changed since, or is of another size than the first one.
    """
    path = folder / GOALS_FILE
    needed = f"the {GOALS_FILE} that `vjepa2-ac goals` writes"
    try:
        found = read_json_object(path, most_bytes=_MOST_BYTES, needed=needed)
    except OSError as error:
        raise unreadable(str(path), error, needed=needed) from None
    entries = _entries(found, path)
    noise, where = found.get("noise"), f"{path}: noise"
    if noise is not None:
        noise = record_of(NoiseFloor, _mapping(noise, where), where=where)
    goals: list[SubGoal] = []
    for place, entry in enumerate(entries, start=1):
        goals.append(_goal(folder, entry, f"{path}: goal {place}"))
        require_image(goals[-1].image, where=str(folder / entry.file), like=goals[0].image)
        if sum(goal.image.nbytes for goal in goals) > _MOST_MEMORY:
            too_much, needed = f"more than {_MOST_MEMORY >> 20:,} MB of pixels", "smaller images, or fewer goals"
            raise InputError(where=f"{path}: goal {place}", found=too_much, needed=needed)
    frames, began = tuple(entry.frame for entry in entries), tuple(entry.began for entry in entries)
    return GoalFolder(tuple(goals), frames, began, noise, _mapping(found.get("origin", {}), f"{path}: origin"))


def _entries(found: Mapping[str, Any], path: Path) -> list[GoalEntry]:
    if found.get("format") != FORMAT:
        fix = "Make the folder again with this version, or read it with the one that made it"
        raise InputError(where=f"{path}: format", found=shown(found.get("format")), needed=str(FORMAT), fix=fix)
    if unknown := [key for key in found if key not in _KEYS]:
        raise InputError(where=str(path), found=f"unknown: {', '.join(unknown)}", needed=", ".join(_KEYS))
    goals = found.get("goals")
    if not isinstance(goals, list) or not 1 <= len(goals) <= _MOST_GOALS:
        count = f"{len(goals)} of them" if isinstance(goals, list) else shown(goals)
        raise InputError(where=f"{path}: goals", found=count, needed=f"a list of 1 to {_MOST_GOALS} goals")
    entries = []
    for place, one in enumerate(goals, start=1):
        where = f"{path}: goal {place}"
        entries.append(record_of(GoalEntry, _mapping(one, where), where=where))
    return entries


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(where=where, found=shown(value), needed="a JSON object")
    return value


def _goal(folder: Path, entry: GoalEntry, where: str) -> SubGoal:
    image = folder / entry.file
    is_name = image.name == entry.file and not entry.file.startswith(".") and "\\" not in entry.file
    if not is_name or image.suffix.lower() not in _IMAGES:
        needed = "the name of a PNG or JPEG file in the same folder"
        raise InputError(where=where, found=shown(entry.file), needed=needed)
    if image.resolve().parent != folder.resolve():
        raise InputError(where=str(image), found="a link out of the folder", needed="the image itself")
    try:
        data = read_bounded(image, _MOST_IMAGE_BYTES)
    except OSError as error:
        raise unreadable(str(image), error, needed="an image: PNG or JPEG") from None
    if entry.sha256 is not None and hashlib.sha256(data).hexdigest() != entry.sha256:
        fix = f"Restore it; or, if you mean this one, remove its sha256 from {GOALS_FILE}"
        raise InputError(where=str(image), found="another image than was written", needed="the same bytes", fix=fix)
    pixels = decode_image(data, str(image))
    try:
        return SubGoal(pixels, entry.name, entry.at_least, entry.at_most, entry.share, entry.gripper)
    except InputError as error:
        raise InputError(where=where, found=error.found, needed=error.needed) from None


def write_goals(
    folder: Path,
    goals: Sequence[SubGoal],
    *,
    frames: Sequence[int | None] = (),
    began: Sequence[float | None] = (),
    noise: NoiseFloor | None = None,
    origin: Mapping[str, Any] | None = None,
) -> Path:
    """Write goals into a folder, whole or not at all, and return the path of its goals.json.

    Args:
        folder: A new or empty one; other files in it stay.
        goals: In order. Their noise floor is not written: it is that of `noise`.
        frames: Of the demonstration, of each goal; empty: not known.
        began: Energy of each goal at its beginning; empty: not known.
        noise: Energy between frames of a resting arm.
        origin: Where they come from, as plain values.

    Raises:
        InputError: The folder cannot be written.
        ValueError: No goals.
    """
    if not goals:
        raise ValueError("no goals")
    none = [None] * len(goals)
    with folder_writer(folder, GOALS_FILE) as filling:
        entries = []
        for place, (goal, frame, energy) in enumerate(zip(goals, frames or none, began or none, strict=True), start=1):
            data, name = encode_png(goal.image), f"goal_{place}.png"
            (filling / name).write_bytes(data)
            digest = hashlib.sha256(data).hexdigest()
            bounds = (goal.name, goal.at_least, goal.at_most, goal.share, goal.gripper)
            entries.append(asdict(GoalEntry(name, *bounds, digest, frame, energy)))
        content = {
            "format": FORMAT,
            "goals": entries,
            "noise": None if noise is None else asdict(noise),
            "origin": dict(origin or {}),
        }
        (filling / GOALS_FILE).write_text(json_text(content))
    return folder / GOALS_FILE
