"""Write the tables of the predecessor study into results/predecessor.md and docs/predecessor.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from predecessor import ALL, BASE_VIEW, CONDITIONS, VIEWS, Condition
from results import REACHED_CM, Figures, select_step
from tables import insert_table

from vjepa2_ac.intervals import estimate_share

PUBLISHED = {  # base model and fine-tuned model; V-Jepa-2-Fine-Tuning @ 4d4050e, 30 pairs of frames of droid_100
    "offset": ("13.8 cm", "20.3 cm"),
    "rank": ("21 %", "34 %"),  # 130 and 211 of 625 points
    "energy": ("0.419", "0.537"),
    "sharpness": ("0.072", "0.0086"),
}
MEASURES = {
    "offset": ("distance of the energy minimum from the true action", "offset_cm", "{:.1f} cm", 1.0),
    "rank": ("points with a lower energy than the true action", "rank", "{:.0f} %", 100.0),
    "energy": ("energy at the true action", "energy", "{:.3f}", 1.0),
    "sharpness": ("sharpness: (highest - lowest) / mean energy", "sharpness", "{:.3f}", 1.0),
}
NOT_MEASURED = "not measured"
Results = dict[str, list[Figures]]  # by condition, ordered by seed


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write all tables to a file, and four of them between their marks in docs/predecessor.md."""
    by_condition = group_results(results)
    texts = {
        "figures": figures_table(by_condition),
        "conditions": conditions_table(by_condition),
        "selection": selection_table(by_condition),
        "warnings": warnings_table(by_condition),
    }
    parts = (*texts.values(), measurements_table(by_condition), checkpoints_table(by_condition))
    path.write_text("\n\n".join(parts) + "\n")
    for name, table in texts.items():
        insert_table(docs / "predecessor.md", f"{name}, made by `make evidence`", table)


def group_results(results: Sequence[Figures]) -> Results:
    """Return the results of each condition, ordered by seed."""
    by_condition: Results = {name: [] for name in ALL}
    for result in sorted(results, key=lambda each: each["cell"]["seed"]):
        by_condition[result["cell"]["condition"]].append(result)
    return by_condition


def figures_table(results: Results) -> str:
    """Return the predecessor's metrics of base and fine-tuned model, and ours with all mistakes."""
    base = results["base model, wrist, stride 8"]
    heads = ("metric", "predecessor, base", "predecessor, fine-tuned", "simulator, base", "simulator, fine-tuned")
    rows = [_row(heads), _rule(len(heads))]
    for name, (label, key, form, factor) in MEASURES.items():
        ours = (
            form.format(factor * mean_of(each, key)) if each else NOT_MEASURED
            for each in (base, results["all mistakes"])
        )
        rows.append(_row((label, *PUBLISHED[name], *ours)))
        if name == "offset":
            rows.append(_row(("distance of a random point from the true action", *_random_offsets(results))))
    return "\n".join(rows)


def _random_offsets(results: Results) -> Iterator[str]:
    """Yield the mean distance of a random grid point from the true action; the published one is for a true action 0."""
    yield from ("11.9 cm", "11.9 cm")
    for each in (results["base model, wrist, stride 8"], results["all mistakes"]):
        yield f"{mean_of(each, 'random_offset_cm'):.1f} cm" if each else NOT_MEASURED


def mean_of(results: Sequence[Figures], key: str, view: str = "own") -> float:
    """Return the mean of a metric over the seeds with this measurement."""
    values = [result["measured"][view][key] for result in results if "measured" in result]
    return float(np.mean([value[0] if isinstance(value, list) else value for value in values]))


def conditions_table(results: Results) -> str:
    """Return the mean metrics of each condition, after those of the base model in the same view."""
    heads = ("model", "measured on", "seeds", "offset", "rank", "relative energy", "sharpness", "action-ranking error",
             "rollout error", "goals reached (95 % interval)")  # fmt: skip
    rows = [_row(heads), _rule(len(heads))]
    for view in VIEWS:
        rows.append(_condition_row("base model", view, results[f"base model, {view}"], "own"))
        for name, condition in CONDITIONS.items():
            if condition.view == view:
                rows.append(_condition_row(name, view, results[name], "own"))
        if view == BASE_VIEW:
            others = (name for name in CONDITIONS if not CONDITIONS[name].is_validated)
            rows += [_condition_row(name, view, results[name], "base's") for name in others]
    return "\n".join(rows)


def _condition_row(name: str, view: str, results: Sequence[Figures], measured: str) -> str:
    if not results:
        return _row((name, view, NOT_MEASURED, *[""] * 7))
    means = {
        key: mean_of(results, key, measured)
        for key in ("offset_cm", "rank", "relative_energy", "sharpness", "ranking", "rollout_error")
    }
    ends = [end for result in results for end in result.get("ends_cm", ())]
    condition = ALL[results[0]["cell"]["condition"]]
    is_planned = view == Condition(stride=condition.planning_stride).view or condition.is_validated
    share = estimate_share(sum(end < REACHED_CM for end in ends), len(ends)) if ends and is_planned else None
    success = "" if share is None else f"{100 * share.value:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f} %)"
    return _row(
        (
            name,
            view,
            "" if name == "base model" else str(len(results)),
            f"{means['offset_cm']:.1f} cm",
            f"{100 * means['rank']:.0f} %",
            f"{means['relative_energy']:.3f}",
            f"{means['sharpness']:.3f}",
            f"{100 * means['ranking']:.0f} %",
            f"{means['rollout_error']:.2f}",
            success,
        )
    )


def selection_table(results: Results) -> str:
    """Return in how many runs `keep_best` selects the base model, and its former rule did."""
    heads = ("condition", "action-ranking error of the base model", "lowest error of a checkpoint",
             "`keep_best` selects the base model", "the former rule selected the base model")  # fmt: skip
    rows = [_row(heads), _rule(len(heads))]
    for name in CONDITIONS:
        if not (runs := results[name]):
            rows.append(_row((name, NOT_MEASURED, "", "", "")))
            continue
        base = np.mean([run["validations"][0]["ranking"][0] for run in runs])
        lowest = np.mean([min(each["ranking"][0] for each in run["validations"][1:]) for run in runs])
        steps = [[select_step(run["validations"], is_former_rule=former) for run in runs] for former in (False, True)]
        counts = (f"{each.count(0)} of {len(runs)} runs" for each in steps)
        rows.append(_row((name, f"{100 * base:.0f} %", f"{100 * lowest:.0f} %", *counts)))
    return "\n".join(rows)


def measurements_table(results: Results) -> str:
    """Return the landscapes and the action-ranking error of every measurement, with intervals over episodes."""
    metrics = {"offset_cm": "offset in cm", "rank": "rank", "sharpness": "sharpness", "energy": "energy",
               "ranking": "action-ranking error"}  # fmt: skip
    heads = ("model", "seed", "measured on", *(f"{label} | 95 % interval" for label in metrics.values()))
    rows = [_row(heads), _rule(3 + 2 * len(metrics))]
    for name, runs in results.items():
        for run in runs:
            for view, measured in run.get("measured", {}).items():
                shown = ALL[name].view if view == "own" else BASE_VIEW
                values = ("{:.3f} | {:.3f} to {:.3f}".format(*measured[key]) for key in metrics)
                rows.append(_row((name, str(run["cell"]["seed"]), shown, *values)))
    return "\n".join(rows)


def checkpoints_table(results: Results) -> str:
    """Return every validation of every run: action-ranking error, difference from the base model, and intervals."""
    heads = ("condition", "seed", "step", "rollout error", "action-ranking error", "95 % interval", "difference",
             "95 % interval of the difference", "selected by `keep_best`")  # fmt: skip
    rows = [_row(heads), _rule(len(heads))]
    for name in CONDITIONS:
        for run in results[name]:
            selected = select_step(run["validations"])
            for each in run["validations"]:
                is_selected = "yes" if each["step"] == selected else ""
                difference = _cells(each["difference"], "{:+.1f}") if each["step"] else ("", "")
                rows.append(
                    _row(
                        (
                            name,
                            str(run["cell"]["seed"]),
                            str(each["step"]),
                            f"{each['rollout_error']:.3f}",
                            *_cells(each["ranking"], "{:.1f}"),
                            *difference,
                            is_selected,
                        )
                    )
                )
    return "\n".join(rows)


def _cells(interval: Sequence[float], form: str) -> tuple[str, str]:
    value, low, high = (form.format(100 * number) for number in interval)
    return f"{value} %", f"{low} to {high} %"


def warnings_table(results: Results) -> str:
    """Return how many runs of each condition printed each warning, by its config key."""
    heads = ("condition", "`init`", "`train --check`", "training")
    rows = [_row(heads), _rule(len(heads))]
    for name in CONDITIONS:
        if not results[name]:
            rows.append(_row((name, NOT_MEASURED, "", "")))
            continue
        cells = [_join(_count(results[name], stage)) for stage in ("init", "check", "train")]
        rows.append(_row((name, *cells)))
    return "\n".join(rows)


def _count(runs: Sequence[Figures], stage: str) -> Iterator[str]:
    topics: dict[str, int] = {}
    for run in runs:
        for topic in dict.fromkeys(map(describe_topic, run[stage])):
            topics[topic] = topics.get(topic, 0) + 1
    for topic, count in topics.items():
        yield topic if count == len(runs) else f"{topic} ({count} of {len(runs)} runs)"


TOPICS = {
    "data.camera": "camera",
    "data.stride": "model step",
    "training.warmup_steps": "warm-up",
    "checkpoint.keep_best": "no validation",
    "validation.": "no validation",
    "the base model is not shown": "base model ranks at chance",
    "shuffled actions": "actions have little effect",
    "at step": "errors rise",
}


def describe_topic(warning: str) -> str:
    """Return what a warning is about."""
    return next((topic for start, topic in TOPICS.items() if warning.startswith(start)), warning)


def _join(cells: Iterator[str]) -> str:
    return ", ".join(cells) or "none"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _rule(count: int) -> str:
    return "|---" * count + "|"
