"""A folder of goals: goals.json and an image for each, as `vjepa2-ac goals` writes them, or a person."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import encode_png, read_image
from vjepa2_ac.planning.goals import GripperMode, SubGoal
from vjepa2_ac.planning.input_checks import require_image
from vjepa2_ac.storage import unreadable
from vjepa2_ac.storage.files import folder_writer
from vjepa2_ac.storage.structured import json_text, read_json_object, record_of

logger = logging.getLogger(__name__)

GOALS_FILE = "goals.json"

Energy = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


@dataclass(frozen=True)
class GoalEntry:
    """What goals.json says of one goal; all but its file may be left out."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    file: str  # PNG or JPEG, in the folder
    name: str = ""
    at_least: int = 1
    at_most: int | None = None
    share: float | None = None
    gripper: GripperMode | None = None
    frame: int | None = None  # of the demonstration
    began: Energy | None = None  # energy of the key frame before, or of the first frame, to this one


@dataclass(frozen=True)
class NoiseFloor:
    """The energy between frames of a resting arm: what camera and encoder cannot tell apart."""

    energy: Energy
    pairs: int  # of frames
    encoder: str  # SHA-256 of its weights: energies of another one mean something else
    distance: str  # as planning.energy.distance


@dataclass(frozen=True)
class _GoalsFile:
    format: Literal[1]  # goes up when a reader of the file would have to change
    goals: Annotated[list[GoalEntry], Field(min_length=1, max_length=256)]
    noise: NoiseFloor | None = None
    origin: dict[str, Any] = field(default_factory=dict)


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
        InputError: There is no goals.json, it says something else, or a file is no image of the first one's size.
    """
    path, needed = folder / GOALS_FILE, f"the {GOALS_FILE} that `vjepa2-ac goals` writes"
    try:
        values = read_json_object(path, needed=needed)
    except OSError as error:
        raise unreadable(str(path), error, needed=needed) from None
    found = record_of(_GoalsFile, values, where=str(path), needed=needed)
    goals: list[SubGoal] = []
    for place, entry in enumerate(found.goals, start=1):
        image = read_image(folder / entry.file)
        require_image(image, where=str(folder / entry.file), like=goals[0].image if goals else None)
        try:
            goals.append(SubGoal(image, entry.name, entry.at_least, entry.at_most, entry.share, entry.gripper))
        except InputError as error:
            raise InputError(where=f"{path}: goal {place}", found=error.found, needed=error.needed) from None
    frames, began = tuple(entry.frame for entry in found.goals), tuple(entry.began for entry in found.goals)
    return GoalFolder(tuple(goals), frames, began, found.noise, found.origin)


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
            name = f"goal_{place}.png"
            (filling / name).write_bytes(encode_png(goal.image))
            bounds = (goal.name, goal.at_least, goal.at_most, goal.share, goal.gripper)
            entries.append(GoalEntry(name, *bounds, frame, energy))
        content = _GoalsFile(1, entries, noise, dict(origin or {}))
        (filling / GOALS_FILE).write_text(json_text(asdict(content)))
    return folder / GOALS_FILE
