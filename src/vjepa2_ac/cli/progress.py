"""Console output: progress bars, tables and messages; without a terminal, plain lines instead of bars."""

from __future__ import annotations

import re
import textwrap
import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, Self

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column, Table
from rich.text import Text

from vjepa2_ac.cli.waiting import Work
from vjepa2_ac.errors import printable
from vjepa2_ac.reporter import Reporter

_FIRST_LINE_S, _LINE_EVERY_S = 4.0, 10.0
_WIDE = 120  # columns; at least this width shows a long bar
_CELL_BORDER = 3  # columns between two cells: a border and two spaces
_MAX_UNSPLIT_WORD = 16  # characters; a longer word in a table, such as a path, may be split over lines
_LONGEST_LINE = 100  # columns
_COMMAND = r"(Next: )?(?<![\w/.-])(vjepa2-ac |(\S+ -m )?pip install )((?!   #).)*"
_UNBREAKABLE = re.compile(rf"^ +|`[^`\n]*`|{_COMMAND}|(?<=\d) %", re.MULTILINE)
_SPACE = "\ue000"  # stands for a non-breaking space


def wrap_text(text: str) -> str:
    """Wrap a text to lines of at most 100 columns. A shell command stays on one line, so that it can be copied.

    If a line has columns (separated by two or more spaces), continuation lines are indented to the last column.
    """
    width, lines = min(_LONGEST_LINE, console.width), []
    for line in _UNBREAKABLE.sub(lambda match: match[0].replace(" ", _SPACE), text).split("\n"):
        columns = re.match(r"(.{0,38} {2,})?", line.replace(_SPACE, " "))[0]  # type: ignore[index]  # always matches
        indent = " " * (len(columns) if columns.strip() else len(columns) + 2)
        style = textwrap.TextWrapper(width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
        first, *more = style.wrap(line) if len(line) > width else [line]
        # A word that is longer than the last column, such as a path, stays on the line of the other columns.
        if more and first.replace(_SPACE, " ") == columns.rstrip():
            first, more = f"{columns}{more[0].lstrip()}", more[1:]
        lines += [first, *more]
    return "\n".join(lines).replace(_SPACE, " ")


class PlainConsole(Console):
    """A rich console that prints strings literally: brackets, colons and control characters in names have no effect.

    To print coloured text, pass a `rich.text.Text`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, soft_wrap=True, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a line, cell or title as literal text, with control characters escaped."""
        return super().render_str(printable(text), **options)


class MetricsTable(Table):
    """A table that does not truncate numbers and words: in a narrow terminal, cells are wrapped at spaces.

    A long cell does not make the other columns narrower than their words.

    Args:
        title: Printed above the table.
        columns: Column names.
        labelled: Whether the first column contains labels, which are left-aligned. Numbers are right-aligned.
    """

    def __init__(self, title: str, columns: Sequence[str], *, labelled: bool = True) -> None:
        super().__init__(title=title, title_justify="left", caption_justify="left")
        for index, name in enumerate(columns):
            self.add_column(name, justify="left" if labelled and index == 0 else "right", overflow="fold")

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Any]:
        """Render the table. The widest columns are narrowed first, at least to their longest unsplit word."""
        texts = [[str(text) for text in (column.header, *column.cells)] for column in self.columns]
        words = [[cell_len(word) for text in column_texts for word in text.split()] for column_texts in texts]
        min_widths = [max((size for size in sizes if size <= _MAX_UNSPLIT_WORD), default=1) for sizes in words]
        widths = [max(map(cell_len, column_texts), default=1) for column_texts in texts]
        available = options.max_width - len(widths) * _CELL_BORDER - 1
        while sum(widths) > available and (reducible := [n for n, width in enumerate(widths) if width > min_widths[n]]):
            widths[max(reducible, key=lambda n: widths[n])] -= 1
        for column, width in zip(self.columns, widths, strict=True):
            column.width = width
        yield from super().__rich_console__(console, options)


console = PlainConsole()
if not console.is_terminal:
    console.width = 120  # a log file is not limited to 80 columns


def show(*parts: str | Table, files: Iterable[str | Path] = ()) -> None:
    """Print texts and tables, then one line for each written file."""
    for part in (*(wrap_text(item) if isinstance(item, str) else item for item in parts), *(f"  {f}" for f in files)):
        console.print(part)


class ProgressBar:
    """Progress display of a task: a bar with a short text in a terminal, otherwise a line every few seconds.

    It appears at the first call, so a task that finishes immediately shows nothing.
    """

    def __init__(self, title: str, unit: str = "") -> None:
        self.title, self._unit, self._total = printable(title), unit, -1
        self._first, self._began, self._next_line = 0, 0.0, 0.0
        self._bar: Progress | None = None

    def __call__(self, done: int, total: int, words: str = "") -> None:
        """Show that `done` of `total` units are done; a different `total` starts a new bar."""
        if total != self._total:
            self._open(done, total)
        now = time.monotonic()
        if self._unit and done:
            speed = done / max(now - self._began, 1e-9)
            words = f"{speed:{'.2g' if speed < 1 else '.1f' if speed < 100 else '.0f'}} {self._unit}/s"
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=done, words=printable(words), left=self._left(done, now))
        elif not console.is_terminal and (done == total or now >= self._next_line):
            self._next_line = now + _LINE_EVERY_S
            Work.lines += 1
            console.print("  ".join(filter(None, (f"{self.title} {done}/{total}", words, self._left(done, now)))))
        if done >= total:
            self.close()
            Work.begin(f"finishing {self.title}")

    def close(self) -> None:
        """Remove the bar and restore the terminal."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _open(self, done: int, total: int) -> None:
        self.close()
        self._first, self._total = done, total
        self._began = time.monotonic()
        self._next_line = self._began + _FIRST_LINE_S
        if not console.is_terminal:
            return
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=40 if console.width >= _WIDE else 6, table_column=Column(no_wrap=True)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[left]}", markup=False, table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[words]}", markup=False, table_column=Column()),  # wraps if it does not fit
            console=console,
        )
        self._bar.add_task(self.title, total=total, completed=done, words="", left="")
        self._bar.start()

    def _left(self, done: int, now: float) -> str:
        """Return the estimated time left as text, from the average speed so far; empty if unknown."""
        advanced, remaining = done - self._first, self._total - done
        if advanced <= 0 or remaining <= 0:
            return ""
        return f"{timedelta(seconds=round((now - self._began) / advanced * remaining))} left"


class ConsoleReporter(Reporter):
    """Prints messages, and shows one task at a time as a bar. Leaving its `with` block restores the terminal."""

    def __init__(self) -> None:
        self._bar = ProgressBar("")

    def note(self, text: str) -> None:
        """Print a message."""
        console.print(wrap_text(text))

    def task(self, title: str, unit: str = "") -> ProgressBar:
        """Start a task, which ends the previous one, and return its progress bar."""
        self._bar.close()
        self._bar = ProgressBar(title, unit)
        Work.begin(title)
        return self._bar

    def __enter__(self) -> Self:
        """Return this reporter."""
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the terminal."""
        self._bar.close()
