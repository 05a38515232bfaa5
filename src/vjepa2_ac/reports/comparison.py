"""Comparison of runs that were measured on the same clips, from their metrics.json alone.

Nothing is measured here: missing results have to be written by `vjepa2-ac evaluate` first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.metrics import L1, METRICS, Metric
from vjepa2_ac.intervals import Estimate, bootstrapped
from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics

Cell = Estimate | str
_SAME_LATENTS = 1e-3  # errors of persistence that differ by a larger share are of other latents


@dataclass(frozen=True)
class Comparison:
    """Runs side by side: a table, and curves for a figure."""

    title: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell, ...]]  # by run
    seconds: Float[np.ndarray, " horizon"]
    curves: Mapping[str, tuple[Estimate, ...]]  # run -> rollout error over persistence by horizon
    notes: tuple[str, ...]


def compare(folders: Sequence[Path], metrics: Sequence[Metric] = METRICS) -> Comparison:
    """Compare runs; each is compared with the first one, paired by clip.

    Args:
        folders: Of the runs.
        metrics: What the table shows; the cell of a run that was evaluated without one is empty.

    Raises:
        InputError: Fewer than two, one is named twice or was not evaluated, or they were measured on different clips.
    """
    if len(folders) < 2:
        raise InputError(where="runs to compare", found=f"{len(folders)}", needed="two or more to compare")
    for number, folder in enumerate(folders):
        if folder.resolve() in [other.resolve() for other in folders[:number]]:
            raise InputError(where=str(folder), found="a run that is named twice", needed="each run once")
    measured = {_name(folder, folders): read_metrics(folder) for folder in folders}
    try:
        return _compared(measured, dict(zip(measured, folders, strict=True)), metrics)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(
            where=", ".join(str(folder / METRICS_FILE) for folder in folders),
            found=f"metrics that cannot be used ({error!r})",
            fix="Write them again with `vjepa2-ac evaluate`",
        ) from None


def _name(folder: Path, folders: Sequence[Path]) -> str:
    alike = [other for other in folders if other.resolve().name == folder.resolve().name]
    return folder.resolve().name if len(alike) == 1 else str(folder)


def _compared(
    measured: Mapping[str, dict[str, Any]], folders: Mapping[str, Path], shown: Sequence[Metric]
) -> Comparison:
    names = list(measured)
    first = measured[names[0]]
    for name in names[1:]:
        _check_same_clips(first, measured[name], folders[names[0]], folders[name])
    about, clips = first["about"], first["clips"]
    ids = [clip["episode"] for clip in clips["named"]]
    ahead = f"{(about['frames'] - 1) * about['seconds_per_step']:.2f} s"
    columns = [f"{ahead} ahead", f"gain over {names[0]}", "gain over its base", "one step", "shuffled", "rank"]
    columns += [f"{ahead}, {metric.heading}" for metric in shown[1:]]
    rows = {
        name: [*_row(metrics, first, ids), *(_last_ratio(metrics, metric) for metric in shown[1:])]
        for name, metrics in measured.items()
    }
    if any(_trained(metrics).get("planning") for metrics in measured.values()):
        columns += ["Action Score", "plans end off, cm"]
        for name, metrics in measured.items():
            plans = _trained(metrics).get("planning")  # None: none were requested, or evaluate did not know them yet
            rows[name] += ["", ""] if plans is None else [_estimate(plans["score"]), _estimate(plans["missed_cm"])]
    return Comparison(
        title=f"{L1.label} error over persistence on {clips['count']} {about['split']} clips of {clips['episodes']}"
        f" episode{'s' * (clips['episodes'] != 1)}",
        columns=tuple(columns),
        rows={name: tuple(cells) for name, cells in rows.items()},
        seconds=about["seconds_per_step"] * np.arange(1, about["frames"]),
        curves={
            name: tuple(map(_estimate, _trained(metrics)["rollout"][L1.name]["over_persistence"]))
            for name, metrics in measured.items()
        },
        notes=_notes(measured, names),
    )


def _trained(metrics: dict[str, Any]) -> dict[str, Any]:
    """Return the metrics of the evaluated model."""
    model: dict[str, Any] = metrics["models"][metrics["trained"]]
    return model


def _check_same_clips(one: dict[str, Any], other: dict[str, Any], first: Path, second: Path) -> None:
    differences = [
        f"{what}: {a} and {b}"
        for what, a, b in [
            *((key, one["about"][key], other["about"][key]) for key in ("split", "frames", "stride", "cameras")),
            ("clips", one["clips"]["count"], other["clips"]["count"]),
        ]
        if a != b
    ]
    if not differences and one["clips"]["fingerprint"] != other["clips"]["fingerprint"]:
        differences = [f"other episodes or starts, of {one['about']['data']} and {other['about']['data']}"]
    if differences:
        raise InputError(
            where=f"{first} and {second}",
            found=f"measured on different clips ({'; '.join(differences)})",
            needed="the same clips",
            fix="Evaluate them again with the same --data, --split and --clips",
        )


def _row(metrics: dict[str, Any], first: dict[str, Any], ids: Sequence[str]) -> tuple[Cell, ...]:
    model = _trained(metrics)
    base_gain = model["rollout"][L1.name].get("gain_over_base")
    sensitivity = model["sensitivity"]
    return (
        _last_ratio(metrics, L1),
        "" if metrics is first else _gain(metrics, first, ids),
        "no base" if base_gain is None else _estimate(base_gain[-1]),
        _estimate(model["one_step_by_actions"]["true"]),
        f"{model['one_step_by_actions']['shuffled']['value']:.3f}",
        "" if sensitivity is None else f"{sensitivity['rankings'][0]['mean_rank']['value']:.3f}",
    )


def _last_ratio(metrics: dict[str, Any], metric: Metric) -> Cell:
    found = _trained(metrics)["rollout"].get(metric.name)
    return "" if found is None else _estimate(found["over_persistence"][-1])


def _gain(metrics: dict[str, Any], first: dict[str, Any], ids: Sequence[str]) -> Estimate:
    """Return the share by which the error over persistence is below the first run's, at the last horizon, paired."""
    columns = [column for one in (metrics, first) for column in _last(one)]
    return bootstrapped(
        lambda sums: 1 - (sums[0] / sums[1]) / (sums[2] / sums[3]), np.stack(columns)[:, :, None], list(ids)
    )[0]


def _last(metrics: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    by_clip = metrics["by_clip"]
    trained = np.array(by_clip["models"][metrics["trained"]], dtype=np.float64)
    return trained[:, -1], np.array(by_clip["persistence"], dtype=np.float64)[:, -1]


def _notes(measured: Mapping[str, dict[str, Any]], names: Sequence[str]) -> tuple[str, ...]:
    nothing = {
        name: np.array(metrics["by_clip"]["persistence"], dtype=np.float64).mean() for name, metrics in measured.items()
    }
    others = [name for name in names[1:] if abs(nothing[name] / nothing[names[0]] - 1) > _SAME_LATENTS]
    notes = []
    if others:
        notes.append(
            f"Other latents than those of {names[0]} (another encoder or crop): {', '.join(others)}; ratios compare."
        )
    planned = [metrics["planning"] for metrics in measured.values() if _trained(metrics).get("planning")]
    if len({(*starts["clips"], *starts["places"]) for starts in planned}) > 1:
        notes.append("Plans began at other frames (another --planning-clips or seed): Action Scores do not compare.")
    return tuple(notes)


def _estimate(metrics: Mapping[str, float | None]) -> Estimate:
    return Estimate(
        *(float("nan") if metrics[key] is None else float(metrics[key] or 0) for key in ("value", "low", "high"))
    )
