"""metrics.json: the rows of an evaluation, and what they come from, as plain values. Images are in the report only.

Its schema is in docs/evaluation.md.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.request import SCORED
from vjepa2_ac.evaluation.result import L1, Clips, Evaluation, ModelResult, PlanningStudy, Row
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import finite_or_none, json_text

METRICS_FILE = "metrics.json"
FORMAT = 3  # incremented when a reader of the file would have to change
_MOST_BYTES = 1 << 28  # landscapes are long


@dataclass(frozen=True)
class WrittenAbout:
    """What readers need of `about`."""

    checkpoint_path: str
    data: str
    cameras: tuple[str, ...]
    split: str
    frames: int
    stride: int
    seconds_per_step: float


@dataclass(frozen=True)
class WrittenClips:
    """What readers need of `clips`."""

    count: int
    episodes: int
    fingerprint: str
    named: tuple[tuple[str, int], ...]  # episode, first control step


@dataclass(frozen=True)
class WrittenErrors:
    """The L1 errors of rollouts, clip by clip, which `compare` pairs between runs: [clips][horizon]."""

    persistence: list[list[float]]
    models: dict[str, list[list[float]]]


@dataclass(frozen=True)
class Metrics:
    """The content of metrics.json that programs read, but for what the rows come from."""

    format: Literal[3]
    verdict: str
    trained: str
    base: str | None
    about: WrittenAbout
    clips: WrittenClips
    rows: tuple[Row, ...]
    by_clip: WrittenErrors
    planning: dict[str, Any] | None = None

    @property
    def models(self) -> tuple[str, ...]:
        """The models, what was evaluated last."""
        return tuple(self.by_clip.models)

    def of(self, key: str, model: str | None = None) -> Row | None:
        """Return the row of a key for a model, by default the evaluated one; None: it was not measured."""
        name = model or self.trained
        return next((row for row in self.rows if row.key == key and row.model == name), None)


def write_metrics(evaluation: Evaluation, path: Path) -> Path:
    """Write all metrics of an evaluation; the file is written atomically."""
    write_atomically(path, json_text(metrics_as_dict(evaluation)))
    return path


def read_metrics(folder: Path) -> Metrics:
    """Return the metrics that `vjepa2-ac evaluate` wrote into a folder.

    Raises:
        InputError: There is nothing, it is damaged, or of another format.
    """
    path = folder / METRICS_FILE
    fix = f"Write it with `vjepa2-ac evaluate {folder}`"
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(where=str(path), found="a file of more than 256 MiB", fix=fix)
        return TypeAdapter(Metrics).validate_json(path.read_bytes())
    except FileNotFoundError:
        found = f"no {METRICS_FILE}" if folder.is_dir() else "no such folder"
        raise InputError(where=str(folder), found=found, fix=fix) from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        found = f"metrics that cannot be used ({place}: {first['msg']}, found {first['input']!r:.60})"
        raise InputError(where=str(path), found=found, needed=f"format {FORMAT}", fix=fix) from None
    except OSError as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", fix=fix) from None


def metrics_as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return all metrics as plain values; see docs/evaluation.md for the meaning of each."""
    from vjepa2_ac.evaluation.rows import rows_of  # reading needs no PyTorch
    from vjepa2_ac.evaluation.verdict import uses_actions, verdict

    about = {field.name: getattr(evaluation.about, field.name) for field in fields(evaluation.about)}
    del about["space"]
    decoded = evaluation.decoded
    metrics = {
        "format": FORMAT,
        "verdict": verdict(evaluation),
        "uses_actions": uses_actions(evaluation),
        "trained": evaluation.trained,
        "base": evaluation.base,
        "about": {**about, "is_pose": evaluation.about.space.position is not None},
        "clips": _clips(evaluation.clips),
        "rows": [asdict(row) for row in rows_of(evaluation)],
        "episodes": evaluation.episodes,
        "by_clip": {
            "persistence": evaluation.errors.of("rollout", L1, "persistence"),
            "models": {name: model.errors.of("rollout") for name, model in evaluation.models.items()},
        },
        "models": {name: _measured(model) for name, model in evaluation.models.items()},
        "planning": None if evaluation.planning is None else _planning(evaluation.planning),
        "decoded": None if decoded is None else {"decoder": decoded.decoder, "notes": decoded.notes},
        **{name: found.as_dict() for name, found in evaluation.beside.items()},
        "notes": evaluation.notes,
    }
    return {name: _plain(value) for name, value in metrics.items()}


def _clips(clips: Clips) -> dict[str, Any]:
    named = list(zip(clips.episode_ids, clips.starts, strict=True))
    return {
        "count": len(clips),
        "episodes": clips.episodes,
        "moving_means": clips.moving_means,
        "fingerprint": hashlib.sha256(json.dumps(named).encode()).hexdigest()[:16],
        "named": named,
    }


def _measured(model: ModelResult) -> dict[str, Any]:
    """Return what the rows of a model come from, but for its errors."""
    return {
        "role": model.role,
        "sensitivity": model.sensitivity,
        "ranking": model.ranking,
        "landscapes": model.landscapes,
        "plans": model.plans,
        **{name: found.as_dict() for name, found in model.beside.items()},
    }


def _planning(study: PlanningStudy) -> dict[str, Any]:
    names = ("clips", "places", "demonstrated", "one_step_beyond", "three_steps_beyond", "settings")
    return {name: getattr(study, name) for name in names} | {"three_steps_settings": SCORED}


def _plain(value: Any) -> Any:
    """Return a value as JSON has it; arrays with 7 significant digits: more than a prediction in bfloat16 has."""
    if isinstance(value, np.ndarray):
        return _rounded(value.tolist())
    if isinstance(value, Estimate):
        return value.as_dict()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return finite_or_none(value) if isinstance(value, float) else value


def _rounded(value: Any) -> Any:
    return [_rounded(one) for one in value] if isinstance(value, list) else finite_or_none(float(f"{value:.7g}"))
