"""Report section on action use: costs of wrong actions, the rank of the true action, energy landscapes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.evaluation.estimates import cost_of_actions, one_step_over_persistence
from vjepa2_ac.evaluation.result import ACTIONS, Evaluation, Landscape, Landscapes, Ranking
from vjepa2_ac.reports.html.distributions import rank_chart
from vjepa2_ac.reports.html.formatting import NOT_MEASURED, decimal, percent
from vjepa2_ac.reports.html.heatmaps import MapAxis, heat_map
from vjepa2_ac.reports.html.layout import (
    ReportSection,
    figure,
    not_measured,
    paragraph,
    scrolling,
    share,
    side_by_side,
    table,
    value,
    why_not,
)
from vjepa2_ac.reports.html.markup import Markup, element, joined, text
from vjepa2_ac.reports.html.series import models_of

_MOST_LANDSCAPES = 3  # clips whose maps are shown


def actions_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on how predictions depend on the actions, and on the rank of the true action."""
    drawings = [_ranks(evaluation, place) for place in range(2)]
    parts = [
        paragraph(
            "A world model is of use for planning only if its prediction changes with the action, and in the right way:"
            " the true action should give the lowest energy, the L1 distance between the prediction and what really"
            " came.",
            class_="how",
        ),
        _costs(evaluation),
        _sensitivity(evaluation),
        side_by_side(*drawings),
        _axes(evaluation),
    ]
    return ReportSection("actions", "Does it use the actions?", joined(*parts))


def _axes(evaluation: Evaluation) -> Markup:
    """Return the table of the axes in which each model infers moves: before and after training."""
    measured = {name: model.axes for name, model in evaluation.models.items() if model.axes is not None}
    if not measured:
        return Markup()
    rows = [
        [
            name,
            joined(value(one.yaw_degrees, 0), " degrees"),
            value(one.error, 2),
            joined(value(one.fitted_yaw_degrees, 0), " degrees"),
            value(one.gain, 2),
            value(one.condition, 1),
            joined(value(one.residual_cm, 1), " cm"),
            "" if one.problem is None else f"not to plan by: {one.problem}",
        ]
        for name, one in measured.items()
    ]
    pairs = next(iter(measured.values())).pairs
    caption = (
        f"Calibrated axes, from {pairs} pairs of frames: the turn about the vertical at which the model predicts best,"
        " its squared error over that without a turn, and the fit of the moves that it infers to the executed ones"
        " (value [95 % interval]). Yaw 0, gain and condition 1: what it infers is what the robot did. A yaw far from 0"
        " is a camera or a mounting that it was not trained on: training turns it back, and so does planning.axes."
    )
    return table(
        caption, ["model", "yaw", "error there", "fitted yaw", "gain", "condition", "off by", ""], rows, class_="wordy"
    )


def landscape_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on energy landscapes around the true action, as maps and as numbers."""
    title = "Energy landscapes"
    measured = {name: model.landscapes for name, model in evaluation.models.items() if model.landscapes is not None}
    if not measured:
        why = why_not(evaluation, "energy landscapes", "This evaluation made none.")
        return ReportSection("landscapes", title, not_measured("Energy landscapes", why))
    shown = measured.get(evaluation.trained) or next(iter(measured.values()))
    drawn = {name: one for name, one in measured.items() if one is shown or name == evaluation.base}
    maps = [_maps(drawn, place) for place in _typical(shown.maps)]
    how = (
        "Each map tries actions along two axes while the third axis and the rest of the action are the true ones. Dark"
        " is low energy: what the model thinks was done. The cross is the true action, the ring is the minimum over"
        " the whole grid (it may be off the map, along the third axis): the closer, the better. The"
        " dotted lines are zero motion; a ring there means that the model expects too little to happen. Each clip and"
        f" model has its own range of colours. Of {len(shown.maps)} clips those with the nearest, the median and the"
        " farthest minimum are shown."
    )
    drawing = figure("Energy around the true action", element("div", *maps, class_="maps"), how)
    return ReportSection("landscapes", title, joined(_landscape_table(measured), drawing))


def _costs(evaluation: Evaluation) -> Markup:
    rows = []
    for one in models_of(evaluation):
        ratios = [value(one_step_over_persistence(one.model.errors, actions)) for actions in ACTIONS]
        costs = [share(cost_of_actions(one.model.errors, actions), with_sign=True) for actions in ACTIONS[1:]]
        rows.append([one.label, *ratios, *costs])
    head = ["model", *(f"error with {actions} actions" for actions in ACTIONS)]
    head += [f"growth of the error with {actions} actions" for actions in ACTIONS[1:]]
    caption = (
        "One-step L1 error over persistence with the true, zero and another clip's actions, and by how much a wrong"
        " action makes the error grow (value [95 % interval]; a growth of 0 % means that actions are ignored)"
    )
    return table(caption, head, rows)


def _sensitivity(evaluation: Evaluation) -> Markup:
    measured = {name: model.sensitivity for name, model in evaluation.models.items() if model.sensitivity is not None}
    if not measured:
        return not_measured(
            "Action sensitivity and ranks", why_not(evaluation, "other actions", "This evaluation left them out.")
        )
    tops = sorted({k for one in measured.values() for ranking in one.rankings for k in ranking.top})
    rows = [
        [
            *(name, value(sensitivity.change), f"{ranking.samples} {ranking.words}", value(ranking.mean_rank)),
            *(_top(ranking, k) for k in tops),
        ]
        for name, sensitivity in measured.items()
        for ranking in sensitivity.rankings
    ]
    head = ["model", "change of the prediction", "among", "mean rank of the true action"]
    head += [f"true action among the best {k}" for k in tops]
    caption = (
        "How much predictions change with the action (mean L1 distance between predictions with the true and with other"
        " actions, as a share of the persistence error; 0: not at all), and the rank of the true action among others"
        " by energy (rank 0: always first, 1: always last; by chance 0.5; value [95 % interval])"
    )
    return table(caption, head, rows, class_="wordy")


def _top(ranking: Ranking, k: int) -> Markup:
    if k not in ranking.top:
        return text(NOT_MEASURED)
    return joined(share(ranking.top[k]), f" (chance {percent(ranking.chance_of_top(k), 1)})")


def _ranks(evaluation: Evaluation, place: int) -> Markup:
    measured = [
        (one, sensitivity.rankings[place])
        for one in models_of(evaluation)
        if (sensitivity := one.model.sensitivity) is not None and place < len(sensitivity.rankings)
    ]
    if not measured:
        return Markup()
    how = (
        "In how many clips at most this share of the others has a lower energy than the true action. The curve of a"
        " model that knows what its actions do rises at once (hardly any other explains better what came); one that"
        " ignores them follows the dashed line of chance."
    )
    ranking = measured[0][1]
    return figure(f"Rank of the true action among {ranking.samples} {ranking.words}", rank_chart(measured), how)


def _landscape_table(measured: dict[str, Landscapes]) -> Markup:
    rows = []
    for name, one in measured.items():
        unit = f" {one.unit}".rstrip()
        distance = joined(value(one.distance, 2), unit)
        signs = [
            joined(share(agreement, 0), f" of {clips} clips (chance {percent(chance)})") if clips else NOT_MEASURED
            for agreement, chance, clips in zip(one.sign_agreement, one.sign_chance, one.sign_clips, strict=True)
        ]
        rows.append([name, str(len(one.maps)), distance, f"{decimal(one.chance_distance, 2)}{unit}", *signs])
    names = next(iter(measured.values())).axis_names
    head = ["model", "clips", "distance of the minimum to the true action", "by chance"]
    head += [f"right sign of {name}" for name in names]
    caption = (
        "Where the energy is lowest: mean distance to the true action, and how often the minimum has the sign of the"
        " true action along each axis, among clips that move along it (value [95 % interval])"
    )
    return table(caption, head, rows, class_="wordy")


def _typical(maps: Sequence[Landscape]) -> list[int]:
    """Return the indices of the maps with the nearest, the median and the farthest minimum."""
    order = sorted(range(len(maps)), key=lambda place: maps[place].distance)
    if len(order) <= _MOST_LANDSCAPES:
        return order
    return [order[0], order[len(order) // 2], order[-1]]


def _maps(measured: dict[str, Landscapes], place: int) -> Markup:
    """Return the maps of one clip, a row for each model."""
    parts: list[Markup] = []
    for model, landscapes in measured.items():
        if place >= len(landscapes.maps):
            continue
        one = landscapes.maps[place]
        if not parts:
            parts.append(element("h4", f"{one.episode_id}, control step {one.start}"))
        distance = f"{decimal(one.distance, 2)} {landscapes.unit}".rstrip()
        low, high = decimal(float(one.energy.min()), 4), decimal(float(one.energy.max()), 4)
        words = f": minimum {distance} from the true action; energy {low} (dark) to {high} (bright)"
        parts.append(element("p", element("strong", model), words, class_="of"))
        planes = [_plane(model, landscapes, one, first, second) for first, second in combinations(range(3), 2)]
        maps = element("div", *planes, class_="planes")
        parts.append(scrolling(maps, f"Energy maps of {model}, {one.episode_id}"))
    return element("div", *parts, class_="landscape")


def _plane(model: str, landscapes: Landscapes, one: Landscape, first: int, second: int) -> Markup:
    third = ({0, 1, 2} - {first, second}).pop()
    energy = np.take(one.energy, _nearest(one.axes[third], one.true[third]), axis=third)
    unit = f" ({landscapes.unit})" if landscapes.unit else ""
    across, up = (
        MapAxis(landscapes.axis_names[axis] + unit, one.axes[axis], float(one.true[axis]), float(one.minimum[axis]))
        for axis in (first, second)
    )
    description = (
        f"Energy of {model} over {across.label} and {up.label}: true action at {_point(one.true, first, second)},"
        f" lowest energy at {_point(one.minimum, first, second)}."
    )
    return heat_map(description, energy, across, up, (float(one.energy.min()), float(one.energy.max())))


def _nearest(values: Float[np.ndarray, " grid"], wanted: float) -> int:
    return int(np.abs(values - wanted).argmin())


def _point(place: Float[np.ndarray, " 3"], first: int, second: int) -> str:
    return f"({decimal(float(place[first]), 1)}, {decimal(float(place[second]), 1)})"
