"""Write the tables of the labs study: gains in new labs, and the advice of the tool as a test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from labs import LABS, METHODS, TUNING_LABS, get_lab
from results import REACHED_CM, Figures
from tables import insert_table

from vjepa2_ac.evaluation.summary import RANKING
from vjepa2_ac.intervals import estimate_share
from vjepa2_ac.runs.checkpoint import NEWEST, SELECTED, checkpoint_name

GAIN = 0.10  # a gain of the success rate that justifies adapting
BASE, TRAINED = METHODS[0], ("LoRA, rank 4", "LoRA, rank 32", "full fine-tuning")
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
    complete = {number: methods for number, methods in sorted(by_lab.items()) if methods.keys() >= set(METHODS)}
    if not complete:
        return
    groups = {
        f"labs 1 to {TUNING_LABS}": {key: value for key, value in complete.items() if key <= TUNING_LABS},
        f"labs {TUNING_LABS + 1} to 12": {key: value for key, value in complete.items() if key > TUNING_LABS},
    }
    advice = "\n\n".join(
        f"**{title[0].upper()}{title[1:]}**\n\n{advice_table(group)}" for title, group in groups.items() if group
    )
    status = f"{len(complete)} of {LABS} labs are measured."
    path.write_text("\n\n".join((status, all_labs_table(complete), gains_table(complete), advice)) + "\n")
    if len(complete) == LABS:
        insert_table(docs / "evidence.md", "labs, made by `make evidence`", gains_table(complete))
        insert_table(docs / "evidence.md", "advice, made by `make evidence`", advice_table(groups["labs 7 to 12"]))


def success_rate(result: Figures, checkpoint: str = NEWEST) -> float:
    """Return the success rate of a checkpoint; the selected one may be the newest."""
    ends = result["closed_loop"].get(checkpoint, result["closed_loop"][NEWEST])
    return float(np.mean([end < REACHED_CM for end in ends]))


def all_labs_table(labs: Results) -> str:
    """Return the success rate of every method in every lab."""
    rows = [f"| lab | condition | {' | '.join(METHODS)} |", "|---" * (len(METHODS) + 2) + "|"]
    for number, methods in labs.items():
        rates = [f"{100 * success_rate(methods[method]):.0f} %" for method in METHODS]
        rows.append(f"| {number} | {get_lab(number).condition} | {' | '.join(rates)} |")
    return "\n".join(rows)


def gains_table(labs: Results) -> str:
    """Return for each method in how many labs it gains at least 10 points, with Wilson's interval, and its gains."""
    heads = ("method", "labs with a gain of 10 points", "95 % interval over labs", "median gain", "worst loss")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for method in METHODS[1:]:
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
