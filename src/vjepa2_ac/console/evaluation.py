"""Console output of an evaluation and of a comparison: tables of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable
from vjepa2_ac.evaluation.result import Row, sections


def row_tables(rows: Sequence[Row], title: str) -> list[Table]:
    """Return the rows that are for a screen; groups of the same columns share a table."""
    tables: list[Table] = []
    has_intervals = any(row.estimate.has_interval for row in rows)
    sure = "95 % interval over episodes" if has_intervals else "one episode: no interval"
    for columns, group in groupby(sections([row for row in rows if not row.detail]), lambda one: one.columns):
        shared = list(group)
        with_chance = any(chance for section in shared for _, chance, _ in section.lines)
        head = ["", *(["by nothing or chance"] if with_chance else []), *columns]
        table = MetricsTable("" if tables else f"{title} ({sure})", head)
        for section in shared:
            table.add_section()
            table.add_row(section.title)
            for label, chance, cells in section.lines:
                table.add_row(f"  {label}", *([chance] if with_chance else []), *cells)
        tables.append(table)
    return tables
