"""The reporter: what long work tells its user, as messages and as the progress of one task after another."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from vjepa2_ac.episode import Progress, no_progress

INDEXING = "looking through the data set"  # a task of many


@runtime_checkable
class Reporter(Protocol):
    """Shows messages and progress."""

    def note(self, text: str) -> None:
        """Show a message."""
        ...

    def task(self, title: str, unit: str = "") -> Progress:
        """Begin another task, which ends the one before; return the function that receives its progress.

        Args:
            title: What is done.
            unit: Of the total; it is then shown how many are done per second.
        """
        ...


class NullReporter:
    """Shows nothing; for a training run, too (`training.monitoring`)."""

    def note(self, text: str) -> None:
        """Show nothing."""

    def task(self, title: str, unit: str = "") -> Progress:  # noqa: ARG002
        """Return a function that shows nothing."""
        return no_progress

    def started(self, done: int, total: int) -> None:
        """Show nothing."""

    def stepped(self, step: int, metrics: Any) -> None:
        """Show nothing."""

    def validated(self, step: int, found: Any) -> None:
        """Show nothing."""


SILENT = NullReporter()
