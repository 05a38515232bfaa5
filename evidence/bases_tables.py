"""Write the tables of the bases study: results with other base models and encoders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bases import BASES, HELD_OUT, HELD_OUT_ROWS, LABS, METHODS, EncoderKind
from results import REACHED_CM, Figures
from tables import insert_table

from vjepa2_ac.intervals import estimate_share

HEADS = ("rollout error", "action-ranking error", "spread of the energy", "spread of the latents", "PSNR, dB")
Results = dict[tuple[EncoderKind, int], dict[str, list[Figures]]]  # by base model and method


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write the tables of all measured base models, and into docs/evidence.md when all cells are measured."""
    bases: Results = {}
    for result in results:
        cell = result["cell"]
        bases.setdefault((cell["encoder"], cell["seed"]), {}).setdefault(cell["method"], []).append(result)
    needed = {method: 1 if method == HELD_OUT else len(LABS) for method in METHODS}
    complete = {
        base: bases[base]
        for base in BASES
        if base in bases and all(len(bases[base].get(method, ())) == count for method, count in needed.items())
    }
    if not complete:
        return
    texts = {"bases": success_table(complete), "encoders": held_out_table(complete)}
    path.write_text("\n\n".join(texts.values()) + "\n")
    if len(complete) == len(BASES):
        for name, text in texts.items():
            insert_table(docs / "evidence.md", f"{name}, made by `make evidence`", text)


def success_table(bases: Results) -> str:
    """Return the success rate of each method with each base model, pooled over labs."""
    rows = [f"| Encoder | Seed | {' | '.join(METHODS[1:])} |", "|---" * (len(METHODS) + 1) + "|"]
    for (encoder, seed), methods in bases.items():
        rates = []
        for method in METHODS[1:]:
            reached = [end < REACHED_CM for result in methods[method] for end in result["ends_cm"]]
            share = estimate_share(sum(reached), len(reached))
            rates.append(f"{100 * share.value:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f})")
        rows.append(f"| {encoder} | {seed} | {' | '.join(rates)} |")
    return "\n".join(rows)


def held_out_table(bases: Results) -> str:
    """Return the metrics of each base model on held-out scenes of its training data."""
    rows = [f"| Encoder | Seed | {' | '.join(HEADS)} |", "|---" * (len(HEADS) + 2) + "|"]
    for (encoder, seed), methods in bases.items():
        measured = methods[HELD_OUT][0]["rows"]
        values = []
        for key in HELD_OUT_ROWS:
            value = next(
                value
                for name, value in measured.items()
                if name.endswith(f" {key}") and not name.startswith(("persistence ", "decoded truth "))
            )
            as_percent = key in {"rollout.l1.over_persistence.3", "ranking.rank"}
            values.append(f"{100 * value:.1f} %" if as_percent else f"{value:.3g}")
        rows.append(f"| {encoder} | {seed} | {' | '.join(values)} |")
    return "\n".join(rows)
