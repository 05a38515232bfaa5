"""The contact sheet of goals: the start and every goal, and gripper and energy on the way of the demonstration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac.demonstrations.key_frames import GRIPPER
from vjepa2_ac.demonstrations.make_goals import EnergyCourse, MadeGoals
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.reports.figures.page import BLUE, GREY, ORANGE, RED, headline, written_figure

GOALS_IMAGE = "goals.png"

_ACROSS = 6  # images in a row
_NAME = 70  # characters of a recording's name, its end


def plot_goals(made: MadeGoals, path: Path) -> Path:
    """Write the contact sheet of goals as PNG; it is written atomically."""
    images = [made.first, *(goal.image for goal in made.goals)]
    rows = -(-len(images) // _ACROSS)
    drawn: list[tuple[Callable[..., None], Any]] = [(_gripper, made.recording.states), (_energy, made.course)]
    plots = [(draw, given) for draw, given in drawn if given is not None]
    heights = [2.8 * rows, *(1.8 for _ in plots)]
    with written_figure(path, 13.0, 0.5 + sum(heights)) as figure:
        headline(figure, _title(made))
        sheet, *parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
        for place, axes in enumerate(sheet.subplots(rows, _ACROSS, squeeze=False).flat):
            axes.set_axis_off()
            if place < len(images):
                axes.imshow(images[place])
                axes.set_title(_caption(made, place), fontsize=8)
        for part, (draw, given) in zip(parts, plots, strict=True):
            axes = part.subplots()
            draw(axes, made, given)
            for key in made.keys:
                axes.axvline(key.frame, color=GREY, linewidth=0.8, linestyle=":")
            axes.set_xlim(0, made.recording.frames - 1)
            axes.locator_params(axis="x", integer=True)
    return path


def _title(made: MadeGoals) -> str:
    how = f"every {made.options.every} frames" if made.options.by == "every" else f"by {made.options.by}"
    count = f"{len(made.goals)} goal{'s' * (len(made.goals) > 1)}"
    name = made.recording.name if len(made.recording.name) <= _NAME else f"…{made.recording.name[-_NAME:]}"
    return f"{count}, {how}; {made.options.stride} frames are a model step. Of {name}"


def _caption(made: MadeGoals, place: int) -> str:
    if not place:
        return "the start, frame 0"
    goal, key = made.goals[place - 1], made.keys[place - 1]
    lines = [f"goal {place}: {goal.name}" if goal.name else f"goal {place}", f"frame {key.frame}, {_bounds(goal)}"]
    lines.append(f"gripper {goal.gripper or 'as planning.limits say'}")
    if made.course is not None:
        lines.append(f"energy {made.course.began[place - 1]:.3g} at its beginning")
    return "\n".join(lines)


def _bounds(goal: SubGoal) -> str:
    if goal.at_most is None:
        return f"{goal.at_least} model steps or more"
    return f"{goal.at_least} to {goal.at_most} model steps"


def _gripper(axes: Any, _: MadeGoals, states: Float[np.ndarray, "frames 7"]) -> None:
    axes.plot(states[:, GRIPPER], color=ORANGE, linewidth=1.3)
    axes.set(title="Gripper: 0 open, 1 closed", ylim=(-0.05, 1.05))


def _energy(axes: Any, made: MadeGoals, course: EnergyCourse) -> None:
    axes.plot(course.frames, course.energy, color=BLUE, linewidth=1.3, label="energy to the goal that applies")
    begins = [0, *(key.frame for key in made.keys)]
    for begin, end, goal, began in zip(begins, begins[1:], made.goals, course.began, strict=False):
        if goal.share is not None:
            label = "its threshold" if goal is made.goals[0] else None
            axes.plot([begin, end], [goal.share * began] * 2, color=ORANGE, linewidth=1.1, label=label)
    if made.noise is not None:
        axes.axhline(made.noise.energy, color=RED, linewidth=1.0, linestyle="--", label="noise of a resting arm")
    axes.set(title="Energy along the demonstration", xlabel="frame", ylim=(0, None))
    axes.legend(fontsize=7, loc="upper right", ncols=3)
