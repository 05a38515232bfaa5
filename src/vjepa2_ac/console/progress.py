"""Console output of a run: progress, tables and numbers; plain lines where there is no terminal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Column, Table
from rich.text import Text

from vjepa2_ac.errors import printable

_WIDE = 120  # columns that leave room for a long bar
_BESIDE_A_CELL = 3  # a line and two spaces
_WHOLE = 16  # characters: a longer word of a table, such as a path, may be divided


class PlainConsole(Console):
    """Shows every text literally: brackets, colons or control characters of a name or path have no meaning.

    Coloured text is a `rich.text.Text`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, soft_wrap=True, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the literal form of a text: of a line, a cell, a title."""
        return super().render_str(printable(text), **options)


class MetricsTable(Table):
    """A table that does not cut numbers and words: if the terminal is narrow, cells are wrapped at their spaces.

    A cell may not squeeze the others, however long it is.
    """

    def __init__(self, title: str) -> None:
        super().__init__(title=title, title_justify="left", caption_justify="left")

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Any]:
        """Yield what is shown."""
        room = options.max_width - len(self.columns) * _BESIDE_A_CELL - 1
        for column, width in zip(self.columns, self._widths(room), strict=True):
            column.width, column.overflow = width, "fold"
        yield from super().__rich_console__(console, options)

    def _widths(self, room: int) -> list[int]:
        """Return the widths of columns: as requested, or else the widest are reduced, down to whole words."""
        texts = [[str(text) for text in (column.header, *column.cells)] for column in self.columns]
        widths = [max(map(cell_len, of_column), default=1) for of_column in texts]
        words = [[cell_len(word) for text in of_column for word in text.split()] for of_column in texts]
        least = [max((size for size in sizes if size <= _WHOLE), default=1) for sizes in words]
        while sum(widths) > room and (shrinking := [n for n, width in enumerate(widths) if width > least[n]]):
            widths[max(shrinking, key=lambda n: widths[n])] -= 1
        return widths


class _Words(TextColumn):
    """A column of a progress bar, of literal text."""

    def __init__(self, text_format: str, table_column: Column | None = None) -> None:
        super().__init__(text_format, markup=False, table_column=table_column)

    def render(self, task: Task) -> Text:
        """Return the text of a task."""
        return Text(printable(self.text_format.format(task=task)))


console = PlainConsole()
if not console.is_terminal:
    console.width = 120  # a log file has room


class ProgressBar:
    """A progress bar with a short text in a terminal; a line every few seconds elsewhere."""

    def __init__(self, title: str, total: int, done: int = 0, line_every_s: float = 10.0) -> None:
        self._title, self._total, self._done, self._line_every_s = title, total, done, line_every_s
        self._first, self._began = done, time.monotonic()
        self._last_line = self._began
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        if console.is_terminal:
            self._bar = Progress(
                _Words("{task.description}"),
                BarColumn(bar_width=40 if console.width >= _WIDE else 6, table_column=Column(no_wrap=True)),
                MofNCompleteColumn(table_column=Column(no_wrap=True)),
                TimeRemainingColumn(table_column=Column(no_wrap=True)),
                _Words("{task.fields[words]}", table_column=Column()),  # wraps if it does not fit
                console=console,
            )
            self._task = self._bar.add_task(title, total=total, completed=done, words="")
            self._bar.start()

    def advance_to(self, done: int, words: str = "") -> None:
        """Show that `done` of the total are done."""
        self._done = done
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, words=words)
        elif done == self._total or time.monotonic() - self._last_line >= self._line_every_s:
            self._last_line = time.monotonic()
            console.print(f"{self._title} {done}/{self._total}  {words}{self._left()}")
        if done >= self._total:
            self.close()

    def close(self) -> None:
        """Restore the terminal."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _left(self) -> str:
        """Return as text the time left at the average speed so far."""
        advanced, remaining = self._done - self._first, self._total - self._done
        if advanced <= 0 or remaining <= 0:
            return ""
        seconds = (time.monotonic() - self._began) / advanced * remaining
        return f"  {timedelta(seconds=round(seconds))} left"


class LateProgress:
    """A progress bar whose total is known when the work begins; none is shown if there is nothing to do."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: ProgressBar | None = None
        self._total = -1

    def __call__(self, done: int, total: int) -> None:
        """Show that `done` of `total` are done; another total begins another bar."""
        if total != self._total:
            self.close()
            self._bar, self._total = ProgressBar(self._title, total), total
        if self._bar is not None:
            self._bar.advance_to(done)

    def close(self) -> None:
        """Restore the terminal."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class EncodingBar:
    """A progress bar of encoded frames, with their number per second; begins at the first call."""

    def __init__(self) -> None:
        self._bar: ProgressBar | None = None
        self._began = 0.0

    def __call__(self, done: int, total: int) -> None:
        """Show that `done` of `total` are done."""
        if self._bar is None:
            self._bar, self._began = ProgressBar("encoding frames", total), time.monotonic()
        speed = done / max(time.monotonic() - self._began, 1e-9)
        self._bar.advance_to(done, f"{speed:.{1 if speed < 100 else 0}f} frames/s" if done else "")

    def close(self) -> None:
        """Restore the terminal."""
        if self._bar is not None:
            self._bar.close()


class DownloadProgress:
    """Shows the progress of a download."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._bar: ProgressBar | None = None

    def __call__(self, done: int, whole: int | None) -> None:
        """Show that `done` of `whole` bytes are downloaded; in megabytes."""
        if self._bar is None:
            self._bar = ProgressBar(f"{self._name} (MB)", (whole or 0) // 10**6)
        self._bar.advance_to(done // 10**6)
