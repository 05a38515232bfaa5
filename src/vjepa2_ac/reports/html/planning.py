"""Report section on planning: Action Score and errors beside model-free plans, and the end of each plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from vjepa2_ac.evaluation.action_score.metrics import (
    AXES,
    LEAST_CM,
    PlanMetrics,
    differences_of,
    directed,
    metrics_of,
    signed_along,
    ways_of,
)
from vjepa2_ac.evaluation.action_score.protocol import BEST_SCORE, STEPS
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from vjepa2_ac.reports.html.charts import Line, dot_chart, nice_axis
from vjepa2_ac.reports.html.formatting import signed_value, value
from vjepa2_ac.reports.html.series import Series, models_of
from vjepa2_ac.reports.html.templates import render

Table = tuple[list[str], list[list[str]]]  # head, rows


def planning_section(evaluation: Evaluation) -> Markup:
    """Return the section on how close plans are to the demonstrations."""
    study = evaluation.planning
    if study is None:
        return render("planning", evaluation=evaluation)
    settings = study.settings
    ways = {"doing nothing": study.zero, "random": study.random, "demonstration within limits": study.within_limits}
    ways |= ways_of(evaluation)
    metrics = {name: metrics_of(study, plans) for name, plans in ways.items()}
    return render(
        "planning",
        evaluation=evaluation,
        steps=STEPS,
        scores=_scores(evaluation, study, ways, metrics),
        errors=_errors(study, metrics),
        charts=[_scatter(evaluation, study, axis) for axis in range(len(AXES))],
        dots=[Line(one.label, (), (), one.style) for one, _ in _drawn(evaluation)],
        effort=f"{settings.gradient.starts} starts"
        if settings.planner == "gradient"
        else f"{settings.samples} samples",
        most=", ".join(f"{100 * one:g}" for one in settings.limits.xyz_m),
        least=LEAST_CM,
    )


def _scores(
    evaluation: Evaluation, study: PlanningStudy, ways: dict[str, Plans], metrics: dict[str, PlanMetrics]
) -> Table:
    base = None if evaluation.base is None else evaluation.models[evaluation.base].plans
    rows = []
    for name, plans in ways.items():
        found = metrics[name]
        cells = [value(found.score, 1), value(found.missed_cm, 1), value(found.missed_over_zero, 2)]
        if base is not None:
            compared = name in evaluation.models and plans is not base
            cells.append(signed_value(differences_of(study, plans, base).missed_cm, 1) if compared else Markup())
        rows.append([name, *cells])
    head = ["plan", f"Action Score (best {BEST_SCORE:.0f})", "its end is off by (cm)", "over doing nothing"]
    return head + ["difference to the base (cm)"] * (base is not None), rows


def _errors(study: PlanningStudy, metrics: dict[str, PlanMetrics]) -> Table:
    found = list(metrics.values())
    rows = [
        ("distance of the translations (cm)", [one.step_cm for one in found], 1),
        ("distance over that of doing nothing", [one.step_over_zero for one in found], 2),
        *((f"along {name} (cm)", [one.axes_cm[axis] for one in found], 1) for axis, name in enumerate(AXES)),
        (f"angle between them (degrees, {directed(study).sum()} clips)", [one.angle_degrees for one in found], 0),
        *(
            (f"right sign of {name} ({signed_along(study, axis).sum()} clips)", [one.signs[axis] for one in found], 2)
            for axis, name in enumerate(AXES)
        ),
        ("gripper (closedness)", [one.gripper for one in found], 2),
    ]
    return ["", *metrics], [[label, *(value(one, digits) for one in estimates)] for label, estimates, digits in rows]


def _scatter(evaluation: Evaluation, study: PlanningStudy, axis: int) -> Markup:
    name = AXES[axis]
    demonstrated = _ends(study.demonstrated[..., axis])
    dots = [
        Line(one.label, demonstrated, _ends(plans.three_steps[0, ..., axis]), one.style)
        for one, plans in _drawn(evaluation)
    ]
    reached = [*demonstrated, *(each for one in dots for each in one.y), 0.0]
    x_axis = nice_axis(f"demonstrated along {name} (cm)", [*demonstrated, 0.0])
    y_axis = nice_axis(f"planned along {name} (cm)", reached)
    off = "; ".join(f"{one.name} off by {_mean_off(one):.1f} cm on average" for one in dots)
    description = (
        f"Planned against demonstrated displacement along {name} of {len(study)} plans of {STEPS} steps: {off}."
    )
    return dot_chart(description, dots, x_axis, y_axis)


def _drawn(evaluation: Evaluation) -> Sequence[tuple[Series, Plans]]:
    """Return the models with their plans, the trained one last, so that it is drawn on top."""
    found = ways_of(evaluation)
    return [(one, found[one.model.name]) for one in models_of(evaluation) if one.model.name in found]


def _ends(values: Float[np.ndarray, "starts steps"]) -> list[float]:
    """Return the displacements along one axis, in cm."""
    return [100 * float(each) for each in values.sum(axis=-1)]


def _mean_off(one: Line) -> float:
    return sum(abs(y - x) for x, y in zip(one.x, one.y, strict=True)) / len(one.x)
