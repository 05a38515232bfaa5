"""Goal images, the rules for switching from one goal to the next, and folders of goals (goals.json with images).

Such a folder is written by `vjepa2-ac goals` or by hand. PyTorch is not imported.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.media.images import encode_png, read_image, require_contrast, require_image
from vjepa2_ac.storage.files import folder_writer
from vjepa2_ac.storage.structured import format_json, parse_record, read_json_object

GOALS_FILE = "goals.json"
REACHED = 1e-6  # the energy of an image equal to the goal image, up to rounding

GripperMode = Literal["rounded", "free", "held", "open", "close"]


@dataclass(frozen=True, eq=False)
class SubGoal:
    """A goal image, how long it applies, and the gripper mode for this time.

    Raises:
        InputError: The numbers contradict each other.
    """

    image: np.ndarray  # RGB, height x width x 3, uint8; the controller checks it
    name: str = ""
    at_least: int = 1  # model steps
    at_most: int | None = None  # model steps; None: no bound. The last goal must have none
    share: float | None = (
        None  # reached when energy < share x energy at the start of the goal; None: only `at_most` ends it
    )
    gripper: GripperMode | None = None  # None: planning.limits.gripper_mode

    def __post_init__(self) -> None:
        where = f"goal {self.name!r}" if self.name else "goal"
        if self.at_least < 1 or (self.at_most is not None and self.at_most < self.at_least):
            problem = f"at least {self.at_least} and at most {self.at_most} steps"
            raise InputError(where=where, found=problem, needed="1 <= at_least <= at_most")
        if self.share is not None and not 0.0 < self.share < 1.0:
            raise InputError(where=where, found=f"share {self.share}", needed="a number between 0 and 1, or none")

    def explain_reached(self, energy: float, initial_energy: float) -> str:
        """Return why the goal is reached at an energy; empty: not reached.

        `initial_energy` is the energy at the start of the goal.
        """
        if self.share is None:
            return ""
        if energy < self.share * initial_energy:
            return f"energy {energy:.4g} is below {self.share:.0%} of {initial_energy:.4g}"
        return "the image equals the goal's" if energy <= REACHED else ""


def split_horizon(horizon: int, goals: int) -> tuple[int, ...]:
    """Return equal durations, in model steps, for all goals of a plan except the last."""
    return (max(1, horizon // goals),) * (goals - 1)


def make_timed_goals(images: Sequence[np.ndarray], durations: Sequence[int]) -> tuple[SubGoal, ...]:
    """Return goals that apply for fixed numbers of model steps; the last goal has no duration.

    Raises:
        ValueError: No images, or the number of durations is not the number of images minus one, or one is below 1.
    """
    if not images or len(durations) != len(images) - 1 or min(durations, default=1) < 1:
        raise ValueError(
            f"{len(images)} goals with durations {durations}; expected one duration per goal except the last"
        )
    first = [SubGoal(image, at_least=steps, at_most=steps) for image, steps in zip(images, durations, strict=False)]
    return (*first, SubGoal(images[-1]))


def require_goal_ends(goals: Sequence[SubGoal], *, first: int = 0) -> None:
    """Refuse goals without an end (neither `at_most` nor `share`), or a last goal with a bound.

    Args:
        goals: The goals in order.
        first: Number of the first goal in messages.

    Raises:
        InputError: A goal has no end, or the last goal has a bound.
    """
    *all_but_last, last = goals
    for number, goal in enumerate(all_but_last, start=first):
        if goal.at_most is None and goal.share is None:
            raise InputError(where=f"goal {number}", found="a goal without an end", needed="at_most or share")
    if last.at_most is not None:
        problem = f"at_most {last.at_most} for the last goal, which has no next goal"
        raise InputError(where=f"goal {len(all_but_last) + first}", found=problem, needed="null (no bound)")


@dataclass(frozen=True)
class GoalProgress:
    """The goal that applies at a decision, and the step at which it began. The index never decreases.

    Source of the rule: zcczhang/UVD @ e7d657a, uvd/envs/evaluator/inference_wrapper.py: energy relative to the energy
    at the beginning of the sub-goal, within bounds on the number of steps.
    """

    goal_index: int
    start_step: int  # model step, counted from the reset, at which the goal began
    initial_energy: float  # energy of the image at `start_step`
    changed: str = ""  # why the goal changed, or why the last goal is reached; empty: nothing changed
    is_done: bool = False  # whether the last goal has been reached

    def advance(self, goals: Sequence[SubGoal], step: int, energy: Callable[[int], float]) -> GoalProgress:
        """Return the progress at a later decision: the same goal, or the next one.

        Args:
            goals: The goals in order. Only the energy rule can end the last goal.
            step: Number of model steps since the reset.
            energy: Returns the energy of the current image for the goal with a given index.
        """
        goal, steps, unchanged = goals[self.goal_index], step - self.start_step, replace(self, changed="")
        if self.is_done or steps < goal.at_least:
            return unchanged
        current_energy, is_last = energy(self.goal_index), self.goal_index == len(goals) - 1
        why = goal.explain_reached(current_energy, self.initial_energy)
        if not why and goal.at_most is not None and steps >= goal.at_most and not is_last:
            why = f"the limit of {counted(goal.at_most, 'step')} is reached, at energy {current_energy:.4g}"
            if self.initial_energy > 0 and math.isfinite(current_energy):
                why += f", {current_energy / self.initial_energy:.0%} of {self.initial_energy:.4g}"
        if not why:
            return unchanged
        name = f"Goal {self.goal_index + 1} ({goal.name})" if goal.name else f"Goal {self.goal_index + 1}"
        text = f"{name}, after {counted(steps, 'step')}: {why}."
        if is_last:
            return replace(self, changed=text, is_done=True)
        return GoalProgress(self.goal_index + 1, step, energy(self.goal_index + 1), text)


@dataclass(frozen=True)
class GoalEntry:
    """The entry of one goal in goals.json; only `file` is required."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    file: str  # PNG or JPEG, in the folder
    name: str = ""
    at_least: int = 1
    at_most: int | None = None
    share: float | None = None
    gripper: GripperMode | None = None
    frame: int | None = None  # index of the frame in the demonstration
    began: float | None = None  # written by older versions; not used


@dataclass(frozen=True)
class _GoalsFile:
    format: Literal[1]  # incremented when readers of the file must change
    goals: Annotated[list[GoalEntry], Field(min_length=1, max_length=256)]
    noise: dict[str, Any] | None = None  # written by older versions; not used
    origin: dict[str, Any] = field(default_factory=dict)


def read_goal_folder(folder: Path) -> tuple[SubGoal, ...]:
    """Read the goals of a folder.

    Raises:
        InputError: goals.json is missing or invalid; or an image is not in the folder, has no contrast, cannot be read,
            or differs in size from the first image.
    """
    path, needed = folder / GOALS_FILE, f"the {GOALS_FILE} that `vjepa2-ac goals` writes"
    content = parse_record(_GoalsFile, read_json_object(path, needed=needed), where=str(path), needed=needed)
    goals: list[SubGoal] = []
    for number, entry in enumerate(content.goals, start=1):
        image_path = _resolve_image_path(entry, folder, where=f"{path}: goal {number}")
        image = read_image(image_path)
        require_image(image, where=str(image_path), like=goals[0].image if goals else None)
        require_contrast([image], where=str(image_path))
        try:
            goals.append(SubGoal(image, entry.name, entry.at_least, entry.at_most, entry.share, entry.gripper))
        except InputError as error:
            raise InputError(where=f"{path}: goal {number}", found=error.found, needed=error.needed) from None
    return tuple(goals)


def _resolve_image_path(entry: GoalEntry, folder: Path, *, where: str) -> Path:
    """Return the path of a goal's image; refuse paths outside the folder, since goals.json may be untrusted.

    Raises:
        InputError: The path is outside the folder, or has control characters.
    """
    name, root = Path(entry.file), os.path.realpath(folder)
    is_local = entry.file.isprintable() and not name.is_absolute() and ".." not in name.parts
    if not is_local or not Path(os.path.realpath(folder / name)).is_relative_to(
        root
    ):  # a symbolic link may lead outside
        raise InputError(
            where=where, found=f"the file {entry.file!r}", needed="a printable path to a file in the folder"
        )
    return folder / name


def write_goals(
    folder: Path,
    goals: Sequence[SubGoal],
    *,
    frames: Sequence[int | None] = (),
    origin: Mapping[str, Any] | None = None,
) -> Path:
    """Write goals into a folder, all or none, and return the path of its goals.json.

    Args:
        folder: A new folder, or a folder without goals.json; its other files are kept.
        goals: The goals in order.
        frames: Index of each goal's frame in the demonstration; empty: unknown.
        origin: The source of the goals, as plain values.

    Raises:
        InputError: The folder cannot be written.
        ValueError: No goals.
    """
    if not goals:
        raise ValueError("no goals")
    none = [None] * len(goals)
    with folder_writer(folder, GOALS_FILE) as temporary_folder:
        entries = []
        for number, (goal, frame) in enumerate(zip(goals, frames or none, strict=True), start=1):
            name = f"goal_{number}.png"
            (temporary_folder / name).write_bytes(encode_png(goal.image))
            rule = (goal.name, goal.at_least, goal.at_most, goal.share, goal.gripper)
            entries.append(GoalEntry(name, *rule, frame))
        content = _GoalsFile(1, entries, origin=dict(origin or {}))
        (temporary_folder / GOALS_FILE).write_text(format_json(asdict(content)))
    return folder / GOALS_FILE
