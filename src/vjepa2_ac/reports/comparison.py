"""Comparison of runs that were measured on the same clips, from their metrics.json alone: their rows, joined by key.

Nothing is measured here: missing results have to be written by `vjepa2-ac evaluate` first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.result import L1, Row
from vjepa2_ac.evaluation.summary import Summary, interval_of, percent
from vjepa2_ac.intervals import Estimate, bootstrapped
from vjepa2_ac.reports.metrics_json import Metrics, read_metrics

_NAME, _CELL, _MOST_RUNS = 22, 16, 8  # columns of a name and of a verdict, and lines on a screen
_SAME = ("split", "frames", "stride", "cameras")
_SAME_LATENTS = 1e-3  # errors of persistence that differ by a larger share are of other latents


@dataclass(frozen=True)
class Comparison:
    """Runs side by side: rows, of which a run is the model, and curves for a figure."""

    title: str
    rows: tuple[Row, ...]
    seconds: Float[np.ndarray, " horizon"]
    curves: Mapping[str, tuple[Estimate, ...]]  # run -> rollout error over persistence by horizon
    notes: tuple[str, ...]
    summaries: Mapping[str, Summary]

    @property
    def best(self) -> str:
        """The run whose error is clearly the lowest; else the first."""
        clear = [row for row in self.rows if row.key == "gain_over_first" and row.estimate.side(of=0.0) == 1]
        return max(clear, key=lambda row: row.value).model if clear else next(iter(self.summaries))

    def __str__(self) -> str:
        """Return the verdicts on all runs, a line each, and how much better than the first one the best of them is."""
        first, *others = self.summaries
        gains = {row.model: row for row in self.rows if row.key == "gain_over_first"}
        wide = min(max(map(len, self.summaries)), _NAME)
        lines = [
            f"{len(self.summaries)} runs on the same {self.summaries[first].measured}, {self.seconds[-1]:.1f} s ahead"
        ]
        lines.append(
            "  " + " " * wide + "".join(f"  {question.name:<{_CELL}}" for question in self.summaries[first].verdicts)
        )
        for name, found in list(self.summaries.items())[:_MOST_RUNS]:
            cells = [
                f"{one.conclusion} {'' if one.value is None else f'{percent(one.value)} %'}" for one in found.verdicts
            ]
            lines.append(f"  {name[-wide:]:<{wide}}" + "".join(f"  {cell:<{_CELL}}" for cell in cells))
        lines.append("  (error below the base's; cost of a wrong action; action-ranking error)")
        best = max(others, key=lambda name: gains[name].value)
        gain = gains[best].estimate
        how = {1: "lower", -1: "higher", 0: "not clearly other"}[gain.side(of=0.0)]
        share = "" if how == "not clearly other" else f" {percent(abs(gain.value))} %"
        lines.append(f"The error of {best} is{share} {how} than that of {first} {interval_of(gain)}".rstrip() + ".")
        return "\n".join(line.rstrip() for line in lines)


def compare(folders: Sequence[Path]) -> Comparison:
    """Compare what was evaluated in each run; the gain over the first one is paired by clip.

    Args:
        folders: Of the runs.

    Raises:
        InputError: Fewer than two, one is named twice or was not evaluated, or they were measured on different clips.
    """
    if len(folders) < 2:
        raise InputError(where="runs to compare", found=f"{len(folders)}", needed="two or more to compare")
    places = [folder.resolve() for folder in folders]
    names = [place.name if [one.name for one in places].count(place.name) == 1 else str(place) for place in places]
    if len(set(places)) < len(places):
        raise InputError(where=", ".join(map(str, folders)), found="a run that is named twice", needed="each run once")
    measured = {name: read_metrics(folder) for name, folder in zip(names, folders, strict=True)}
    first = measured[names[0]]
    for name, folder in zip(names[1:], folders[1:], strict=True):
        _check_same_clips(first, measured[name], folders[0], folder)
    about, clips = first.about, first.clips
    rows = [
        replace(row, model=name, detail=row.detail and not row.key.startswith(f"rollout.{L1.name}.gain_over_base"))
        for name, one in measured.items()
        for row in one.rows
        if row.model == one.trained
    ]
    return Comparison(
        title=f"{L1.label} error over persistence on {clips.count} {about.split} clips of {clips.episodes}"
        f" episode{'s' * (clips.episodes != 1)}",
        rows=(*_gains(measured), *rows),
        seconds=about.seconds_per_step * np.arange(1, about.frames),
        curves={name: _curve(metrics) for name, metrics in measured.items()},
        notes=_notes(measured),
        summaries={name: metrics.summary for name, metrics in measured.items()},
    )


def _check_same_clips(one: Metrics, other: Metrics, first: Path, second: Path) -> None:
    pairs = {key: (getattr(one.about, key), getattr(other.about, key)) for key in _SAME}
    pairs["clips"] = one.clips.count, other.clips.count
    differences = [f"{what}: {a} and {b}" for what, (a, b) in pairs.items() if a != b]
    if not differences and one.clips.fingerprint != other.clips.fingerprint:
        differences = [f"other episodes or starts, of {one.about.data} and {other.about.data}"]
    if differences:
        fix = "Evaluate them again with the same --data, --split and --clips"
        found = f"measured on different clips ({'; '.join(differences)})"
        raise InputError(where=f"{first} and {second}", found=found, fix=fix)


def _gains(measured: Mapping[str, Metrics]) -> list[Row]:
    """Return the share by which each error over persistence is below the first run's, at the last horizon, paired."""
    (name, first), *others = measured.items()
    ids = [episode for episode, _ in first.clips.named]
    found = []
    for other, metrics in others:
        columns = np.stack([*_last(metrics), *_last(first)])[:, :, None]
        (gain,) = bootstrapped(lambda sums: 1 - (sums[0] / sums[1]) / (sums[2] / sums[3]), columns, ids)
        group, line = f"Gain over {name}", f"{(first.about.frames - 1) * first.about.seconds_per_step:.2f} s ahead"
        numbers = (gain.value, gain.low, gain.high)
        found.append(Row(group, line, "gain_over_first", other, *numbers, form=".1%", better="higher", chance=0.0))
    return found


def _last(metrics: Metrics) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of each clip at the last horizon: of what was evaluated, and of persistence."""
    errors, persistence = metrics.by_clip.models[metrics.trained], metrics.by_clip.persistence
    return np.array(errors)[:, -1], np.array(persistence)[:, -1]


def _curve(metrics: Metrics) -> tuple[Estimate, ...]:
    rows = (metrics.of(f"rollout.{L1.name}.over_persistence.{h}") for h in range(1, metrics.about.frames))
    return tuple(Estimate(math.nan, math.nan, math.nan) if row is None else row.estimate for row in rows)


def _notes(measured: Mapping[str, Metrics]) -> tuple[str, ...]:
    nothing = {name: _last(one)[1].mean() for name, one in measured.items()}
    first, *names = measured
    others = [name for name in names if abs(nothing[name] / nothing[first] - 1) > _SAME_LATENTS]
    notes = []
    if others:
        notes.append(
            f"Other latents than those of {first} (another encoder or crop): {', '.join(others)}; ratios compare."
        )
    plans = [one.planning for one in measured.values() if one.planning is not None]
    if len({f"{study.get('clips')} {study.get('places')}" for study in plans}) > 1:
        notes.append("Plans began at other frames (another --planning-clips or seed): Action Scores do not compare.")
    return tuple(notes)
