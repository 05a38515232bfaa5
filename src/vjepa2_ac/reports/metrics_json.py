"""The content of metrics.json: all metrics as plain values, by the schema in docs/evaluation.md.

It holds no images: these are in the report.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.estimates import (
    Curve,
    difference_to,
    gain_over,
    gap_of_actions,
    mean_error,
    one_step_over_persistence,
    over_persistence,
    stratum_gain,
    stratum_over_persistence,
)
from vjepa2_ac.evaluation.result import (
    ACTIONS,
    METRICS,
    MODES,
    Clips,
    EpisodeScore,
    Evaluation,
    Landscapes,
    Metric,
    Mode,
    ModelResult,
    Sensitivity,
    Stratum,
)
from vjepa2_ac.evaluation.verdict import uses_actions, verdict
from vjepa2_ac.reports.action_score_json import plans_as_dict, study_as_dict
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import finite_or_none, json_text, read_json_object, shown

METRICS_FILE = "metrics.json"
_MOST_BYTES = 1 << 28  # landscapes are long
FORMAT = 1  # incremented when a reader of the file would have to change


def write_metrics(evaluation: Evaluation, path: Path) -> Path:
    """Write all metrics of an evaluation; the file is written atomically."""
    write_atomically(path, json_text(metrics_as_dict(evaluation)))
    return path


def read_metrics(folder: Path) -> dict[str, Any]:
    """Return the metrics that `vjepa2-ac evaluate` wrote into a folder.

    Raises:
        InputError: There is nothing, it is damaged, or of another format.
    """
    path = folder / METRICS_FILE
    fix = f"Write it with `vjepa2-ac evaluate {folder}`"
    try:
        metrics = read_json_object(path, most_bytes=_MOST_BYTES, fix=fix)
    except FileNotFoundError:
        raise InputError(
            where=str(folder), found=f"no {METRICS_FILE}" if folder.is_dir() else "no such folder", fix=fix
        ) from None
    except OSError as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", fix=fix) from None
    if metrics.get("format") != FORMAT:
        raise InputError(
            where=str(path), found=f"format {shown(metrics.get('format'))}", needed=f"format {FORMAT}", fix=fix
        )
    return metrics


def metrics_as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return all metrics as plain values; see docs/evaluation.md for the meaning of each."""
    return {
        "format": FORMAT,
        "verdict": verdict(evaluation),
        "uses_actions": uses_actions(evaluation),
        "trained": evaluation.trained,
        "base": evaluation.base,
        "about": dataclasses.asdict(evaluation.about),
        "clips": _clips(evaluation.clips),
        "persistence": {
            mode: {metric: _curve(mean_error(evaluation, "persistence", mode, metric)) for metric in METRICS}
            for mode in MODES
        },
        "models": {name: _model(evaluation, model) for name, model in evaluation.models.items()},
        "strata": {
            "moving_means": evaluation.clips.moving_means,
            "parts": [_stratum(evaluation, stratum) for stratum in evaluation.strata],
        },
        "episodes": [_episode(score) for score in evaluation.episodes],
        "by_clip": _by_clip(evaluation),
        "calibration": evaluation.calibration,
        "planning": None if evaluation.planning is None else study_as_dict(evaluation.planning),
        "notes": list(evaluation.notes),
    }


def _clips(clips: Clips) -> dict[str, Any]:
    named = [list(name) for name in zip(clips.episode_ids, clips.starts, strict=True)]
    return {
        "count": len(clips),
        "episodes": clips.episodes,
        "fingerprint": hashlib.sha256(json.dumps(named).encode()).hexdigest()[:16],
        "named": [{"episode": episode, "start": start} for episode, start in named],
    }


def _model(evaluation: Evaluation, model: ModelResult) -> dict[str, Any]:
    return {
        "role": model.role,
        **{mode: {metric: _errors(evaluation, model.name, mode, metric) for metric in METRICS} for mode in MODES},
        "one_step_by_actions": {
            actions: one_step_over_persistence(evaluation, model.name, actions=actions).as_dict() for actions in ACTIONS
        },
        "gap_of_zero_actions": gap_of_actions(evaluation, model.name, "zero").as_dict(),
        "gap_of_shuffled_actions": gap_of_actions(evaluation, model.name, "shuffled").as_dict(),
        "sensitivity": None if model.sensitivity is None else _sensitivity(model.sensitivity),
        "landscapes": None if model.landscapes is None else _landscapes(model.landscapes),
        "planning": plans_as_dict(evaluation, model.name),
    }


def _errors(evaluation: Evaluation, name: str, mode: Mode, metric: Metric) -> dict[str, Any]:
    metrics = {
        "error": _curve(mean_error(evaluation, name, mode, metric)),
        "over_persistence": _curve(over_persistence(evaluation, name, mode, metric)),
        "over_persistence_zero_actions": _curve(over_persistence(evaluation, name, mode, metric, "zero")),
        "over_persistence_shuffled_actions": _curve(over_persistence(evaluation, name, mode, metric, "shuffled")),
    }
    if evaluation.base is not None and name != evaluation.base:
        metrics["gain_over_base"] = _curve(gain_over(evaluation, name, evaluation.base, mode, metric))
        metrics["difference_to_base"] = _curve(difference_to(evaluation, name, evaluation.base, mode, metric))
    return metrics


def _stratum(evaluation: Evaluation, stratum: Stratum) -> dict[str, Any]:
    base = evaluation.base
    others = [name for name in evaluation.models if base is not None and name != base]
    return {
        "name": stratum.name,
        "kind": stratum.kind,
        "steps": int(stratum.steps.sum()),
        "over_persistence": {
            name: stratum_over_persistence(evaluation, stratum, name).as_dict() for name in evaluation.models
        },
        "gain_over_base": {
            name: stratum_gain(evaluation, stratum, name, base).as_dict() for name in others if base is not None
        },
    }


def _episode(score: EpisodeScore) -> dict[str, Any]:
    gain = score.gain_over_base
    return {
        "episode": score.episode_id,
        "clips": score.clips,
        "over_persistence": finite_or_none(score.over_persistence),
        "gain_over_base": None if gain is None else finite_or_none(gain),
    }


def _sensitivity(sensitivity: Sensitivity) -> dict[str, Any]:
    return {
        "change_over_persistence": sensitivity.change.as_dict(),
        "change_by_clip": _rounded(sensitivity.change_by_clip),
        "rankings": [
            {
                "drawn_from": ranking.drawn_from,
                "words": ranking.words,
                "samples": ranking.samples,
                "clips": list(ranking.clips),
                "mean_rank": ranking.mean_rank.as_dict(),
                "chance_rank": 0.5,
                "top": {
                    str(k): {**share.as_dict(), "chance": ranking.chance_of_top(k)} for k, share in ranking.top.items()
                },
                "rank_by_clip": _rounded(ranking.rank),
            }
            for ranking in sensitivity.rankings
        ],
    }


def _landscapes(landscapes: Landscapes) -> dict[str, Any]:
    signs = zip(landscapes.sign_agreement, landscapes.sign_chance, landscapes.sign_clips, strict=True)
    return {
        "axes": list(landscapes.axis_names),
        "unit": landscapes.unit,
        "distance": landscapes.distance.as_dict(),
        "chance_distance": landscapes.chance_distance,
        "sign_least": landscapes.sign_least,
        "sign_agreement": {
            name: {**agreement.as_dict(), "chance": finite_or_none(chance), "clips": clips}
            for name, (agreement, chance, clips) in zip(landscapes.axis_names, signs, strict=True)
        },
        "maps": [
            {
                "episode": one.episode_id,
                "start": one.start,
                "true": _rounded(one.true),
                "minimum": _rounded(one.minimum),
                "distance": one.distance,
                "axes": _rounded(one.axes),
                "energy": _rounded(one.energy),
            }
            for one in landscapes.maps
        ],
    }


def _by_clip(evaluation: Evaluation) -> dict[str, Any]:
    """Return the rollout's L1 errors of every clip, which `compare` pairs between runs."""
    models = {name: _rounded(model.true.rollout.l1) for name, model in evaluation.models.items()}
    return {"persistence": _rounded(evaluation.persistence.rollout.l1), "models": models}


def _curve(curve: Curve) -> list[Mapping[str, float | None]]:
    return [estimate.as_dict() for estimate in curve]


def _rounded(values: np.ndarray) -> Any:
    """Return numbers with 7 significant digits: more than a prediction in bfloat16 has."""
    return _each(values.tolist())


def _each(value: Any) -> Any:
    return [_each(one) for one in value] if isinstance(value, list) else finite_or_none(float(f"{value:.7g}"))
