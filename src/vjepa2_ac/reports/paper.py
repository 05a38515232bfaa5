"""The rows of an evaluation for a paper: all of them as CSV, those of a screen as tables of LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from itertools import groupby
from pathlib import Path

from vjepa2_ac.evaluation.result import Row, RowTable, sections
from vjepa2_ac.storage import write_atomically

_ESCAPED = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


def write_tables(rows: Sequence[Row], stem: Path) -> tuple[Path, Path]:
    """Write the rows beside each other as STEM.csv and STEM.tex; atomically."""
    table, paper = stem.with_suffix(".csv"), stem.with_suffix(".tex")
    write_atomically(table, rows_as_csv(rows))
    write_atomically(paper, rows_as_latex(rows))
    return table, paper


def rows_as_csv(rows: Sequence[Row]) -> str:
    """Return every row with its fields as columns; what there is none of is nan."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [one.name for one in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def rows_as_latex(rows: Sequence[Row]) -> str:
    """Return the rows that are for a screen: a `tabular` (booktabs) for the groups of the same columns."""
    shown = sections([row for row in rows if not row.detail])
    parts = [_tabular(columns, group) for columns, group in groupby(shown, lambda one: one.columns)]
    return "% needs \\usepackage{booktabs}; [low, high] is a 95 % interval over episodes\n" + "\n\n".join(parts) + "\n"


def _tabular(columns: Sequence[str], tables: Iterable[RowTable]) -> str:
    head = _line("", "persistence or chance", *columns)
    lines = [rf"\begin{{tabular}}{{l{'r' * (1 + len(columns))}}}", r"\toprule", head]
    for table in tables:
        title = table.title.translate(_ESCAPED)
        lines += [r"\midrule", rf"\multicolumn{{{2 + len(columns)}}}{{l}}{{{title}}} \\"]
        lines += (r"\quad " + _line(label, chance, *cells) for label, chance, cells in table.lines)
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _line(*cells: str) -> str:
    return " & ".join(cell.translate(_ESCAPED) for cell in cells) + r" \\"
