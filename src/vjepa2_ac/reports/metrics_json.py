"""Write and read metrics.json: the rows of an evaluation and the arrays behind them. Write metrics.csv.

The schema is in docs/evaluation_reference.md. Images are only in the report.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from vjepa2_ac.errors import InputError, MissingFileError, shell_command
from vjepa2_ac.evaluation.result import L1, About, ActionMode, Evaluation
from vjepa2_ac.evaluation.rows import Row, make_rows
from vjepa2_ac.evaluation.summary import Summary, summarize
from vjepa2_ac.storage import translate_read_errors, write_atomically
from vjepa2_ac.storage.structured import describe_validation_error, format_json

METRICS_FILE = "metrics.json"
FORMAT = 6  # incremented when a reader of the file would have to change
# Part of an evaluation: words that a note on its absence contains, and the reason if there is no such note.
_ABSENCE = {
    "base": ("no base", "The comparison needs a base model; a model without one was evaluated."),
    "distribution": ("spread", "The spread is a variance over clips and needs two clips or more."),
    "landscapes": ("energy landscapes", "They are measured by `vjepa2-ac evaluate --ranking-clips 32 --landscapes 8`."),
    "examples": ("example clips", "They are drawn by `vjepa2-ac evaluate --examples 4`."),
    "decoded": (
        "decoded images",
        "They need a decoder: train one with `vjepa2-ac decoder CONFIG`, then add `--decoder FOLDER`.",
    ),
}


@dataclass(frozen=True)
class WrittenClips:
    """The part of `clips` in metrics.json that is read back."""

    count: int
    episodes: int
    fingerprint: str
    named: tuple[tuple[str, int], ...]  # episode and first control step of each clip


@dataclass(frozen=True)
class WrittenErrors:
    """The L1 errors of rollouts by clip, [clips][horizon]; `compare` pairs them between runs."""

    persistence: list[list[float]]
    models: dict[str, list[list[float]]]


@dataclass(frozen=True)
class Metrics:
    """The part of metrics.json that is read back."""

    format: Literal[6]
    summary: Summary
    trained: str
    base: str | None
    about: About
    clips: WrittenClips
    rows: tuple[Row, ...]
    by_clip: WrittenErrors
    ranked: str | None = None  # description of the action ranking; None: not measured

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models; the evaluated model is the last."""
        return tuple(self.by_clip.models)

    def of(self, key: str, model: str | None = None) -> Row | None:
        """Return the row with a key for a model (default: the evaluated model); None: not measured."""
        name = model or self.trained
        return next((row for row in self.rows if row.key == key and row.model == name), None)


def missing_parts(evaluation: Evaluation) -> dict[str, str]:
    """Return the parts of an evaluation that were not measured, with the reasons."""
    model = evaluation.models[evaluation.trained]
    parts = {**vars(evaluation), **vars(model), "base": evaluation.base}
    return {
        part: next((note for note in evaluation.notes if words in note), reason)
        for part, (words, reason) in _ABSENCE.items()
        if not parts.get(part)
    }


def write_metrics(evaluation: Evaluation, path: Path, summary: Summary | None = None) -> Path:
    """Write all metrics of an evaluation with its summary, atomically. None: the summary without a closed loop."""
    write_atomically(path, format_json(metrics_as_dict(evaluation, summary)))
    return path


def read_metrics(folder: Path) -> Metrics:
    """Read the metrics that `vjepa2-ac evaluate` wrote into a folder.

    Raises:
        InputError: There is no metrics.json, or it is damaged or has another format.
        UnreachableError: The file cannot be read.
    """
    path, fix = folder / METRICS_FILE, f"Write it with `{shell_command('evaluate', folder)}`"
    try:
        with translate_read_errors(path):
            return TypeAdapter(Metrics).validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        problem = f"metrics that cannot be read ({key}: {describe_validation_error(first)})"
        raise InputError(where=str(path), found=problem, needed=f"format {FORMAT}", fix=fix) from None
    except MissingFileError:
        problem = f"no {METRICS_FILE}" if folder.is_dir() else "no such folder"
        raise InputError(where=str(folder), found=problem, fix=fix) from None


def metrics_as_dict(evaluation: Evaluation, summary: Summary | None = None) -> dict[str, Any]:
    """Return all metrics as plain values, by the schema in docs/evaluation_reference.md."""
    clips, decoded, rows = evaluation.clips, evaluation.decoded, make_rows(evaluation)
    summary = summary or summarize(evaluation, rows)
    verdicts = TypeAdapter(Summary).dump_python(summary, by_alias=True)
    clip_names = list(zip(clips.episode_ids, clips.starts, strict=True))
    metrics = {
        "format": FORMAT,
        "summary": {**verdicts, "sentence": summary.sentence},
        "trained": evaluation.trained,
        "base": evaluation.base,
        "about": evaluation.about,
        "clips": {
            "count": len(clips),
            "episodes": clips.episodes,
            "moving_means": clips.moving_rule,
            "fingerprint": hashlib.sha256(json.dumps(clip_names).encode()).hexdigest()[:16],
            "named": clip_names,
        },
        "ranked": evaluation.ranked,
        "rows": rows,
        "by_clip": {
            "persistence": evaluation.errors.of("rollout", L1, "persistence"),
            "models": {name: model.errors.of("rollout") for name, model in evaluation.models.items()},
            "last_horizon": {
                metric.name: {
                    name: model.errors.of("rollout", metric)[:, -1] for name, model in evaluation.models.items()
                }
                for metric in evaluation.metrics
            },
            "one_step": {
                name: {
                    actions: model.errors.of("teacher_forced", actions=actions).mean(1)
                    for actions in get_args(ActionMode)
                }
                for name, model in evaluation.models.items()
            },
        },
        "models": {  # arrays from which the rows are computed; the errors are in `by_clip`
            name: {key: getattr(model, key) for key in ("role", "ranking", "landscapes", "distribution")}
            for name, model in evaluation.models.items()
        },
        "decoded": None if decoded is None else {"decoder": decoded.decoder, "notes": decoded.notes},
        "notes": evaluation.notes,
        "not_measured": missing_parts(evaluation),
    }
    plain: dict[str, Any] = to_jsonable_python(
        metrics, inf_nan_mode="null", fallback=lambda array: _round(array.tolist())
    )
    return plain


def _round(value: Any) -> Any:
    """Round the numbers of an array to 7 significant digits, which is more than the precision of bfloat16."""
    return [_round(item) for item in value] if isinstance(value, list) else float(f"{value:.7g}")


def write_csv(rows: Sequence[Row], path: Path) -> Path:
    """Write all rows as CSV, atomically. The columns are the fields of `Row`; missing numbers are nan."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(vars(row) for row in rows)
    write_atomically(path, text.getvalue())
    return path
