"""Compare runs that were measured on the same clips: read the metrics.json of each run, and join the rows by key.

Nothing is measured here. `vjepa2-ac evaluate` writes metrics.json.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.errors import InputError, counted, shell_command
from vjepa2_ac.evaluation.result import L1
from vjepa2_ac.evaluation.rows import Row
from vjepa2_ac.evaluation.summary import Verdict, format_percent
from vjepa2_ac.intervals import Estimate, bootstrap
from vjepa2_ac.reports.metrics_json import Metrics, read_metrics
from vjepa2_ac.runs.checkpoint import RANKING_TOLERANCE, parse_step, selection_reason

_LINE = "  {:<22}  {:>10}  {:>17}  {:>21}  {:>18}"  # a line of the table; the column headers have three lines
_HEAD = ("", "", "error vs", "one-step error", "action-ranking")
_COLUMNS = "with shuffled actions", "error, chance 50 %"
_BETTER = ("", "", "(lower is better)", "(higher is better)", "(lower is better)")
_REQUIRED_EQUAL = ("split", "frames", "stride", "cameras")
_SAME_LATENTS = 1e-3  # larger relative differences between the errors of persistence mean that the latents differ


@dataclass(frozen=True)
class Comparison:
    """The results of several runs on the same clips: rows and curves of the evaluated model of each run."""

    title: str
    rows: tuple[Row, ...]  # `Row.model` is the name of the run
    seconds: Float[np.ndarray, " horizon"]
    curves: Mapping[str, tuple[Estimate, ...]]  # run -> rollout error relative to persistence, by horizon
    notes: tuple[str, ...]
    measured: Mapping[str, Metrics]
    folders: Mapping[str, Path]

    def __str__(self) -> str:
        """Return a table with checkpoint and metrics of each run, and a sentence about the difference of the errors."""
        first, key = next(iter(self.measured.values())), f"rollout.{L1.name}.gain_over_base.{len(self.seconds)}"
        has_base = _have_same_base(self.measured.values())
        reference = "base model" if has_base else "persistence"
        lines = [_LINE.format(*head).rstrip() for head in (_HEAD, ("run", "checkpoint", reference, *_COLUMNS), _BETTER)]
        for name, metrics in self.measured.items():
            gain, step = metrics.of(key), _get_step(metrics)
            error = self.curves[name][-1].value - 1 if not has_base else -gain.value if gain else 0.0
            checkpoint = "base model" if metrics.about.is_base else "none" if step is None else f"{step:,}"
            sensitivity, ranking = _get_value(metrics.summary.sensitivity), _get_value(metrics.summary.ranking)
            numbers = _format(error, "+.1f"), _format(sensitivity, "+.1f"), _format(ranking, ".1f")
            lines.append(_LINE.format(name if len(name) <= 22 else f"…{name[-21:]}", checkpoint, *numbers))
        title = f"{len(self.measured)} runs on the same {first.summary.measured}, {self.seconds[-1]:.1f} s ahead"
        return "\n".join([title, *lines, *textwrap.wrap(self._difference, 100)])

    @property
    def _difference(self) -> str:
        """The sentence that compares the lowest error of the other runs with the error of the first run."""
        gains = {row.model: row.estimate for row in self.rows if row.key == "gain_over_first"}
        (first, measured), best = next(iter(self.measured.items())), max(gains, key=lambda name: gains[name].value)
        if not gains[best].has_interval:
            return f"Whether the errors differ is not measured: {self._too_few}"
        if not (sign := gains[best].compare_to(0.0)):
            return f"The errors of {best} and {first} do not differ significantly."
        low, value, high = (format_percent(end) for end in sorted(map(abs, astuple(gains[best]))))
        change = f"{value} % {'lower' if sign > 0 else 'higher'}"
        interval = f"95 % CI {low} to {high} %, n = {counted(measured.clips.episodes, 'episode')}"
        return f"The error of {best} is {change} than that of {first} ({interval})."

    @property
    def next_command(self) -> str:
        """The command that exports the best run, or the reason why no run is recommended.

        The rule is that of `checkpoint.keep_best`: among the runs within `RANKING_TOLERANCE` of the lowest
        action-ranking error, the run with the lowest prediction error is the best.
        """
        ranking_errors = {name: _get_value(metrics.summary.ranking) for name, metrics in self.measured.items()}
        highest = min(ranking_errors.values()) + RANKING_TOLERANCE
        candidates = [name for name, error in ranking_errors.items() if error <= highest]
        best = min(candidates, key=lambda name: self.curves[name][-1].value, default="")
        if len({metrics.ranked for metrics in self.measured.values()}) > 1:
            return "No run is recommended: the actions were ranked with different settings."
        if missing := [name for name, error in ranking_errors.items() if math.isnan(error)]:
            why = f"the action-ranking error of {', '.join(missing)} was not measured."
        elif not (why := self._too_few):
            why = self._find_objection(best)
        if why:
            return f"No run is recommended: {why}"
        folder, step = self.folders[best], _get_step(self.measured[best])
        return f"Next: {shell_command('export', folder, f'{folder.resolve().name}-merged', '--checkpoint', step)}"

    @property
    def _too_few(self) -> str:
        """The sentence that there are too few episodes for a conclusion; empty if there are enough."""
        return next(iter(self.measured.values())).summary.prediction.needs.partition(" So far: ")[0]

    def _find_objection(self, best: str) -> str:
        """Return the sentence why the best run is not recommended; empty if it is recommended."""
        verdict = self.measured[best].summary.ranking
        if not _get_step(self.measured[best]):
            return f"{best}, with the lowest action-ranking error, was not fine-tuned."
        if verdict.conclusion == "yes":
            return ""
        result = "not better" if verdict.conclusion == "no" else "not known to be better"
        return f"the action ranking of {best} is {result} than {verdict.compared_with}."


def compare(folders: Sequence[Path]) -> Comparison:
    """Compare the evaluations of several runs. The gain over the first run is paired by clip.

    Args:
        folders: The folders of the runs.

    Raises:
        InputError: There are fewer than two runs, a run is named twice or was not evaluated, or the runs were measured
            on different clips.
    """
    if len(folders) < 2:
        raise InputError(where="compare", found=counted(len(folders), "run"), needed="two or more runs")
    paths = [folder.resolve() for folder in folders]
    counts = Counter(path.name for path in paths)
    names = [path.name if counts[path.name] == 1 else str(path) for path in paths]
    if len(set(paths)) < len(paths):
        raise InputError(where=", ".join(map(str, folders)), found="one run twice", needed="different runs")
    measured = {name: read_metrics(folder) for name, folder in zip(names, folders, strict=True)}
    first = measured[names[0]]
    for name, folder in zip(names[1:], folders[1:], strict=True):
        _require_same_clips(first, measured[name], folders[0], folder)
    about, clips = first.about, first.clips
    rows = [
        replace(row, model=name, detail=row.detail and not row.key.startswith(f"rollout.{L1.name}.gain_over_base"))
        for name, metrics in measured.items()
        for row in metrics.rows
        if row.model == metrics.trained
    ]
    return Comparison(
        title=f"{L1.label} error over persistence on {counted(clips.count, about.split + ' clip')}"
        f" of {counted(clips.episodes, 'episode')}",
        rows=(*_compute_gains(measured), *rows),
        seconds=about.seconds_per_step * np.arange(1, about.frames),
        curves={name: _get_curve(metrics) for name, metrics in measured.items()},
        notes=_make_notes(measured),
        measured=measured,
        folders=dict(zip(names, folders, strict=True)),
    )


def _require_same_clips(first: Metrics, second: Metrics, first_folder: Path, second_folder: Path) -> None:
    pairs = {key: (getattr(first.about, key), getattr(second.about, key)) for key in _REQUIRED_EQUAL}
    pairs["clips"] = first.clips.count, second.clips.count
    differences = [f"{name}: {a} and {b}" for name, (a, b) in pairs.items() if a != b]
    if not differences and first.clips.fingerprint != second.clips.fingerprint:
        differences = [f"different episodes or start steps, from {first.about.data} and {second.about.data}"]
    if differences:
        fix = "Evaluate these runs again with the same --data, --split and --clips"
        problem = f"measured on different clips ({'; '.join(differences)})"
        raise InputError(where=f"{first_folder} and {second_folder}", found=problem, fix=fix)


def _compute_gains(measured: Mapping[str, Metrics]) -> list[Row]:
    """Return the relative gain of each run over the first run at the last horizon, paired by clip.

    The errors are first divided by those of persistence.
    """
    (name, first), *later_runs = measured.items()
    ids = [episode for episode, _ in first.clips.named]
    rows = []
    for run, metrics in later_runs:
        columns = np.stack([*_get_last_errors(metrics), *_get_last_errors(first)])[:, :, None]
        (gain,) = bootstrap(lambda sums: 1 - (sums[0] / sums[1]) / (sums[2] / sums[3]), columns, ids)
        group = f"Improvement over {name} in L1, open loop"
        line = f"{(first.about.frames - 1) * first.about.seconds_per_step:.2f} s ahead"
        numbers = (gain.value, gain.low, gain.high)
        rows.append(Row(group, line, "gain_over_first", run, *numbers, form=".1%", better="higher", chance=0.0))
    return rows


def _get_last_errors(metrics: Metrics) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the evaluated model and of persistence at the last horizon, by clip."""
    errors, persistence = metrics.by_clip.models[metrics.trained], metrics.by_clip.persistence
    return np.array(errors)[:, -1], np.array(persistence)[:, -1]


def _get_value(verdict: Verdict) -> float:
    return math.nan if verdict.value is None else verdict.value


def _format(fraction: float, form: str) -> str:
    return "not measured" if math.isnan(fraction) else f"{round(100 * fraction, 1) + 0.0:{form}} %"


def _get_step(metrics: Metrics) -> int | None:
    """Return the number of optimizer steps of the evaluated checkpoint; None for a model without checkpoints."""
    return parse_step(Path(metrics.about.checkpoint_path).name)


def _get_curve(metrics: Metrics) -> tuple[Estimate, ...]:
    rows = (metrics.of(f"rollout.{L1.name}.over_persistence.{h}") for h in range(1, metrics.about.frames))
    return tuple(Estimate(math.nan, math.nan, math.nan) if row is None else row.estimate for row in rows)


def _have_same_base(measured: Iterable[Metrics]) -> bool:
    """Return whether all runs were compared with the same base model, which is recognised by equal errors."""
    errors = []
    for metrics in measured:
        if metrics.base is None and not metrics.about.is_base:
            return False
        errors.append(float(np.mean(metrics.by_clip.models[metrics.base or metrics.trained])))
    return max(errors) - min(errors) <= _SAME_LATENTS * abs(errors[0])


def _make_notes(measured: Mapping[str, Metrics]) -> tuple[str, ...]:
    persistence = {name: _get_last_errors(metrics)[1].mean() for name, metrics in measured.items()}
    first, *later_runs = measured
    different = [name for name in later_runs if abs(persistence[name] / persistence[first] - 1) > _SAME_LATENTS]
    notes = []
    if different:
        notes.append(
            f"The latents of {', '.join(different)} differ from those of {first} (another encoder or crop):"
            " only errors relative to persistence can be compared."
        )
    selections = {name: selection_reason(metrics.about.checkpoint) for name, metrics in measured.items()}
    if len(set(selections.values())) > 1:
        notes.append(
            f"The checkpoints were selected differently: "
            f"{', '.join(f'{selection} ({name})' for name, selection in selections.items())}."
        )
    if len({metrics.ranked for metrics in measured.values() if metrics.ranked is not None}) > 1:
        settings = "; ".join(f"{name}: {metrics.ranked}" for name, metrics in measured.items())
        notes.append(
            f"The action-ranking errors cannot be compared: they were measured with different settings ({settings})."
        )
    if not _have_same_base(measured.values()) and all(
        metrics.base or metrics.about.is_base for metrics in measured.values()
    ):
        notes.append("The runs have different base models. Errors are therefore relative to persistence.")
    return tuple(notes)
