"""Write the tables of the labs study: gains in new labs, and the advice of the tool as a test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from labs import DIVERSE, LABS, METHODS, PRETRAINED_PRIOR, TUNING_LABS, get_lab
from results import REACHED_CM, Figures, select_step
from tables import insert_table, rate_choices

from vjepa2_ac.evaluation.summary import PREDICTION, RANKING
from vjepa2_ac.intervals import estimate_share
from vjepa2_ac.runs.checkpoint import NEWEST, SELECTED, checkpoint_name

GAIN = 10.0  # percentage points; a gain of the success rate that justifies adapting
DRAWN = "new camera"  # condition of the labs that were drawn at random; the others were chosen
BASE, TRAINED = METHODS[0], ("LoRA, rank 4", "LoRA, rank 32", "full fine-tuning")
METRICS = {  # of `evaluate`: the key of a row, and the sign with which lower is better
    "growth of the one-step error with shuffled actions": ("gap_of_actions.shuffled", -1),
    "**action-ranking error**": ("ranking.rank", 1),
    "standard deviation of the energy over alternative actions": ("ranking.spread", -1),
    "rollout error relative to persistence, 0.8 s ahead": ("rollout.l1.over_persistence.3", 1),
}
FIXED_ORDER = ("LoRA, rank 32", "full fine-tuning", "LoRA, rank 4", BASE)  # a choice without a measurement
Results = dict[int, dict[str, Figures]]  # by lab and method
Advice = Callable[[Figures], str]  # result of a trained method -> the checkpoint to use


def _adapt_always(result: Figures) -> str:  # noqa: ARG001 - the interface of an advice
    return NEWEST


def _adapt_never(result: Figures) -> str:  # noqa: ARG001 - the interface of an advice
    return BASE


def _use_selected(result: Figures) -> str:
    step = select_step(result["validations"])
    if step is None or checkpoint_name(step) != result["selected"]:
        raise ValueError(f"{result['cell']}: the rule selects step {step}, the measured one is {result['selected']}")
    return SELECTED if step else BASE


def _use_newest_if(name: str) -> Advice:
    def advise(result: Figures) -> str:
        return NEWEST if result["evaluation"][NEWEST]["verdicts"][name]["conclusion"] == "yes" else BASE

    return advise


ADVICE: dict[str, Advice] = {
    "always the newest checkpoint": _adapt_always,
    "always the base model": _adapt_never,
    "the selected checkpoint (`keep_best`)": _use_selected,
    "the newest checkpoint, if `evaluate` reports better action ranking": _use_newest_if(RANKING),
    "the newest checkpoint, if `evaluate` reports better prediction": _use_newest_if(PREDICTION),
}


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write all labs to a file, and two tables between their marks in docs/evidence.md."""
    by_lab: Results = {}
    for result in results:
        by_lab.setdefault(result["cell"]["lab"], {})[result["cell"]["method"]] = result
    needed = set(METHODS) - {PRETRAINED_PRIOR}
    complete = {number: methods for number, methods in sorted(by_lab.items()) if needed <= set(methods)}
    if not complete:
        return
    groups = {
        f"labs 1 to {TUNING_LABS}": {key: value for key, value in complete.items() if key <= TUNING_LABS},
        f"labs {TUNING_LABS + 1} to 12": {key: value for key, value in complete.items() if key > TUNING_LABS},
    }
    advice = "\n\n".join(
        f"**{title[0].upper()}{title[1:]}**\n\n{advice_table(group)}" for title, group in groups.items() if group
    )
    with_base, trained = metrics_table(complete, with_base=True), metrics_table(complete, with_base=False)
    diverse = {number: methods for number, methods in complete.items() if get_lab(number).recipe == DIVERSE}
    metrics = "\n\n".join(
        f"**{title}**\n\n{table}"
        for title, table in (
            ("With the base model", with_base),
            ("Fine-tuned models only", trained),
            (
                "With the base model, without labs with low-diversity demonstrations",
                metrics_table(diverse, with_base=True),
            ),
            ("Fine-tuned models only, without these labs", metrics_table(diverse, with_base=False)),
        )
    )
    status = f"{len(complete)} of {LABS} labs are measured."
    path.write_text("\n\n".join((status, all_labs_table(complete), gains_table(complete), advice, metrics)) + "\n")
    if len(complete) == LABS:
        texts = {
            "labs": all_labs_table(complete),
            "gains": gains_table(complete),
            "advice": advice_table(groups[f"labs {TUNING_LABS + 1} to 12"]),
            "lab metrics": with_base,
            "lab adapters": trained,
        }
        for name, text in texts.items():
            insert_table(docs / "evidence.md", f"{name}, made by `make evidence`", text)


def measured_methods(labs: Results) -> list[str]:
    """Return the methods that were measured in every lab."""
    return [method for method in METHODS if all(method in measured for measured in labs.values())]


def success_rate(result: Figures, checkpoint: str = NEWEST) -> float:
    """Return the success rate of a checkpoint; the selected one may be the newest."""
    ends = result["closed_loop"].get(checkpoint, result["closed_loop"][NEWEST])
    return float(np.mean([end < REACHED_CM for end in ends]))


def all_labs_table(labs: Results) -> str:
    """Return the success rate of every method in every lab."""
    shown = measured_methods(labs)
    rows = [f"| lab | condition | {' | '.join(shown)} |", "|---" * (len(shown) + 2) + "|"]
    for number, methods in labs.items():
        rates = [f"{100 * success_rate(methods[method]):.0f} %" for method in shown]
        rows.append(f"| {number} | {get_lab(number).condition} | {' | '.join(rates)} |")
    return "\n".join(rows)


def gains_table(labs: Results) -> str:
    """Return in how many of the drawn labs each method gains at least 10 points, and its gains in the chosen labs.

    All gains are in percentage points of the success rate. The share has Wilson's interval.
    """
    drawn = [number for number in labs if get_lab(number).condition == DRAWN]
    chosen = sorted(set(labs) - set(drawn), key=lambda number: (get_lab(number).recipe != DIVERSE, number))
    titles = [
        f"lab {number}, {'no shift' if get_lab(number).recipe == DIVERSE else 'low diversity'}" for number in chosen
    ]
    share_head = f"drawn labs with a gain of 10 points, of {len(drawn)}"
    heads = ("method", share_head, "95 % interval of the share", "median gain", "smallest gain", *titles)
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for method in measured_methods(labs)[1:]:
        gains = {
            number: 100 * (success_rate(methods[method]) - success_rate(methods[BASE]))
            for number, methods in labs.items()
        }
        in_drawn = [gains[number] for number in drawn]
        share = estimate_share(sum(gain >= GAIN - 1e-9 for gain in in_drawn), len(in_drawn))
        row = (
            method,
            f"{sum(gain >= GAIN - 1e-9 for gain in in_drawn)}",
            f"{100 * share.low:.0f} to {100 * share.high:.0f} %",
            f"{np.median(in_drawn):+.1f}",
            f"{min(in_drawn):+.0f}",
            *(f"{gains[number]:+.0f}" for number in chosen),
        )
        rows.append(f"| {' | '.join(row)} |")
    return "\n".join(rows)


def advice_table(labs: Results) -> str:
    """Return sensitivity, specificity and regret of each advice, over the trained methods of all labs.

    Sensitivity: of the runs whose newest checkpoint gains at least 10 points, how many are adapted. Specificity: of the
    other runs, how many keep the base model. Regret: the success rate lost compared with the better of the base
    model and the newest checkpoint, on average.
    """
    runs = [(methods[BASE], methods[method]) for methods in labs.values() for method in TRAINED]
    heads = ("advice", "sensitivity", "specificity", "regret", "success rate")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    gains = [100 * (success_rate(trained) - success_rate(base)) >= GAIN - 1e-9 for base, trained in runs]
    for name, advise in ADVICE.items():
        advised = [advise(trained) for _, trained in runs]
        used = [
            success_rate(base) if checkpoint == BASE else success_rate(trained, checkpoint)
            for (base, trained), checkpoint in zip(runs, advised, strict=True)
        ]
        best = [max(success_rate(base), success_rate(trained)) for base, trained in runs]
        adapted = [checkpoint != BASE for checkpoint in advised]
        hits = sum(is_adapted and gained for is_adapted, gained in zip(adapted, gains, strict=True))
        kept = sum(not is_adapted and not gained for is_adapted, gained in zip(adapted, gains, strict=True))
        regret = np.mean(np.maximum(np.subtract(best, used), 0.0))  # the selected checkpoint may be better than both
        row = (
            name,
            f"{hits} of {sum(gains)}",
            f"{kept} of {len(gains) - sum(gains)}",
            f"{100 * regret:.1f} points",
            f"{100 * np.mean(used):.0f} %",
        )
        rows.append(f"| {' | '.join(row)} |")
    return "\n".join(rows)


def metrics_table(labs: Results, *, with_base: bool) -> str:
    """Return how well each metric of `evaluate` selects a model of a lab, of the newest checkpoints and the base model.

    Args:
        labs: The results.
        with_base: Whether the base model is among the models of a choice.
    """
    candidates = (BASE, *TRAINED) if with_base else TRAINED
    rates = [[success_rate(methods[method]) for method in candidates] for methods in labs.values()]
    metrics = {
        title: [[_metric(methods, method, key, sign) for method in candidates] for methods in labs.values()]
        for title, (key, sign) in METRICS.items()
    }
    metrics[f"none: the order {'; '.join(FIXED_ORDER[: len(candidates)])}"] = [
        [float(FIXED_ORDER.index(method)) for method in candidates] for _ in labs
    ]
    return rate_choices(metrics, rates)


def _metric(methods: dict[str, Figures], method: str, key: str, sign: int) -> float:
    """Return a metric of a newest checkpoint, or of the base model; lower is better."""
    is_base = method == BASE
    rows = methods[TRAINED[0] if is_base else method]["evaluation"][NEWEST]["rows"]  # all runs have the same base model
    (value,) = (
        value for name, value in rows.items() if name.endswith(f" {key}") and name.startswith("base ") == is_base
    )
    return sign * float(value)
