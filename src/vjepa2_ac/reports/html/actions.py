"""Report sections on action use: costs of wrong actions, the rank of the true action, energy landscapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from vjepa2_ac.evaluation.estimates import cost_of_actions, one_step_over_persistence, rank_difference
from vjepa2_ac.evaluation.result import ACTIONS, Evaluation, Landscape, Landscapes, Ranking
from vjepa2_ac.reports.html.charts import Line, line_chart, nice_axis
from vjepa2_ac.reports.html.formatting import NOT_MEASURED, decimal, percent, share, signed_value, value
from vjepa2_ac.reports.html.heatmaps import MapAxis, heat_map
from vjepa2_ac.reports.html.series import Series, models_of
from vjepa2_ac.reports.html.templates import render

_POINTS = 51  # of a curve
_MOST_LANDSCAPES = 3  # clips whose maps are shown

Table = tuple[list[str], list[list[str]]]  # head, rows


def actions_section(evaluation: Evaluation) -> Markup:
    """Return the section on how predictions depend on the actions, and on the rank of the true action."""
    sensitivities = [(one, one.model.sensitivity) for one in models_of(evaluation)]
    drawings = []
    for place in range(2):  # among the actions of other clips, and of a box
        rankings = [
            (one, found.rankings[place]) for one, found in sensitivities if found and place < len(found.rankings)
        ]
        if rankings:
            drawings.append((f"{rankings[0][1].samples} {rankings[0][1].words}", _rank_chart(rankings)))
    return render(
        "actions",
        evaluation=evaluation,
        costs=_costs(evaluation),
        ranks=_ranks(evaluation),
        drawings=drawings,
        moves=_moves(evaluation),
        axes=_axes(evaluation),
        axes_not_to_use=_axes_not_to_use(evaluation),
    )


def landscape_section(evaluation: Evaluation) -> Markup:
    """Return the section on energy landscapes around the true action, as maps and as numbers."""
    measured = {name: model.landscapes for name, model in evaluation.models.items() if model.landscapes is not None}
    if not measured:
        return render("landscapes", evaluation=evaluation, measured=0)
    shown = measured.get(evaluation.trained) or next(iter(measured.values()))
    drawn = {name: one for name, one in measured.items() if one is shown or name == evaluation.base}
    clips = [
        [
            (name, f" {found.unit}".rstrip(), found.maps[place], _planes(name, found, found.maps[place]))
            for name, found in drawn.items()
            if place < len(found.maps)
        ]
        for place in _typical(shown.maps)
    ]
    head, rows = _landscape_table(measured)
    return render("landscapes", measured=len(shown.maps), clips=clips, head=head, rows=rows)


def _costs(evaluation: Evaluation) -> Table:
    rows = []
    for one in models_of(evaluation):
        ratios = [value(one_step_over_persistence(one.model.errors, actions)) for actions in ACTIONS]
        costs = [share(cost_of_actions(one.model.errors, actions), with_sign=True) for actions in ACTIONS[1:]]
        rows.append([one.label, *ratios, *costs])
    head = ["model", *(f"error with {actions} actions" for actions in ACTIONS)]
    return [*head, *(f"growth of the error with {actions} actions" for actions in ACTIONS[1:])], rows


def _ranks(evaluation: Evaluation) -> Table | None:
    measured = {name: model.sensitivity for name, model in evaluation.models.items() if model.sensitivity is not None}
    if not measured:
        return None
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
    return [*head, *(f"true action among the best {k}" for k in tops)], rows


def _moves(evaluation: Evaluation) -> Table | None:
    measured = {name: model.ranking for name, model in evaluation.models.items() if model.ranking is not None}
    if not measured:
        return None
    base = measured.get(evaluation.base or "")
    rows = [
        [
            *(name, value(one.rank), value(one.box), value(one.shell), value(one.spread)),
            NOT_MEASURED if base is None or one is base else signed_value(rank_difference(one, base)),
        ]
        for name, one in measured.items()
    ]
    head = ["model", "mean rank of the true action", "in a box", "among other directions"]
    return [*head, "spread of the energy", "mean rank minus the base's"], rows


def _axes(evaluation: Evaluation) -> Table | None:
    """Return the axes in which each model infers moves: before and after training."""
    measured = {name: model.axes for name, model in evaluation.models.items() if model.axes is not None}
    if not measured:
        return None
    rows = [
        [
            *(name, value(one.yaw_degrees, 0), value(one.error, 2), value(one.fitted_yaw_degrees, 0)),
            *(value(one.gain, 2), value(one.condition, 1), value(one.residual_cm, 1), str(one.pairs)),
        ]
        for name, one in measured.items()
    ]
    head = [
        "model",
        "yaw (degrees)",
        "error there",
        "fitted yaw (degrees)",
        "gain",
        "condition",
        "off by (cm)",
        "pairs",
    ]
    return head, rows


def _axes_not_to_use(evaluation: Evaluation) -> list[str]:
    """Return, for each model whose axes are nothing to plan by, why."""
    measured = {name: model.axes for name, model in evaluation.models.items() if model.axes is not None}
    return [f"{name}: not to plan by: {one.problem}" for name, one in measured.items() if one.problem is not None]


def _rank_chart(rankings: Sequence[tuple[Series, Ranking]]) -> Markup:
    """Return the cumulative distribution of the true action's rank over clips, for each model and by chance."""
    reached = np.linspace(0, 1, _POINTS).tolist()
    by_chance = Line("chance", [0.0, 1.0], [0.0, 100.0], "s-persistence")
    lines = [by_chance, *(Line(one.label, reached, _shares(ranking, reached), one.style) for one, ranking in rankings)]
    x_axis = nice_axis("rank of the true action (0: best)", [0.0, 1.0], most=5)
    description = "Share of clips by rank of the true action: " + "; ".join(
        f"{line.name} {line.y[_POINTS // 10]:.0f} % among the best tenth" for line in lines[1:]
    )
    return line_chart(f"{description}.", lines, x_axis, nice_axis("share of clips (%)", [0.0, 100.0]), key=lines)


def _shares(ranking: Ranking, reached: Sequence[float]) -> list[float]:
    ranks = np.sort(ranking.rank)
    return [float(100 * np.searchsorted(ranks, each, side="right") / max(len(ranks), 1)) for each in reached]


def _top(ranking: Ranking, k: int) -> str:
    if k not in ranking.top:
        return NOT_MEASURED
    return share(ranking.top[k]) + f" (chance {percent(ranking.chance_of_top(k), 1)})"


def _landscape_table(measured: Mapping[str, Landscapes]) -> Table:
    rows = []
    for name, one in measured.items():
        unit = f" {one.unit}".rstrip()
        signs = [
            share(agreement, 0) + f" of {clips} clips (chance {percent(chance)})" if clips else NOT_MEASURED
            for agreement, chance, clips in zip(one.sign_agreement, one.sign_chance, one.sign_clips, strict=True)
        ]
        chance = f"{decimal(one.chance_distance, 2)}{unit}"
        rows.append([name, str(len(one.maps)), value(one.distance, 2) + unit, chance, *signs])
    names = next(iter(measured.values())).axis_names
    head = ["model", "clips", "distance of the minimum to the true action", "by chance"]
    return [*head, *(f"right sign of {name}" for name in names)], rows


def _typical(maps: Sequence[Landscape]) -> list[int]:
    """Return the indices of the maps with the nearest, the median and the farthest minimum."""
    order = sorted(range(len(maps)), key=lambda place: maps[place].distance)
    if len(order) <= _MOST_LANDSCAPES:
        return order
    return [order[0], order[len(order) // 2], order[-1]]


def _planes(model: str, landscapes: Landscapes, one: Landscape) -> list[Markup]:
    """Return the maps of one clip over each pair of axes."""
    return [_plane(model, landscapes, one, first, second) for first, second in combinations(range(3), 2)]


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
