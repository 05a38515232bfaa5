"""Metrics of plans: the Action Score, and errors in cm and degrees, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio
from vjepa2_ac.spaces import POSE

AXES = ("x", "y", "z")
LEAST_CM = 0.5  # a demonstrated step that is shorter has no direction, and along an axis no sign
_GRIPPER = 6
_NONE = Estimate(np.nan, np.nan, np.nan)
_NOWHERE_CM = 1e-7
_NO_ANGLE = 90.0  # of a plan that goes nowhere: the mean of random directions


@dataclass(frozen=True)
class PlanMetrics:
    """Metrics of one planning method; cm and degrees."""

    score: Estimate  # 0 to 80
    missed_cm: Estimate  # basis of the score: sum over x, y, z of the difference of displacements
    missed_over_zero: Estimate  # over that of doing nothing: 0 perfect, 1 as good
    step_cm: Estimate  # one step: distance of planned and demonstrated translation
    step_over_zero: Estimate
    axes_cm: tuple[Estimate, Estimate, Estimate]  # along x, y, z
    angle_degrees: Estimate  # between them
    signs: tuple[Estimate, Estimate, Estimate]  # share of steps whose sign is right, along x, y, z; by chance 0.5
    gripper: Estimate  # difference in closedness


@dataclass(frozen=True)
class PlanDifferences:
    """One planning method minus another from the same starts; below 0 is better, except for the score."""

    score: Estimate
    missed_cm: Estimate
    step_cm: Estimate


def ways_of(evaluation: Evaluation) -> dict[str, Plans]:
    """Return the plans of every model that planned, by its name, in the order of the table."""
    return {name: model.plans for name, model in evaluation.models.items() if model.plans is not None}


def metrics_of(study: PlanningStudy, plans: Plans) -> PlanMetrics:
    """Return the errors of plans with respect to the demonstrated actions."""
    ids, missed, step = study.episode_ids, missed_cm(study, plans), _step_cm(study, plans)
    wanted, planned = 100 * study.demonstrated[:, 0, POSE.position], 100 * plans.one_step[..., POSE.position]
    return PlanMetrics(
        score=bootstrapped(_score, _sums(missed), ids)[0],
        missed_cm=mean_of(missed, ids),
        missed_over_zero=ratio(missed, missed_cm(study, study.zero), ids),
        step_cm=mean_of(step, ids),
        step_over_zero=ratio(step, _step_cm(study, study.zero), ids),
        axes_cm=_each(np.abs(planned - wanted).mean(axis=0), ids),
        angle_degrees=_mean_where(_angles(planned, wanted).mean(axis=0), directed(study), ids),
        signs=_signs(study, planned),
        gripper=mean_of(np.abs(plans.one_step[..., _GRIPPER] - study.demonstrated[:, 0, _GRIPPER]).mean(axis=0), ids),
    )


def differences_of(study: PlanningStudy, plans: Plans, other: Plans) -> PlanDifferences:
    """Return the differences of two plans' errors, paired by start."""
    ids, missed = study.episode_ids, [missed_cm(study, each) for each in (plans, other)]
    both = np.concatenate([_sums(each) for each in missed])
    return PlanDifferences(
        score=bootstrapped(lambda sums: _score(sums[:2]) - _score(sums[2:]), both, ids)[0],
        missed_cm=mean_of(missed[0] - missed[1], ids),
        step_cm=mean_of(_step_cm(study, plans) - _step_cm(study, other), ids),
    )


def missed_cm(study: PlanningStudy, plans: Plans) -> Float[np.ndarray, " starts"]:
    """Return the error of each plan's end position in cm: the sum over x, y and z.

    Source: facebookresearch/jepa-wms @ 6eafb14, evals/simu_env_planning/planning/plan_evaluator.py, PlanEvaluator.eval:
    end_distance_xyz.
    """
    ends = plans.three_steps[..., POSE.position].sum(axis=-2) - study.demonstrated[..., POSE.position].sum(axis=-2)
    return np.asarray(100 * np.abs(ends).sum(axis=-1).mean(axis=0))


def directed(study: PlanningStudy) -> Bool[np.ndarray, " starts"]:
    """Return which demonstrated first steps are long enough to have a direction."""
    return np.asarray(100 * np.linalg.norm(study.demonstrated[:, 0, POSE.position], axis=-1) >= LEAST_CM)


def signed_along(study: PlanningStudy, axis: int) -> Bool[np.ndarray, " starts"]:
    """Return which of them are long enough along an axis to have a sign there."""
    return np.asarray(100 * np.abs(study.demonstrated[:, 0, axis]) >= LEAST_CM)


def _score(sums: np.ndarray) -> np.ndarray:
    """Return the score of sums over starts: of centimetres, and of ones.

    Source: facebookresearch/jepa-wms @ 6eafb14, app/plan_common/plot/logs_plan_joint_per_design_choice.py.
    """
    return np.asarray(np.maximum(0.0, 800 * (0.1 - sums[0] / sums[1] / 100)))


def _sums(values: Float[np.ndarray, " starts"]) -> Float[np.ndarray, "2 starts 1"]:
    return np.stack([values, np.ones_like(values)])[:, :, None]


def _step_cm(study: PlanningStudy, plans: Plans) -> Float[np.ndarray, " starts"]:
    apart = plans.one_step[..., POSE.position] - study.demonstrated[:, 0, POSE.position]
    return np.asarray(100 * np.linalg.norm(apart, axis=-1).mean(axis=0))


def _angles(
    planned: Float[np.ndarray, "draws starts 3"], wanted: Float[np.ndarray, "starts 3"]
) -> Float[np.ndarray, "draws starts"]:
    lengths = np.linalg.norm(planned, axis=-1) * np.linalg.norm(wanted, axis=-1)
    cosines = (planned * wanted).sum(axis=-1) / np.maximum(lengths, np.finfo(float).tiny)
    nowhere = np.linalg.norm(planned, axis=-1) < _NOWHERE_CM
    return np.where(nowhere, _NO_ANGLE, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))


def _signs(study: PlanningStudy, planned: Float[np.ndarray, "draws starts 3"]) -> tuple[Estimate, Estimate, Estimate]:
    """Return shares of right signs; a plan that does not move counts half."""
    right = 0.5 + 0.5 * np.sign(planned) * np.sign(study.demonstrated[:, 0, POSE.position])
    x, y, z = (
        _mean_where(right[..., axis].mean(axis=0), signed_along(study, axis), study.episode_ids) for axis in range(3)
    )
    return x, y, z


def _mean_where(values: np.ndarray, chosen: Bool[np.ndarray, " starts"], ids: Sequence[str]) -> Estimate:
    """Return the mean over some starts; NaN if there are none."""
    kept = [name for name, keep in zip(ids, chosen, strict=True) if keep]
    return mean_of(values[chosen], kept) if kept else _NONE


def _each(values: Float[np.ndarray, "starts 3"], ids: Sequence[str]) -> tuple[Estimate, Estimate, Estimate]:
    x, y, z = (mean_of(values[:, axis], ids) for axis in range(3))
    return x, y, z
