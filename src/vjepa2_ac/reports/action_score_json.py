"""The planning part of metrics.json: all metrics as plain values, by the schema in docs/evaluation.md."""

from __future__ import annotations

from typing import Any

import numpy as np

from vjepa2_ac.evaluation.action_score.metrics import (
    AXES,
    LEAST_CM,
    PlanDifferences,
    differences_of,
    directed,
    metrics_of,
    missed_cm,
    signed_along,
)
from vjepa2_ac.evaluation.action_score.protocol import BEST_SCORE, SCORED
from vjepa2_ac.evaluation.intervals import Estimate
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans

_DIGITS = 6  # behind the point, of metres, centimetres and radians


def study_as_dict(study: PlanningStudy) -> dict[str, Any]:
    """Return the starts and settings of the plans, the demonstrated actions, and the metrics of model-free plans."""
    references = {"zero": study.zero, "random": study.random, "within_limits": study.within_limits}
    return {
        "starts": len(study),
        "clips": list(study.clips),
        "places": list(study.places),
        "directed": int(directed(study).sum()),
        "signed": {name: int(signed_along(study, axis).sum()) for axis, name in enumerate(AXES)},
        "least_cm": LEAST_CM,
        "best_score": BEST_SCORE,
        "one_step_beyond": study.one_step_beyond,
        "three_steps_beyond": study.three_steps_beyond,
        "references": {name: _metrics(study, plans) for name, plans in references.items()},
        "demonstrated": _rounded(study.demonstrated),
        "one_step_settings": study.settings.model_dump(mode="json"),
        "three_steps_settings": SCORED.model_dump(mode="json"),
    }


def plans_as_dict(evaluation: Evaluation, name: str) -> dict[str, Any] | None:
    """Return the metrics of a model's plans; None: it did not plan."""
    study, plans = evaluation.planning, evaluation.models[name].plans
    if study is None or plans is None:
        return None
    found = _metrics(study, plans)
    found["difference_to_zero"] = _differences(differences_of(study, plans, study.zero))
    base = None if evaluation.base in {None, name} else evaluation.models[str(evaluation.base)].plans
    if base is not None:
        found["difference_to_base"] = _differences(differences_of(study, plans, base))
    found["empty"] = plans.empty
    found["by_start"] = {
        "missed_cm": _rounded(missed_cm(study, plans)),
        "one_step": _rounded(plans.one_step[0]),
        "three_steps": _rounded(plans.three_steps[0]),
    }
    return found


def _metrics(study: PlanningStudy, plans: Plans) -> dict[str, Any]:
    metrics = metrics_of(study, plans)
    return {
        "score": metrics.score.as_dict(),
        "missed_cm": metrics.missed_cm.as_dict(),
        "missed_over_zero": metrics.missed_over_zero.as_dict(),
        "step_cm": metrics.step_cm.as_dict(),
        "step_over_zero": metrics.step_over_zero.as_dict(),
        "axes_cm": _by_axis(metrics.axes_cm),
        "angle_degrees": metrics.angle_degrees.as_dict(),
        "signs": _by_axis(metrics.signs),
        "gripper": metrics.gripper.as_dict(),
    }


def _by_axis(estimates: tuple[Estimate, Estimate, Estimate]) -> dict[str, Any]:
    return {axis: estimate.as_dict() for axis, estimate in zip(AXES, estimates, strict=True)}


def _differences(differences: PlanDifferences) -> dict[str, Any]:
    return {
        "score": differences.score.as_dict(),
        "missed_cm": differences.missed_cm.as_dict(),
        "step_cm": differences.step_cm.as_dict(),
    }


def _rounded(values: np.ndarray) -> Any:
    return np.round(values, _DIGITS).tolist()
