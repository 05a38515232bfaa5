"""What do the figures say? The verdict in words, the spread over runs, and every figure as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vjepa2_ac.evaluation.evaluate import Evaluation
from vjepa2_ac.evaluation.metrics import Ratio, one_step_ratios, ratio, ratios_by_horizon


def verdict(evaluation: Evaluation) -> str:
    """Say in words whether what was trained helped, at the farthest horizon."""
    error = ratios_by_horizon(evaluation.models[evaluation.trained])[-1]
    ahead = f"{evaluation.horizon * evaluation.seconds_per_step:.1f} s ahead"
    where = f"on {evaluation.clips} clips of {evaluation.episodes} held-out episode{'s' * (evaluation.episodes > 1)}"
    absolute = f"Its error {ahead} is {error.value:.2f} of doing nothing ({_interval(error, '.2f')}): "
    absolute += {-1: "better.", 0: "no clear difference.", 1: "NOT better."}[_side(error, of=1.0)]
    gain = improvement(evaluation, evaluation.horizon)
    if gain is None:
        return " ".join(filter(None, [f"The model was measured {where}. {absolute}", evaluation.why_no_base]))
    direction = "better" if gain.value > 0 else "WORSE"
    compared = f"{abs(gain.value):.0%} {direction} than the base (gain {_interval(gain, '.0%')}), {where}"
    if _side(gain, of=0.0) == 0:
        return f"The {evaluation.trained} did not clearly help: it predicts {ahead} {compared}. {absolute}"
    return f"The {evaluation.trained} predicts {ahead} {compared}. {absolute}"


def improvement(evaluation: Evaluation, horizon: int) -> Ratio | None:
    """Return by which share of the base's error the trained model's is smaller at a horizon, paired by clip.

    None if there is no base to compare with. Horizon 1 is the first model step.
    """
    if "base" not in evaluation.models:
        return None
    base, trained = evaluation.models["base"], evaluation.models[evaluation.trained]
    kept = ratio(trained.rollout[:, horizon - 1], base.rollout[:, horizon - 1], base.episode_ids)
    return Ratio(1 - kept.value, 1 - kept.high, 1 - kept.low)


def spread(evaluations: Sequence[Evaluation]) -> str:
    """Say how much the results of several runs differ, at the farthest horizon."""
    errors = [ratios_by_horizon(one.models[one.trained])[-1].value for one in evaluations]
    gains = [gain.value for one in evaluations if (gain := improvement(one, one.horizon)) is not None]
    words = f"{len(evaluations)} runs: error over persistence {_mean_and_range(errors, '.3f')}"
    return words + (f"; better than the base by {_mean_and_range(gains, '.1%')}" if gains else "")


def evaluation_as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return every figure as plain values, for `evaluation.json`."""
    gains = [improvement(evaluation, horizon) for horizon in range(1, evaluation.horizon + 1)]
    return {
        "verdict": verdict(evaluation),
        "clips": evaluation.clips,
        "episodes": evaluation.episodes,
        "seconds_per_step": evaluation.seconds_per_step,
        "persistence_error": evaluation.models[evaluation.trained].persistence.mean(axis=0).tolist(),
        "models": {
            name: {
                "rollout_error": errors.rollout.mean(axis=0).tolist(),
                "rollout_over_persistence": [value.as_dict() for value in ratios_by_horizon(errors)],
                "one_step_over_persistence": {key: value.as_dict() for key, value in one_step_ratios(errors).items()},
            }
            for name, errors in evaluation.models.items()
        },
        "improvement_over_base": [gain.as_dict() for gain in gains if gain is not None],
    }


def _side(value: Ratio, *, of: float) -> int:
    """Return -1 or 1 where the whole interval lies below or above a number, else 0: not sure."""
    return -1 if value.high < of else 1 if value.low > of else 0


def _interval(value: Ratio, form: str) -> str:
    if not value.has_interval:
        return "one episode: no interval"
    return f"95 % interval {value.low:{form}} to {value.high:{form}}"


def _mean_and_range(values: list[float], form: str) -> str:
    return f"{np.mean(values):{form}} ({min(values):{form}} to {max(values):{form}})"
