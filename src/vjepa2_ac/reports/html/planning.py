"""Report section on planning: Action Score and errors beside model-free plans, and the end of each plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

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
from vjepa2_ac.evaluation.intervals import Estimate
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from vjepa2_ac.reports.html.charts import Line, dot_chart, legend, nice_axis
from vjepa2_ac.reports.html.formatting import percent
from vjepa2_ac.reports.html.layout import ReportSection, not_measured, paragraph, signed_value, table, value, why_not
from vjepa2_ac.reports.html.markup import Markup, element, joined
from vjepa2_ac.reports.html.series import Series, models_of

Row = tuple[str, Callable[[PlanMetrics], Estimate], int]


def planning_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on how close plans are to the demonstrations."""
    title, study = "Plans beside demonstrations", evaluation.planning
    if study is None:
        why = why_not(evaluation, "plans", "It takes a while, and was not asked for: vjepa2-ac evaluate --planning.")
        return ReportSection("planning", title, not_measured("Plans", why))
    how = paragraph(
        f"From one frame of each of {len(study)} clips the models plan towards frames that really came, and the plan is"
        " compared with the demonstrated one. People need not take the shortest way, so 0 cm is not to be expected,"
        " but a model worth planning with is clearly nearer than doing nothing. Doing nothing, random plans (every"
        " number uniform within its limits) and the demonstration itself, cut to the limits, take no model: the last"
        " is the best that any plan could do.",
        class_="how",
    )
    body = joined(how, _score_table(evaluation, study), _ends_of_plans(evaluation, study))
    return ReportSection("planning", title, joined(body, _step_table(evaluation, study)))


def _score_table(evaluation: Evaluation, study: PlanningStudy) -> Markup:
    base = None if evaluation.base is None else evaluation.models[evaluation.base].plans
    rows = []
    for name, plans in _ways(evaluation, study).items():
        found = metrics_of(study, plans)
        cells = [value(found.score, 1), value(found.missed_cm, 1), value(found.missed_over_zero, 2)]
        if base is not None:
            compared = name in evaluation.models and plans is not base
            cells.append(signed_value(differences_of(study, plans, base).missed_cm, 1) if compared else Markup())
        rows.append([name, *cells])
    head = ["plan", f"Action Score (best {BEST_SCORE:.0f})", "its end is off by (cm)", "over doing nothing"]
    head += ["difference to the base (cm)"] if base is not None else []
    caption = (
        f"Plans of {STEPS} steps by the Action Score's protocol (value [95 % interval]). Off by: the differences of"
        " planned and demonstrated displacement along x, y and z, added. Score: 800 x (0.1 - that mean in metres), or 0"
        " where that is negative. Of the demonstrated steps"
        f" {percent(study.three_steps_beyond)} go beyond its limits of 10 cm along an axis"
    )
    return table(caption, head, rows)


def _step_table(evaluation: Evaluation, study: PlanningStudy) -> Markup:
    rows: list[Row] = [
        ("distance of the translations (cm)", lambda found: found.step_cm, 1),
        ("distance over that of doing nothing", lambda found: found.step_over_zero, 2),
        *((f"along {name} (cm)", _part("axes_cm", axis), 1) for axis, name in enumerate(AXES)),
        (f"angle between them (degrees, {int(directed(study).sum())} clips)", lambda found: found.angle_degrees, 0),
        *(
            (f"right sign of {name} ({int(signed_along(study, axis).sum())} clips)", _part("signs", axis), 2)
            for axis, name in enumerate(AXES)
        ),
        ("gripper (closedness)", lambda found: found.gripper, 2),
    ]
    ways = {name: metrics_of(study, plans) for name, plans in _ways(evaluation, study).items()}
    shown = [[label, *(value(of(found), digits) for found in ways.values())] for label, of, digits in rows]
    settings = study.settings
    effort = f"{settings.samples} samples" if settings.planner != "gradient" else f"{settings.gradient.starts} starts"
    most = ", ".join(f"{100 * one:g}" for one in settings.limits.xyz_m)
    caption = (
        f"Plans of one step ({settings.planner}, {effort}, {settings.iterations} iterations,"
        f" {settings.energy.distance.upper()} energy, at most {most} cm along x, y, z;"
        f" {percent(study.one_step_beyond)} of the demonstrated steps go beyond that) and the demonstrated step (value"
        f" [95 % interval]). Angle and signs are of steps of at least {LEAST_CM:g} cm; by chance 90 degrees and 0.5"
    )
    return table(caption, ["", *ways], shown)


def _part(name: str, axis: int) -> Callable[[PlanMetrics], Estimate]:
    def of(found: PlanMetrics) -> Estimate:
        estimates: tuple[Estimate, ...] = getattr(found, name)
        return estimates[axis]

    return of


def _ways(evaluation: Evaluation, study: PlanningStudy) -> dict[str, Plans]:
    without = {"doing nothing": study.zero, "random": study.random, "demonstration within limits": study.within_limits}
    return {**without, **ways_of(evaluation)}


def _ends_of_plans(evaluation: Evaluation, study: PlanningStudy) -> Markup:
    lines = [Line(one.label, (), (), one.style) for one, _ in _drawn(evaluation)]
    how = paragraph(
        f"Where plans of {STEPS} steps end, along each axis. A dot is a plan: on the dashed line it ends where the"
        " demonstration does, on the level of zero it stays where it is, on the other side of zero it goes the wrong"
        " way.",
        class_="how",
    )
    charts = [_scatter(evaluation, study, axis) for axis in range(len(AXES))]
    return element("div", how, element("div", *charts, class_="small-charts"), legend(lines), class_="dots")


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
        f"Planned against demonstrated displacement along {name} of {len(study)} plans of {STEPS} steps: {off}"
    )
    return dot_chart(f"{description}.", dots, x_axis, y_axis)


def _drawn(evaluation: Evaluation) -> Sequence[tuple[Series, Plans]]:
    """Return the models with their plans, the trained one last, so that it is drawn on top."""
    found = ways_of(evaluation)
    return [(one, found[one.model.name]) for one in models_of(evaluation) if one.model.name in found]


def _ends(values: Float[np.ndarray, "starts steps"]) -> list[float]:
    """Return the displacements along one axis, in cm."""
    return [100 * float(each) for each in values.sum(axis=-1)]


def _mean_off(one: Line) -> float:
    return sum(abs(y - x) for x, y in zip(one.x, one.y, strict=True)) / len(one.x)
