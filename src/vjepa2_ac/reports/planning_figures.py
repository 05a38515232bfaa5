"""Plots for planning: a decision, and the goals of a demonstration."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.patches import Rectangle

from vjepa2_ac.data.transforms import crop_box
from vjepa2_ac.errors import counted
from vjepa2_ac.media.figure import (
    BLUE,
    FRAME_KINDS,
    GREY,
    ORANGE,
    RED,
    FrameKind,
    add_title,
    save_figure,
    show_with_border,
)
from vjepa2_ac.planning.decision import PlanResult, summarize
from vjepa2_ac.spaces import POSE

if TYPE_CHECKING:  # not imported at run time: each plot needs only one of these packages
    from vjepa2_ac.evaluation.imagined import ImaginedPlan
    from vjepa2_ac.goals.make_goals import DemonstrationGoals
    from vjepa2_ac.planning.planner import Plan

PLAN_IMAGE, GOALS_IMAGE = "plan.png", "goals.png"

_FRAME = "#e8b10c"
_WIDTH, _ROW, _ROW_OF_IMAGINED = 9.2, 2.6, 1.8  # inches
_MOST_NUMBERS = 8  # largest number of curves for a vector
_ACROSS = 4  # goal images per row
_MOST_GOALS = 3  # largest number of goals in the plot of a plan: the first ones, and the last
_STAR: dict[str, Any] = {"marker": "*", "s": 150, "color": RED, "edgecolors": "white", "zorder": 5}


def plot_plan(answer: PlanResult, path: Path, imagined: ImaginedPlan | None = None) -> Path:
    """Write the plot of a decision as a PNG file, atomically.

    Args:
        answer: The decision.
        path: The file.
        imagined: Decoded predicted frames of the plan; None: not decoded.
    """
    rows: list[tuple[float, Callable[[Any, PlanResult], None]]] = [(_ROW, _pictures)]
    if imagined is not None:
        rows.append((_ROW_OF_IMAGINED, partial(_imagined, imagined=imagined)))
    if (plan := answer.decision.plan) is not None:
        rows.append((_ROW, partial(_search, plan=plan)))
        if answer.slices:
            rows.append((_ROW, _slices))
    heights = [height for height, _ in rows]
    with save_figure(path, _WIDTH, 0.5 + sum(heights), dpi=130) as figure:
        add_title(
            figure, summarize(answer).partition(". ")[0]
        )  # the motion only; the search is described on the console
        parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, (_, draw) in zip(parts, rows, strict=True):
            draw(part, answer)
    return path


def _pictures(part: Any, answer: PlanResult) -> None:
    goals = [goal.image for goal in answer.request.goals]
    shown = sorted({*range(len(goals))[: _MOST_GOALS - 1], len(goals) - 1})
    named = {"start": answer.request.start}
    named |= {f"goal {place + 1} of {len(goals)}" if len(goals) > 1 else "goal": goals[place] for place in shown}
    for axes, (name, picture) in zip(part.subplots(1, len(named), squeeze=False)[0], named.items(), strict=True):
        axes.imshow(picture)
        if answer.request.mask is not None and name != "start":
            hidden = np.where(answer.request.mask > 0, np.nan, 1.0)
            axes.imshow(hidden, cmap="gray", vmin=0, vmax=2, alpha=0.6)
        box = crop_box(picture.shape[0], picture.shape[1], answer.controller.crop)
        corner = box.left - 0.5, box.top - 0.5
        axes.add_patch(Rectangle(corner, box.width, box.height, fill=False, color=_FRAME, linewidth=1.2))
        axes.set_title(f"{name} (frame: what the model sees)")
        axes.set_axis_off()


def _imagined(part: Any, answer: PlanResult, imagined: ImaginedPlan) -> None:
    """Draw the start, the predicted frames and the goal from left to right, framed in the colours of image strips."""
    panels: list[tuple[str, FrameKind, np.ndarray]] = [("start, decoded", "decoded", imagined.start)]
    for step, image in imagined.steps.items():
        is_last = step == answer.space.steps
        panels.append((f"imagined end\n(step {step})" if is_last else f"imagined,\nstep {step}", "predicted", image))
    panels += [("goal, decoded", "decoded", imagined.decoded_goal), ("goal", "recorded", imagined.goal)]
    for axes, (title, kind, image) in zip(part.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        show_with_border(axes, image, kind)
        axes.set_title(title, color=FRAME_KINDS[kind][0], fontsize=8)
    note = "Imagined from the start and the plan's actions alone: what the model predicts, no evidence that it happens."
    part.supxlabel(note, fontsize=8, color=GREY, x=0.01, ha="left")


def _search(part: Any, answer: PlanResult, plan: Plan) -> None:
    elites, heights, energies, path = part.subplots(1, 4)
    colours = mpl.colormaps["viridis"](np.linspace(0.9, 0.0, len(plan.iterations)))
    factor = answer.state_space.display_factor
    first, upper = answer.actions[0] * factor, answer.space.upper[0].double().numpy() * factor
    shown = answer.controller.display_axes  # with fewer than three components one is shown twice
    across, up, third = shown[0], shown[min(1, len(shown) - 1)], shown[-1]
    for number, (one, colour) in enumerate(zip(plan.iterations, colours, strict=True), start=1):
        tried = one.elites[:, 0].double().numpy() * factor
        elites.scatter(tried[:, across], tried[:, up], s=9, color=colour, alpha=0.8)
        heights.scatter(np.full(len(tried), number), tried[:, third], s=9, color=colour, alpha=0.8)
    _plane(elites, answer, across, up)
    elites.set(title="Best of each iteration,\nfirst action (dark: last)")
    heights.axhspan(-upper[third], upper[third], color=GREY, alpha=0.12, linewidth=0)
    heights.scatter(len(plan.iterations) + 1, first[third], **_STAR)
    for axes in (heights, energies):  # integer ticks, since the axis counts iterations
        axes.xaxis.get_major_locator().set_params(integer=True)
    title = "Their height" if answer.state_space.is_pose else "Another number"
    heights.set(title=title, xlabel="iteration (star: chosen)", ylabel=_label(answer, third))
    _energies(energies, answer, plan)
    _path(path, answer)


def _plane(axes: Any, answer: PlanResult, across: int, up: int) -> None:
    """Draw the limits of two components of the first action, and the chosen action."""
    factor = answer.state_space.display_factor
    width, height = (answer.space.upper[0, axis].item() * factor for axis in (across, up))
    corner = -width, -height
    axes.add_patch(Rectangle(corner, 2 * width, 2 * height, fill=False, color=GREY, linewidth=1))
    axes.margins(0.08)
    axes.scatter(answer.actions[0, across] * factor, answer.actions[0, up] * factor, **_STAR)
    axes.set(xlabel=_label(answer, across), ylabel=_label(answer, up), aspect="equal")


def _label(answer: PlanResult, axis: int) -> str:
    name = answer.state_space.change_names[axis]
    return f"{name} ({unit})" if (unit := answer.state_space.display_unit) else name


def _energies(axes: Any, answer: PlanResult, plan: Plan) -> None:
    numbers = np.arange(1, len(plan.iterations) + 1)
    elites, lowest = ([getattr(one, kind) for one in plan.iterations] for kind in ("elite_energy", "lowest"))
    axes.plot(numbers, elites, "o-", color=BLUE, markersize=3, label="mean of the best")
    axes.plot(numbers, lowest, "o--", color=BLUE, markersize=3, label="lowest")
    levels = {
        "now": (answer.decision.current_energy, GREY, "-"),
        "zero action": (answer.zero_action_energy, GREY, ":"),
        "the plan": (plan.energy, RED, "--"),
    }
    for name, (level, colour, dashes) in levels.items():
        if np.isfinite(level):
            axes.axhline(level, color=colour, linestyle=dashes, label=f"{name}: {level:.4f}")
    axes.set(title="Energy", xlabel="iteration", ylabel=f"energy ({answer.controller.config.energy.distance.name})")
    axes.legend(fontsize=7)


def _path(axes: Any, answer: PlanResult) -> None:
    space = answer.state_space
    way = (answer.states - answer.states[0]) * answer.state_space.display_factor
    if not space.is_pose:
        for number in answer.space.free[:_MOST_NUMBERS].tolist():
            axes.plot(way[:, number], "o-", markersize=4, label=space.names[number])
        axes.set(title="Planned states", xlabel="model step", ylabel="change from now")
    else:
        axes.plot(way[:, 0], way[:, 1], "o-", color=RED, markersize=4, label="x, y")
        axes.plot(way[:, 0], way[:, 2], "s:", color=BLUE, markersize=4, label="x, z")
        axes.plot(0, 0, "o", color="black", markersize=6, zorder=6)
        reach = 1.2 * max(float(np.abs(way[:, space.position]).max()), 1.0)
        axes.set(xlabel="x from here (cm)", xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axes.set_title("Planned path of the flange,\nrobot base frame")
    axes.legend(fontsize=7, handlelength=1.2)


def _slices(part: Any, answer: PlanResult) -> None:
    lowest = min(np.nanmin(one.energy) for one in answer.slices)
    highest = max(np.nanmax(one.energy) for one in answer.slices)
    factor, all_axes = answer.state_space.display_factor, part.subplots(1, len(answer.slices))
    for axes, one in zip(all_axes, answer.slices, strict=True):
        colours = {"shading": "nearest", "cmap": "viridis", "vmin": lowest, "vmax": highest}
        image = axes.pcolormesh(one.across * factor, one.up * factor, one.energy, **colours)
        axes.plot(0, 0, "+", color="white", markersize=9)
        _plane(axes, answer, *one.axes)
        axes.set_title("\n")
    all_axes[0].set_title("Energy around the first action\n(star; +: no motion; box: limits)")
    part.colorbar(image, ax=list(all_axes), label="energy", shrink=0.85)


def plot_goals(made: DemonstrationGoals, path: Path) -> Path:
    """Write the contact sheet of goals as a PNG file, atomically."""
    images = [made.first, *(goal.image for goal in made.goals)]
    rows = -(-len(images) // _ACROSS)
    states = made.states
    heights = [2.0 * rows] if states is None else [2.0 * rows, 1.4]
    options = made.options
    how = f"one every {options.every} frames" if options.by == "every" else "where the gripper changes or the arm stops"
    count = counted(len(made.goals), "goal")
    with save_figure(path, _WIDTH, 0.5 + sum(heights), dpi=130) as figure:
        add_title(figure, f"{count}, {how} ({options.stride} frames per model step)")
        sheet, *parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
        for place, axes in enumerate(sheet.subplots(rows, _ACROSS, squeeze=False).flat):
            axes.set_axis_off()
            if place < len(images):
                axes.imshow(images[place])
                axes.set_title(_caption(made, place), fontsize=8)
        if states is not None:
            axes = parts[0].subplots()
            for key in made.keys:
                axes.axvline(key.frame, color=GREY, linewidth=0.8, linestyle=":")
            axes.plot(states[:, POSE.gripper], color=ORANGE, linewidth=1.3)
            axes.set(title="Gripper: 0 open, 1 closed", ylim=(-0.05, 1.05), xlim=(0, made.frames - 1))
            axes.locator_params(axis="x", integer=True)
    return path


def _caption(made: DemonstrationGoals, place: int) -> str:
    if not place:
        return "start, frame 0"
    goal, key = made.goals[place - 1], made.keys[place - 1]
    steps = f"{counted(goal.at_least, 'model step')} or more"
    if goal.at_most is not None:
        steps = f"{goal.at_least} to {counted(goal.at_most, 'model step')}"
    lines = [f"goal {place}: {goal.name}" if goal.name else f"goal {place}", f"frame {key.frame}, {steps}"]
    lines.append(f"gripper {goal.gripper or 'as in planning.limits'}")
    return "\n".join(lines)
