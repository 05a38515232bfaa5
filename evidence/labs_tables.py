"""Write the tables of the labs study: gains in new labs, and the advice of the tool as a test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from labs import LABS, METHODS, PRETRAINED_PRIOR, TUNING_LABS, get_lab
from results import REACHED_CM, Figures
from tables import insert_table, rate_choices

from vjepa2_ac.evaluation.summary import RANKING
from vjepa2_ac.intervals import estimate_share
from vjepa2_ac.runs.checkpoint import NEWEST, SELECTED, checkpoint_name

GAIN = 0.10  # a gain of the success rate that justifies adapting
BASE, TRAINED = METHODS[0], ("LoRA, rank 4", "LoRA, rank 32", "full fine-tuning")
METRICS = {  # of `evaluate`: the key of a row, and the sign with which lower is better
    "growth of the one-step error with shuffled actions": ("gap_of_actions.shuffled", -1),
    "**action-ranking error**": ("ranking.rank", 1),
    "spread of the energy over actions": ("ranking.spread", -1),
    "rollout error relative to persistence, 0.8 s ahead": ("rollout.l1.over_persistence.3", 1),
}
Results = dict[int, dict[str, Figures]]  # by lab and method
Advice = Callable[[Figures], str]  # result of a trained method -> the checkpoint to use


def _adapt_always(result: Figures) -> str:  # noqa: ARG001 - the interface of an advice
    return NEWEST


def _adapt_never(result: Figures) -> str:  # noqa: ARG001 - the interface of an advice
    return BASE


def _use_selected(result: Figures) -> str:
    return BASE if result["selected"] == checkpoint_name(0) else SELECTED


def _use_selected_if_better(result: Figures) -> str:
    verdicts = result["evaluation"][SELECTED if SELECTED in result["evaluation"] else NEWEST]["verdicts"]
    return _use_selected(result) if verdicts[RANKING]["conclusion"] == "yes" else BASE


ADVICE: dict[str, Advice] = {
    "always adapt": _adapt_always,
    "never adapt": _adapt_never,
    "selected checkpoint (`keep_best`)": _use_selected,
    "selected checkpoint if `evaluate` says better action ranking": _use_selected_if_better,
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
    metrics = f"**With the base model**\n\n{with_base}\n\n**Fine-tuned models only**\n\n{trained}"
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
    """Return for each method in how many labs it gains at least 10 points, with Wilson's interval, and its gains."""
    heads = ("method", "labs with a gain of 10 points", "95 % interval over labs", "median gain", "worst loss")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for method in measured_methods(labs)[1:]:
        gains = [success_rate(methods[method]) - success_rate(methods[BASE]) for methods in labs.values()]
        share = estimate_share(sum(gain >= GAIN - 1e-9 for gain in gains), len(gains))
        interval = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
        median, worst = 100 * np.median(gains), 100 * min(min(gains), 0.0)
        row = (
            method,
            f"{100 * share.value:.0f} % of {len(gains)}",
            interval,
            f"{median:+.0f} points",
            f"{worst:.0f} points",
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
    gains = [success_rate(trained) - success_rate(base) >= GAIN - 1e-9 for base, trained in runs]
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
    return rate_choices(metrics, rates)


def _metric(methods: dict[str, Figures], method: str, key: str, sign: int) -> float:
    """Return a metric of a newest checkpoint, or of the base model; lower is better."""
    is_base = method == BASE
    rows = methods[TRAINED[0] if is_base else method]["evaluation"][NEWEST]["rows"]  # all runs have the same base model
    (value,) = (
        value for name, value in rows.items() if name.endswith(f" {key}") and name.startswith("base ") == is_base
    )
    return sign * float(value)
