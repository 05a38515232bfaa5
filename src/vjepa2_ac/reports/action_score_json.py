"""The planning part of metrics.json: all metrics by their names in the schema of docs/evaluation.md."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from vjepa2_ac.evaluation.action_score.metrics import (
    AXES,
    LEAST_CM,
    PlanDifferences,
    PlanMetrics,
    differences_of,
    directed,
    metrics_of,
    missed_cm,
    signed_along,
)
from vjepa2_ac.evaluation.action_score.protocol import BEST_SCORE, SCORED
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy

_DIGITS = 6  # behind the point, of metres, centimetres and radians


def study_as_dict(study: PlanningStudy) -> dict[str, Any]:
    """Return the starts and settings of the plans, the demonstrated actions, and the metrics of model-free plans."""
    references = {"zero": study.zero, "random": study.random, "within_limits": study.within_limits}
    return {
        "starts": len(study),
        "clips": study.clips,
        "places": study.places,
        "directed": int(directed(study).sum()),
        "signed": {name: int(signed_along(study, axis).sum()) for axis, name in enumerate(AXES)},
        "least_cm": LEAST_CM,
        "best_score": BEST_SCORE,
        "one_step_beyond": study.one_step_beyond,
        "three_steps_beyond": study.three_steps_beyond,
        "references": {name: _by_name(metrics_of(study, plans)) for name, plans in references.items()},
        "demonstrated": _rounded(study.demonstrated),
        "one_step_settings": study.settings.model_dump(mode="json"),
        "three_steps_settings": SCORED.model_dump(mode="json"),
    }


def plans_as_dict(evaluation: Evaluation, name: str) -> dict[str, Any] | None:
    """Return the metrics of a model's plans; None: it did not plan."""
    study, plans = evaluation.planning, evaluation.models[name].plans
    if study is None or plans is None:
        return None
    found = _by_name(metrics_of(study, plans))
    found["difference_to_zero"] = _by_name(differences_of(study, plans, study.zero))
    base = None if evaluation.base in {None, name} else evaluation.models[str(evaluation.base)].plans
    if base is not None:
        found["difference_to_base"] = _by_name(differences_of(study, plans, base))
    found["empty"] = plans.empty
    found["by_start"] = {
        "missed_cm": _rounded(missed_cm(study, plans)),
        "one_step": _rounded(plans.one_step[0]),
        "three_steps": _rounded(plans.three_steps[0]),
    }
    return found


def _by_name(metrics: PlanMetrics | PlanDifferences) -> dict[str, Any]:
    """Return estimates by the names of their fields; those along x, y and z by axis."""
    values = {field.name: getattr(metrics, field.name) for field in fields(metrics)}
    return {
        name: dict(zip(AXES, value, strict=True)) if isinstance(value, tuple) else value
        for name, value in values.items()
    }


def _rounded(values: np.ndarray) -> Any:
    return np.round(values, _DIGITS).tolist()
