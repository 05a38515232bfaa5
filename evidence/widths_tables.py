"""Write the table of the widths study: success and error against rank, for predictors of three widths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from results import REACHED_CM, Figures
from tables import insert_table
from widths import BASE, FULL, LABS, METHODS, WIDTHS

from vjepa2_ac.intervals import estimate_share

ERROR, RANKING = "rollout.l1.over_persistence.3", "ranking.rank"
Results = dict[tuple[int, str], list[Figures]]  # by width and method, in the order of the labs


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write the table to a file, and between its marks in docs/evidence.md when all cells are measured."""
    cells: Results = {}
    for result in sorted(results, key=lambda each: each["cell"]["lab"]):
        cells.setdefault((result["cell"]["width"], result["cell"]["method"]), []).append(result)
    widths = [width for width in WIDTHS if all(len(cells.get((width, method), ())) == len(LABS) for method in METHODS)]
    if not widths:
        return
    text = rank_table(cells, widths)
    path.write_text(text + "\n")
    if len(widths) == len(WIDTHS):
        insert_table(docs / "evidence.md", "widths, made by `make evidence`", text)


def rank_table(cells: Results, widths: Sequence[int]) -> str:
    """Return success rates, and which part of the improvement of full fine-tuning each rank gives."""
    heads = [f"width {width}: {name}" for width in widths for name in ("success", "rollout error", "ranking error")]
    rows = [f"| Method | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for method in METHODS:
        values = []
        for width in widths:
            results = cells[width, method]
            reached = [end < REACHED_CM for result in results for end in result["ends_cm"]]
            share = estimate_share(sum(reached), len(reached))
            values.append(f"{100 * share.value:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f})")
            values.append(_gain(cells, width, method, ERROR))
            values.append(_gain(cells, width, method, RANKING))
        rows.append(f"| {method} | {' | '.join(values)} |")
    return "\n".join(rows)


def _gain(cells: Results, width: int, method: str, key: str) -> str:
    """Return the mean of an error over labs, and the part of the improvement of full fine-tuning."""
    full = cells[width, FULL]
    base_values = np.array([_value(result, key, of_base=True) for result in full])
    if method == BASE:
        return f"{100 * base_values.mean():.1f} %"
    values = np.array([_value(result, key) for result in cells[width, method]])
    best = np.array([_value(result, key) for result in full])
    part = (base_values - values).sum() / (base_values - best).sum()
    return f"{100 * values.mean():.1f} % ({100 * part:.0f} % of full)"


def _value(result: Figures, key: str, *, of_base: bool = False) -> float:
    """Return a value of the fine-tuned model, or of its base model."""
    (value,) = (
        value
        for name, value in result["rows"].items()
        if name.endswith(f" {key}") and name.startswith("base ") == of_base
    )
    return float(value)
