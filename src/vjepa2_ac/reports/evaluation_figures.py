"""Plots of an evaluation (error by horizon, sensitivity to actions, landscapes, example clips) and of a comparison."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.evaluation.result import (
    ACTIONS,
    PERSISTENCE,
    Curve,
    DecodedStrip,
    Evaluation,
    Example,
    Landscapes,
    one_step_over_persistence,
    over_persistence,
)
from vjepa2_ac.media.figure import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    FrameKind,
    RolloutStrip,
    StripRow,
    add_title,
    colour_errors,
    draw_rows,
    replace_hidden_characters,
    save_figure,
)
from vjepa2_ac.reports.comparison import Comparison

_COLOURS = {"base": ORANGE, "adapter": BLUE, "model": BLUE}
_RUN_COLOURS = (BLUE, ORANGE, GREEN, "#8f5bb0", RED, "#0b7f8a", "#8a6d0b", "#333333")
_LINE_STYLES = ("-", "--", ":")  # each style is used with all colours before the next style
_FURTHER_COLOURS = ("#3a9155", "#8f5bb0", "#b0873a", "#4aa3a8")
_PERSISTENCE = "persistence (copy the last frame)"
_GREY_PX = 224  # width and height of the grey image that replaces missing frames


def plot_evaluation(evaluation: Evaluation, path: Path) -> Path:
    """Write the plot of an evaluation as a PNG file, atomically."""
    with save_figure(path, 9.2, 4.9, dpi=150) as figure:
        add_title(figure, replace_hidden_characters(evaluation.title)[-80:])
        left, right = figure.subfigures(1, 2, width_ratios=[4, 5], wspace=0.02)
        upper, lower = left.subfigures(2, 1, height_ratios=[3, 2])
        draw_errors(upper, evaluation)
        draw_sensitivity(lower, evaluation)
        if evaluation.decoded is not None and evaluation.decoded.strips:
            draw_rows(right, decoded_strip(evaluation, evaluation.decoded.strips[0]))
        elif evaluation.examples:
            draw_rows(right, example_strip(evaluation, evaluation.examples[0]))
    return path


def plot_comparison(comparison: Comparison, path: Path) -> Path:
    """Write the curves of several runs as a PNG file, atomically."""
    styles = itertools.cycle({"linestyle": style, "color": colour} for style in _LINE_STYLES for colour in _RUN_COLOURS)
    with save_figure(path, 9.2, 4.7, dpi=130) as figure:
        axes = figure.subplots()
        drawn = _draw_curves(axes, comparison.seconds, zip(comparison.curves.values(), styles, strict=False))
        axes.set(title=f"{comparison.title} (band: 95 % over episodes)", ylabel="L1 error / persistence")
        axes.set_ylim(0, None)
        names = [_PERSISTENCE, *(textwrap.fill(replace_hidden_characters(name), 34) for name in comparison.curves)]
        figure.legend(drawn, names, loc="outside right upper")
    return path


Draw = Callable[[Any, Evaluation], None]  # draws an evaluation on a Matplotlib figure


def evaluation_plots(evaluation: Evaluation) -> Iterator[tuple[str, str, tuple[float, float], Draw]]:
    """Yield the part of the page, the description, the size in inches, and the draw function of each plot."""
    yield "errors", "Open-loop L1 error relative to persistence by horizon", (6.4, 3.6), draw_errors
    yield (
        "actions",
        "One-step L1 error relative to persistence with true, zero and shuffled actions",
        (6.4, 3.0),
        draw_sensitivity,
    )
    if clips := _select_landscape_clips(evaluation):
        rows = len(clips) * (2 if evaluation.base and evaluation.models[evaluation.base].landscapes else 1)
        described = "Energy around the true action: cross; lowest energy: ring"
        yield "landscapes", described, (9.0, 2.6 * rows), _draw_landscapes


def draw_errors(figure: Any, evaluation: Evaluation) -> None:
    """Draw the error of each model relative to persistence, by horizon."""
    axes = figure.subplots()
    curves = {name: over_persistence(model.errors, "rollout") for name, model in evaluation.models.items()}
    seconds = evaluation.about.seconds_per_step * np.arange(1, evaluation.horizon + 1)
    drawn = _draw_curves(
        axes, seconds, [(curves[name], {"color": colour}) for name, colour in _assign_colours(curves).items()]
    )
    shown = seconds[:: -(-len(seconds) // 8)]
    axes.set_xticks(shown, [f"{value:.2f}" for value in shown])
    axes.legend(drawn, [_PERSISTENCE, *map(_shorten, curves)], loc="best")
    axes.set(title="L1 error by horizon, lower is better (band: 95 % CI)", ylabel="L1 error / persistence")
    axes.set_ylim(0, None)


def draw_sensitivity(figure: Any, evaluation: Evaluation) -> None:
    """Draw the one-step error of each model with true, zero and shuffled actions."""
    axes = figure.subplots()
    width = 0.8 / len(evaluation.models)
    for index, (name, colour) in enumerate(_assign_colours(evaluation.models).items()):
        ratios = [one_step_over_persistence(evaluation.models[name].errors, actions) for actions in ACTIONS]
        positions = np.arange(len(ratios)) + (index - (len(evaluation.models) - 1) / 2) * width
        bars = np.array([(ratio.value - ratio.low, ratio.high - ratio.value) for ratio in ratios]).T
        bars = np.nan_to_num(bars.clip(min=0))  # rounding could make them negative; NaN: there is no interval
        style = {"color": colour, "error_kw": {"elinewidth": 1}, "label": _shorten(name)}
        axes.bar(positions, [ratio.value for ratio in ratios], width, yerr=bars, **style)
    axes.axhline(1.0, color=GREY, linestyle="--")
    axes.set_ylim(0, 1.3 * axes.get_ylim()[1])  # room for the legend
    axes.legend(loc="upper left", ncols=min(len(evaluation.models), 3))
    axes.set_xticks(range(len(ACTIONS)), ACTIONS)
    axes.set(
        title="One-step error with other actions (bars: 95 % CI)", xlabel="actions", ylabel="L1 error / persistence"
    )


def _draw_landscapes(figure: Any, evaluation: Evaluation) -> None:
    """Draw slices of the energy through the true action, for the base and the evaluated model on up to three clips."""
    drawn = {
        name: model.landscapes
        for name, model in evaluation.models.items()
        if model.landscapes and name in {evaluation.base, evaluation.trained}
    }
    clips = _select_landscape_clips(evaluation)
    grid = figure.subplots(len(clips) * len(drawn), 3, squeeze=False)
    for row, (clip, (name, landscapes)) in zip(grid, itertools.product(clips, drawn.items()), strict=True):
        for axes, (first, second) in zip(row, itertools.combinations(range(3), 2), strict=True):
            mesh = _draw_plane(axes, landscapes, clip, first, second)
        figure.colorbar(mesh, ax=list(row), label="energy (L1)")
        row[0].set_title(f"{_shorten(name)}, clip {clip + 1}", loc="left")


def _select_landscape_clips(evaluation: Evaluation) -> list[int]:
    """Return the indices of the clips with the nearest, the median and the farthest energy minimum."""
    landscapes = evaluation.models[evaluation.trained].landscapes
    if landscapes is None:
        return []
    order = sorted(range(len(landscapes.maps)), key=lambda clip: landscapes.maps[clip].distance)
    return sorted({0: order[0], 1: order[len(order) // 2], 2: order[-1]}.values())


def _draw_plane(axes: Any, landscapes: Landscapes, clip: int, first: int, second: int) -> Any:
    """Draw the energy over two components of the action, and return the mesh for the colour bar."""
    landscape = landscapes.maps[clip]
    third = ({0, 1, 2} - {first, second}).pop()
    energy = np.take(landscape.energy, int(np.abs(landscape.axes[third] - landscape.true[third]).argmin()), axis=third)
    limits = {"vmin": float(landscape.energy.min()), "vmax": float(landscape.energy.max())}
    mesh = axes.pcolormesh(
        landscape.axes[first], landscape.axes[second], energy.T, shading="gouraud", rasterized=True, **limits
    )
    axes.axhline(0, color="white", linewidth=0.6, linestyle=":")
    axes.axvline(0, color="white", linewidth=0.6, linestyle=":")
    axes.plot(landscape.true[first], landscape.true[second], "+", color="white", markersize=9, markeredgewidth=2)
    axes.plot(
        landscape.minimum[first], landscape.minimum[second], "o", color="white", markerfacecolor="none", markersize=10
    )
    unit = f" ({landscapes.unit})" if landscapes.unit else ""
    axes.set(xlabel=landscapes.axis_names[first] + unit, ylabel=landscapes.axis_names[second] + unit)
    return mesh


def example_strip(evaluation: Evaluation, example: Example) -> RolloutStrip:
    """Return the image strip of an example clip: the frames, and the errors of each model as colours over them."""
    num_frames = 1 + len(example.errors[PERSISTENCE])
    frames = np.full((num_frames, _GREY_PX, _GREY_PX, 3), 128, np.uint8) if example.frames is None else example.frames
    max_error = max(float(errors.max()) for errors in example.errors.values())
    rows = [] if example.frames is None else [StripRow("ground truth", "recorded", frames)]
    for name, errors in example.errors.items():
        images = [_overlay(frame, patches, max_error) for frame, patches in zip(frames, (None, *errors), strict=True)]
        captions = ("", *(f"mean L1 {patches.mean():.3f}" for patches in errors))
        rows.append(StripRow(f"error of {_shorten(name)}", "error", np.stack(images), captions))
    seconds = tuple(time * evaluation.about.seconds_per_step for time in range(len(frames)))
    return RolloutStrip(
        f"{replace_hidden_characters(example.why)[:80]}: from control step {example.start}", tuple(rows), seconds
    )


def decoded_strip(evaluation: Evaluation, strip: DecodedStrip) -> RolloutStrip:
    """Return the image strip of an example clip with decoded images."""
    labels: dict[str, tuple[str, FrameKind]] = {
        "truth": ("ground truth", "recorded"),
        "decoded_truth": ("ground truth,\ndecoded", "decoded"),
    }
    rows = []
    for name, frames in strip.rows.items():
        kind: FrameKind = "predicted_base" if name == evaluation.base else "predicted"
        label, kind = labels.get(name, (f"prediction of\n{_shorten(name)}", kind))
        rows.append(StripRow(label, kind, np.ascontiguousarray(frames)))
    times = range(len(rows[0].frames))
    title = f"{replace_hidden_characters(strip.why)[:80]}: control step {strip.start}"
    return RolloutStrip(title, tuple(rows), tuple(time * evaluation.about.seconds_per_step for time in times))


def _overlay(
    frame: UInt8[np.ndarray, "height width 3"], errors: Float[np.ndarray, "grid grid"] | None, max_error: float
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the errors of patches, interpolated between patch centres, as colours over a greyscale frame."""
    grey = np.repeat(frame.mean(axis=-1, keepdims=True), 3, axis=-1)
    if errors is None:
        return grey.astype(np.uint8)
    smooth = _interpolate(_interpolate(errors, frame.shape[0]).T, frame.shape[1]).T
    return np.asarray(0.35 * grey + 0.65 * colour_errors(smooth, frame.shape[:2], max_error)).astype(np.uint8)


def _interpolate(errors: Float[np.ndarray, "rows columns"], size: int) -> Float[np.ndarray, "size columns"]:
    """Interpolate linearly between the centres of patches along the first axis, to `size` pixels."""
    centres, pixels = (np.arange(len(errors)) + 0.5) * size / len(errors), np.arange(size) + 0.5
    return np.stack([np.interp(pixels, centres, column) for column in errors.T], axis=1)


def _draw_curves(axes: Any, seconds: np.ndarray, curves: Iterable[tuple[Curve, dict[str, str]]]) -> list[Any]:
    """Draw persistence and the curves with their intervals, and return the lines for the legend."""
    drawn = [axes.axhline(1.0, color=GREY, linestyle="--")]
    for curve, style in curves:
        low, high = [point.low for point in curve], [point.high for point in curve]
        axes.fill_between(seconds, low, high, color=style["color"], alpha=0.15, linewidth=0)
        drawn += axes.plot(seconds, [point.value for point in curve], marker="o", **style)
    axes.set(xlabel="time ahead (s)")
    return drawn


def _assign_colours(names: Iterable[str]) -> dict[str, str]:
    """Return a colour for each model."""
    further_colours = itertools.cycle(_FURTHER_COLOURS)
    return {name: _COLOURS.get(name) or next(further_colours) for name in names}


def _shorten(name: str) -> str:
    """Return the last 48 characters of a name, wrapped for a legend."""
    return textwrap.fill(replace_hidden_characters(name)[-48:], 24)
