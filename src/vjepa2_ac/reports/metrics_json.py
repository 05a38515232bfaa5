"""The content of metrics.json: all metrics as plain values, by the schema in docs/evaluation.md.

It holds no images: these are in the report.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.distribution.record import LatentDistribution
from vjepa2_ac.evaluation.estimates import (
    difference_to,
    gain_over,
    gap_of_actions,
    mean_error,
    one_step_over_persistence,
    over_persistence,
    rank_difference,
    stratum_gain,
    stratum_over_persistence,
)
from vjepa2_ac.evaluation.metrics import L1, Metric
from vjepa2_ac.evaluation.result import (
    ACTIONS,
    MODES,
    ActionRanking,
    Clips,
    Evaluation,
    Landscapes,
    Mode,
    ModelResult,
    Sensitivity,
    Stratum,
)
from vjepa2_ac.evaluation.verdict import uses_actions, verdict
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.action_score_json import plans_as_dict, study_as_dict
from vjepa2_ac.reports.decoded_json import decoded_as_dict
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import finite_or_none, json_text, read_json_object, shown

METRICS_FILE = "metrics.json"
_MOST_BYTES = 1 << 28  # landscapes are long
FORMAT = 2  # incremented when a reader of the file would have to change
_READABLE = (1, FORMAT)  # 1 had cosine beside l1 and l2


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
    if metrics.get("format") not in _READABLE:
        raise InputError(
            where=str(path), found=f"format {shown(metrics.get('format'))}", needed=f"format {FORMAT}", fix=fix
        )
    return metrics


def metrics_as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return all metrics as plain values; see docs/evaluation.md for the meaning of each."""
    about = {field.name: getattr(evaluation.about, field.name) for field in fields(evaluation.about)}
    del about["space"]
    copies = evaluation.persistence_distribution
    metrics = {
        "format": FORMAT,
        "verdict": verdict(evaluation),
        "uses_actions": uses_actions(evaluation),
        "trained": evaluation.trained,
        "base": evaluation.base,
        "about": {**about, "is_pose": evaluation.about.space.position is not None},
        "clips": _clips(evaluation.clips),
        "persistence": {
            **_by_mode(evaluation, lambda mode, metric: mean_error(evaluation.errors, mode, metric, "persistence")),
            **_distribution(None if copies is None else copies.copies),
        },
        "latent_mmd_noise_floor": None if copies is None else copies.noise_floor,
        "models": {name: _model(evaluation, model) for name, model in evaluation.models.items()},
        "strata": {
            "moving_means": evaluation.clips.moving_means,
            "parts": [_stratum(evaluation, stratum) for stratum in evaluation.strata],
        },
        "episodes": [
            {
                "episode": score.episode_id,
                "clips": score.clips,
                "over_persistence": score.over_persistence,
                "gain_over_base": score.gain_over_base,
            }
            for score in evaluation.episodes
        ],
        "by_clip": {  # the rollout's L1 errors of every clip, which `compare` pairs between runs
            "persistence": evaluation.errors.of("rollout", L1, "persistence"),
            "models": {name: model.errors.of("rollout") for name, model in evaluation.models.items()},
        },
        "calibration": evaluation.calibration,
        "planning": None if evaluation.planning is None else study_as_dict(evaluation.planning),
        "decoded": None if evaluation.decoded is None else decoded_as_dict(evaluation.decoded),
        "notes": evaluation.notes,
    }
    return {name: _plain(value) for name, value in metrics.items()}


def _clips(clips: Clips) -> dict[str, Any]:
    named = list(zip(clips.episode_ids, clips.starts, strict=True))
    return {
        "count": len(clips),
        "episodes": clips.episodes,
        "fingerprint": hashlib.sha256(json.dumps(named).encode()).hexdigest()[:16],
        "named": [{"episode": episode, "start": start} for episode, start in named],
    }


def _model(evaluation: Evaluation, model: ModelResult) -> dict[str, Any]:
    return {
        "role": model.role,
        **_by_mode(evaluation, partial(_errors, evaluation, model)),
        **_distribution(model.distribution),
        "one_step_by_actions": {actions: one_step_over_persistence(model.errors, actions) for actions in ACTIONS},
        "gap_of_zero_actions": gap_of_actions(model.errors, "zero"),
        "gap_of_shuffled_actions": gap_of_actions(model.errors, "shuffled"),
        "sensitivity": None if model.sensitivity is None else _sensitivity(model.sensitivity),
        "ranking": None if model.ranking is None else _ranking(evaluation, model.ranking),
        "landscapes": None if model.landscapes is None else _landscapes(model.landscapes),
        "planning": plans_as_dict(evaluation, model.name),
        "axes": None if model.axes is None else model.axes.as_dict(),
    }


def _distribution(found: LatentDistribution | None) -> dict[str, Any]:
    if found is None:
        return {"spread": None, "latent_mmd": None}
    return {"spread": found.spread, "latent_mmd": [one.as_dict() for one in found.mmd]}


def _by_mode(evaluation: Evaluation, of: Callable[[Mode, Metric], Any]) -> dict[str, dict[str, Any]]:
    return {mode: {metric.name: of(mode, metric) for metric in evaluation.metrics} for mode in MODES}


def _errors(evaluation: Evaluation, model: ModelResult, mode: Mode, metric: Metric) -> dict[str, Any]:
    metrics = {
        "error": mean_error(model.errors, mode, metric),
        "over_persistence": over_persistence(model.errors, mode, metric),
        "over_persistence_zero_actions": over_persistence(model.errors, mode, metric, "zero"),
        "over_persistence_shuffled_actions": over_persistence(model.errors, mode, metric, "shuffled"),
    }
    base = evaluation.base_errors
    if base is not None and model.errors is not base:
        metrics["gain_over_base"] = gain_over(model.errors, base, mode, metric)
        metrics["difference_to_base"] = difference_to(model.errors, base, mode, metric)
    return metrics


def _stratum(evaluation: Evaluation, stratum: Stratum) -> dict[str, Any]:
    errors, base = {name: model.errors for name, model in evaluation.models.items()}, evaluation.base_errors
    return {
        "name": stratum.name,
        "kind": stratum.kind,
        "steps": int(stratum.steps.sum()),
        "over_persistence": {name: stratum_over_persistence(one, stratum) for name, one in errors.items()},
        "gain_over_base": {
            name: stratum_gain(one, base, stratum)
            for name, one in errors.items()
            if base is not None and one is not base
        },
    }


def _sensitivity(sensitivity: Sensitivity) -> dict[str, Any]:
    return {
        "change_over_persistence": sensitivity.change,
        "change_by_clip": sensitivity.change_by_clip,
        "rankings": [
            {
                **{name: getattr(ranking, name) for name in ("drawn_from", "words", "samples", "clips", "mean_rank")},
                "chance_rank": 0.5,
                "top": {
                    str(k): {**share.as_dict(), "chance": ranking.chance_of_top(k)} for k, share in ranking.top.items()
                },
                "rank_by_clip": ranking.rank,
            }
            for ranking in sensitivity.rankings
        ],
    }


def _ranking(evaluation: Evaluation, ranking: ActionRanking) -> dict[str, Any]:
    base = None if evaluation.base is None else evaluation.models[evaluation.base].ranking
    compared = {} if base is None or base is ranking else {"difference_to_base": rank_difference(ranking, base)}
    names = ("samples", "reach", "rank", "box", "shell", "spread")
    moves = {"moves": len(ranking.ranks), "chance_rank": 0.5, "rank_by_move": ranking.ranks}
    return {name: getattr(ranking, name) for name in names} | compared | moves


def _landscapes(landscapes: Landscapes) -> dict[str, Any]:
    signs = zip(landscapes.sign_agreement, landscapes.sign_chance, landscapes.sign_clips, strict=True)
    return {
        "axes": landscapes.axis_names,
        "unit": landscapes.unit,
        "distance": landscapes.distance,
        "chance_distance": landscapes.chance_distance,
        "sign_least": landscapes.sign_least,
        "sign_agreement": {
            name: {**agreement.as_dict(), "chance": chance, "clips": clips}
            for name, (agreement, chance, clips) in zip(landscapes.axis_names, signs, strict=True)
        },
        "maps": [
            {
                "episode": one.episode_id,
                **{name: getattr(one, name) for name in ("start", "true", "minimum", "distance", "axes", "energy")},
            }
            for one in landscapes.maps
        ],
    }


def _plain(value: Any) -> Any:
    """Return a value as JSON has it; arrays with 7 significant digits: more than a prediction in bfloat16 has."""
    if isinstance(value, np.ndarray):
        return _rounded(value.tolist())
    if isinstance(value, Estimate):
        return value.as_dict()
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return finite_or_none(value) if isinstance(value, float) else value


def _rounded(value: Any) -> Any:
    return [_rounded(one) for one in value] if isinstance(value, list) else finite_or_none(float(f"{value:.7g}"))
