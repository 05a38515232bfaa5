"""Plot a decision of the planner, and the goals of a demonstration."""

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

_INPUT_COLOUR = "#e8b10c"
_WIDTH, _ROW, _PREDICTED_ROW = 9.2, 2.6, 1.8  # inches
_MAX_CURVES = 8  # maximum number of curves for a vector
_IMAGES_PER_ROW = 4
_MAX_GOALS = 3  # maximum number of goals in the plot of a plan: the first goals, and the last goal
_STAR: dict[str, Any] = {"marker": "*", "s": 150, "color": RED, "edgecolors": "white", "zorder": 5}


def plot_plan(result: PlanResult, path: Path, imagined: ImaginedPlan | None = None) -> Path:
    """Write the plot of a decision as a PNG file, atomically.

    Args:
        result: The decision.
        path: The file.
        imagined: Decoded predicted frames of the plan; None: not decoded.
    """
    rows: list[tuple[float, Callable[[Any, PlanResult], None]]] = [(_ROW, _draw_images)]
    if imagined is not None:
        rows.append((_PREDICTED_ROW, partial(_draw_predicted_frames, imagined=imagined)))
    if (plan := result.decision.plan) is not None:
        rows.append((_ROW, partial(_draw_search, plan=plan)))
        if result.slices:
            rows.append((_ROW, _draw_slices))
    heights = [height for height, _ in rows]
    with save_figure(path, _WIDTH, 0.5 + sum(heights), dpi=130) as figure:
        motion = summarize(result).partition(". ")[0]  # the search is described on the console
        add_title(figure, motion.replace("Moves ", "Plan: ", 1))
        parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, (_, draw) in zip(parts, rows, strict=True):
            draw(part, result)
    return path


def _draw_images(part: Any, result: PlanResult) -> None:
    goals = [goal.image for goal in result.request.goals]
    shown = sorted({*range(len(goals))[: _MAX_GOALS - 1], len(goals) - 1})
    named = {"start": result.request.start}
    named |= {f"goal {index + 1} of {len(goals)}" if len(goals) > 1 else "goal": goals[index] for index in shown}
    for axes, (name, image) in zip(part.subplots(1, len(named), squeeze=False)[0], named.items(), strict=True):
        axes.imshow(image)
        if result.request.mask is not None and name != "start":
            hidden = np.where(result.request.mask > 0, np.nan, 1.0)
            axes.imshow(hidden, cmap="gray", vmin=0, vmax=2, alpha=0.6)
        box = crop_box(image.shape[0], image.shape[1], result.controller.crop)
        corner = box.left - 0.5, box.top - 0.5
        axes.add_patch(Rectangle(corner, box.width, box.height, fill=False, color=_INPUT_COLOUR, linewidth=1.2))
        axes.set_title(f"{name} (yellow frame: model input)")
        axes.set_axis_off()


def _draw_predicted_frames(part: Any, result: PlanResult, imagined: ImaginedPlan) -> None:
    """Draw the start, the predicted frames and the goal from left to right, with the border colours of image strips."""
    panels: list[tuple[str, FrameKind, np.ndarray]] = [("start, decoded", "decoded", imagined.start)]
    for step, image in imagined.steps.items():
        is_last = step == result.space.steps
        panels.append((f"predicted end\n(step {step})" if is_last else f"predicted,\nstep {step}", "predicted", image))
    panels += [("goal, decoded", "decoded", imagined.decoded_goal), ("goal", "recorded", imagined.goal)]
    for axes, (title, kind, image) in zip(part.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        show_with_border(axes, image, kind)
        axes.set_title(title, color=FRAME_KINDS[kind][0], fontsize=8)
    note = "Predicted by the model from the start and the planned actions. The robot has not executed them."
    part.supxlabel(note, fontsize=8, color=GREY, x=0.01, ha="left")


def _draw_search(part: Any, result: PlanResult, plan: Plan) -> None:
    elites, heights, energies, path = part.subplots(1, 4)
    colours = mpl.colormaps["viridis"](np.linspace(0.9, 0.0, len(plan.iterations)))
    factor = result.state_space.display_factor
    first, upper = result.actions[0] * factor, result.space.upper[0].double().numpy() * factor
    shown = result.controller.display_components  # with fewer than three components, one component is shown twice
    across, up, third = shown[0], shown[min(1, len(shown) - 1)], shown[-1]
    for number, (iteration, colour) in enumerate(zip(plan.iterations, colours, strict=True), start=1):
        first_actions = iteration.elites[:, 0].double().numpy() * factor
        elites.scatter(first_actions[:, across], first_actions[:, up], s=9, color=colour, alpha=0.8)
        heights.scatter(np.full(len(first_actions), number), first_actions[:, third], s=9, color=colour, alpha=0.8)
    _draw_plane(elites, result, across, up)
    elites.set(title="First actions of the best samples\n(dark: last iteration)")
    heights.axhspan(-upper[third], upper[third], color=GREY, alpha=0.12, linewidth=0)
    heights.scatter(len(plan.iterations) + 1, first[third], **_STAR)
    for axes in (heights, energies):  # integer ticks, since the axis counts iterations
        axes.xaxis.get_major_locator().set_params(integer=True)
    title = "Vertical component" if result.state_space.is_pose else "Another component"
    heights.set(title=title, xlabel="iteration (star: plan)", ylabel=_label(result, third))
    _draw_energies(energies, result, plan)
    _draw_path(path, result)


def _draw_plane(axes: Any, result: PlanResult, across: int, up: int) -> None:
    """Draw the limits of two components of the first action, and the chosen action."""
    factor = result.state_space.display_factor
    width, height = (result.space.upper[0, axis].item() * factor for axis in (across, up))
    corner = -width, -height
    axes.add_patch(Rectangle(corner, 2 * width, 2 * height, fill=False, color=GREY, linewidth=1))
    axes.margins(0.08)
    axes.scatter(result.actions[0, across] * factor, result.actions[0, up] * factor, **_STAR)
    axes.set(xlabel=_label(result, across), ylabel=_label(result, up), aspect="equal")


def _label(result: PlanResult, axis: int) -> str:
    name = result.state_space.change_names[axis]
    return f"{name} ({unit})" if (unit := result.state_space.display_unit) else name


def _draw_energies(axes: Any, result: PlanResult, plan: Plan) -> None:
    numbers = np.arange(1, len(plan.iterations) + 1)
    elites, lowest = ([getattr(iteration, key) for iteration in plan.iterations] for key in ("elite_energy", "lowest"))
    axes.plot(numbers, elites, "o-", color=BLUE, markersize=3, label="mean of the best samples")
    axes.plot(numbers, lowest, "o--", color=BLUE, markersize=3, label="lowest energy")
    levels = {
        "current image": (result.decision.current_energy, GREY, "-"),
        "zero action": (result.zero_action_energy, GREY, ":"),
        "plan": (plan.energy, RED, "--"),
    }
    for name, (level, colour, dashes) in levels.items():
        if np.isfinite(level):
            axes.axhline(level, color=colour, linestyle=dashes, label=f"{name}: {level:.4f}")
    axes.set(title="Energy", xlabel="iteration", ylabel=f"energy ({result.controller.config.energy.distance.name})")
    axes.legend(fontsize=7)


def _draw_path(axes: Any, result: PlanResult) -> None:
    space = result.state_space
    path = (result.states - result.states[0]) * result.state_space.display_factor
    if not space.is_pose:
        for number in result.space.free[:_MAX_CURVES].tolist():
            axes.plot(path[:, number], "o-", markersize=4, label=space.names[number])
        axes.set(title="Planned states", xlabel="model step", ylabel="change from the current state")
    else:
        axes.plot(path[:, 0], path[:, 1], "o-", color=RED, markersize=4, label="y over x")
        axes.plot(path[:, 0], path[:, 2], "s:", color=BLUE, markersize=4, label="z over x")
        axes.plot(0, 0, "o", color="black", markersize=6, zorder=6)
        reach = 1.2 * max(float(np.abs(path[:, space.position]).max()), 1.0)
        axes.set(
            xlabel="change of x (cm)",
            ylabel="change of y, z (cm)",
            xlim=(-reach, reach),
            ylim=(-reach, reach),
            aspect="equal",
        )
        axes.set_title("Planned path of the flange,\nrobot base frame")
    axes.legend(fontsize=7, handlelength=1.2)


def _draw_slices(part: Any, result: PlanResult) -> None:
    lowest = min(np.nanmin(energy_slice.energy) for energy_slice in result.slices)
    highest = max(np.nanmax(energy_slice.energy) for energy_slice in result.slices)
    factor, all_axes = result.state_space.display_factor, part.subplots(1, len(result.slices))
    for axes, energy_slice in zip(all_axes, result.slices, strict=True):
        colours = {"shading": "nearest", "cmap": "viridis", "vmin": lowest, "vmax": highest}
        image = axes.pcolormesh(energy_slice.across * factor, energy_slice.up * factor, energy_slice.energy, **colours)
        axes.plot(0, 0, "+", color="white", markersize=9)
        _draw_plane(axes, result, *energy_slice.components)
        axes.set_title("\n")
    all_axes[0].set_title("Energy around the first action\n(star: plan; +: zero action; box: limits)")
    part.colorbar(image, ax=list(all_axes), label="energy", shrink=0.85)


def plot_goals(demonstration: DemonstrationGoals, path: Path) -> Path:
    """Write the images of all goals and the gripper position as a PNG file, atomically."""
    images = [demonstration.first, *(goal.image for goal in demonstration.goals)]
    rows = -(-len(images) // _IMAGES_PER_ROW)
    states = demonstration.states
    heights = [2.0 * rows] if states is None else [2.0 * rows, 1.4]
    options = demonstration.options
    selection = (
        f"one every {options.every} frames" if options.by == "every" else "where the gripper changes or the arm stops"
    )
    count = counted(len(demonstration.goals), "goal")
    with save_figure(path, _WIDTH, 0.5 + sum(heights), dpi=130) as figure:
        add_title(figure, f"{count}, {selection} ({options.stride} frames per model step)")
        sheet, *parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
        for index, axes in enumerate(sheet.subplots(rows, _IMAGES_PER_ROW, squeeze=False).flat):
            axes.set_axis_off()
            if index < len(images):
                axes.imshow(images[index])
                axes.set_title(_caption(demonstration, index), fontsize=8)
        if states is not None:
            axes = parts[0].subplots()
            for key in demonstration.keys:
                axes.axvline(key.frame, color=GREY, linewidth=0.8, linestyle=":")
            axes.plot(states[:, POSE.gripper], color=ORANGE, linewidth=1.3)
            axes.set(title="Gripper: 0 open, 1 closed", ylim=(-0.05, 1.05), xlim=(0, demonstration.frames - 1))
            axes.locator_params(axis="x", integer=True)
    return path


def _caption(demonstration: DemonstrationGoals, index: int) -> str:
    if index == 0:
        return "start, frame 0"
    goal, key = demonstration.goals[index - 1], demonstration.keys[index - 1]
    steps = f"{counted(goal.at_least, 'model step')} or more"
    if goal.at_most is not None:
        steps = f"{goal.at_least} to {counted(goal.at_most, 'model step')}"
    lines = [f"goal {index}: {goal.name}" if goal.name else f"goal {index}", f"frame {key.frame}, {steps}"]
    lines.append(f"gripper {goal.gripper or 'as in planning.limits'}")
    return "\n".join(lines)
