"""The contact sheet of goals: the start and every goal, and gripper and energy on the way of the demonstration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.demonstrations.key_frames import GRIPPER
from vjepa2_ac.demonstrations.make_goals import EnergyCourse, MadeGoals
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.reports.figures.page import BLUE, GREY, ORANGE, RED, Page, written_page

GOALS_IMAGE = "goals.png"

_WIDTH, _SIDE, _HEAD, _TEXT, _PLOT, _FOOT = 13.0, 0.4, 0.55, 0.75, 1.3, 0.45  # inches, as all below
_ACROSS, _GAP, _MOST = 6, 0.12, 2.4  # images in a row, the space between them, and the highest one
_NAME = 70  # characters of a recording's name, its end


def plot_goals(made: MadeGoals, path: Path) -> Path:
    """Write the contact sheet of goals as PNG; it is written atomically."""
    images = [made.first, *(goal.image for goal in made.goals)]
    slot = (_WIDTH - 2 * _SIDE + _GAP) / _ACROSS
    height, width = made.first.shape[:2]
    tall = min((slot - _GAP) * height / width, _MOST)
    rows, plots = -(-len(images) // _ACROSS), _plots(made)
    top = _HEAD + rows * (tall + _TEXT)
    total = top + len(plots) * (_PLOT + _FOOT) + 0.2
    with written_page(path, _WIDTH, total, dpi=100, style={"font.size": 8}, facecolor="white") as page:
        page.headline(_title(made))
        for place, image in enumerate(images):
            left, down = _SIDE + place % _ACROSS * slot, _HEAD + place // _ACROSS * (tall + _TEXT)
            _image(page, image, (left, down, min(slot - _GAP, tall * width / height), tall))
            page.text(left, down + tall + 0.05, _caption(made, place), size=8)
        for number, draw in enumerate(plots):
            axes = page.axes(_SIDE + 0.3, top + number * (_PLOT + _FOOT), _WIDTH - 2 * _SIDE - 0.3, _PLOT)
            draw(axes, made)
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


def _image(page: Page, image: UInt8[np.ndarray, "height width 3"], place: tuple[float, float, float, float]) -> None:
    axes = page.axes(*place)
    axes.set_axis_off()
    axes.imshow(image, interpolation="nearest" if len(image) < 100 else "bilinear")


def _plots(made: MadeGoals) -> list[Any]:
    drawn: list[Any] = []
    if made.recording.states is not None:
        drawn.append(_gripper)
    if made.course is not None:
        drawn.append(_energy)
    return drawn


def _gripper(axes: Any, made: MadeGoals) -> None:
    if made.recording.states is not None:
        axes.plot(made.recording.states[:, GRIPPER], color=ORANGE, linewidth=1.3)
    axes.set(title="Gripper: 0 open, 1 closed", ylim=(-0.05, 1.05))


def _energy(axes: Any, made: MadeGoals) -> None:
    course: EnergyCourse | None = made.course
    if course is None:
        return
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
