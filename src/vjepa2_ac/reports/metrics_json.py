"""The content of metrics.json: all metrics as plain values, by the schema in docs/evaluation.md.

It holds no images: these are in the report.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from functools import partial
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
from vjepa2_ac.evaluation.metrics import L1, Metric
from vjepa2_ac.evaluation.result import (
    ACTIONS,
    MODES,
    About,
    Clips,
    EpisodeScore,
    Evaluation,
    Landscapes,
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
    return {
        "format": FORMAT,
        "verdict": verdict(evaluation),
        "uses_actions": uses_actions(evaluation),
        "trained": evaluation.trained,
        "base": evaluation.base,
        "about": _about(evaluation.about),
        "clips": _clips(evaluation.clips),
        "persistence": _by_mode(
            evaluation, lambda mode, metric: _curve(mean_error(evaluation.errors, mode, metric, "persistence"))
        ),
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


def _about(about: About) -> dict[str, Any]:
    values = {field.name: getattr(about, field.name) for field in dataclasses.fields(about)}
    known = {"space": ("is_pose", about.space.position is not None)}
    return dict(known.get(name, (name, value)) for name, value in values.items())


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
        **_by_mode(evaluation, partial(_errors, evaluation, model)),
        "one_step_by_actions": {
            actions: one_step_over_persistence(model.errors, actions).as_dict() for actions in ACTIONS
        },
        "gap_of_zero_actions": gap_of_actions(model.errors, "zero").as_dict(),
        "gap_of_shuffled_actions": gap_of_actions(model.errors, "shuffled").as_dict(),
        "sensitivity": None if model.sensitivity is None else _sensitivity(model.sensitivity),
        "landscapes": None if model.landscapes is None else _landscapes(model.landscapes),
        "planning": plans_as_dict(evaluation, model.name),
        "axes": None if model.axes is None else model.axes.as_dict(),
    }


def _by_mode(evaluation: Evaluation, of: Callable[[Mode, Metric], Any]) -> dict[str, dict[str, Any]]:
    return {mode: {metric.name: of(mode, metric) for metric in evaluation.metrics} for mode in MODES}


def _errors(evaluation: Evaluation, model: ModelResult, mode: Mode, metric: Metric) -> dict[str, Any]:
    metrics = {
        "error": _curve(mean_error(model.errors, mode, metric)),
        "over_persistence": _curve(over_persistence(model.errors, mode, metric)),
        "over_persistence_zero_actions": _curve(over_persistence(model.errors, mode, metric, "zero")),
        "over_persistence_shuffled_actions": _curve(over_persistence(model.errors, mode, metric, "shuffled")),
    }
    base = evaluation.base_errors
    if base is not None and model.errors is not base:
        metrics["gain_over_base"] = _curve(gain_over(model.errors, base, mode, metric))
        metrics["difference_to_base"] = _curve(difference_to(model.errors, base, mode, metric))
    return metrics


def _stratum(evaluation: Evaluation, stratum: Stratum) -> dict[str, Any]:
    errors, base = {name: model.errors for name, model in evaluation.models.items()}, evaluation.base_errors
    return {
        "name": stratum.name,
        "kind": stratum.kind,
        "steps": int(stratum.steps.sum()),
        "over_persistence": {name: stratum_over_persistence(one, stratum).as_dict() for name, one in errors.items()},
        "gain_over_base": {
            name: stratum_gain(one, base, stratum).as_dict()
            for name, one in errors.items()
            if base is not None and one is not base
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
    models = {name: _rounded(model.errors.of("rollout")) for name, model in evaluation.models.items()}
    return {"persistence": _rounded(evaluation.errors.of("rollout", L1, "persistence")), "models": models}


def _curve(curve: Curve) -> list[Mapping[str, float | None]]:
    return [estimate.as_dict() for estimate in curve]


def _rounded(values: np.ndarray) -> Any:
    """Return numbers with 7 significant digits: more than a prediction in bfloat16 has."""
    return _each(values.tolist())


def _each(value: Any) -> Any:
    return [_each(one) for one in value] if isinstance(value, list) else finite_or_none(float(f"{value:.7g}"))
