"""The reporter: what long work tells its user, as messages and as the progress of one task after another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vjepa2_ac.episode import Progress

INDEXING, LOADING = "looking through the data set", "loading the model"  # tasks of many


class Reporter:
    """Shows nothing; others show what they like of it. In a run it is silent in all processes but the first."""

    def note(self, text: str) -> None:
        """Show a message."""

    def task(self, title: str, unit: str = "") -> Progress:  # noqa: ARG002
        """Begin another task, which ends the one before; return the function that receives its progress.

        Args:
            title: What is done.
            unit: Of the total; it is then shown how many are done per second.
        """
        return lambda _done, _total: None

    def started(self, done: int, total: int) -> None:
        """A training loop begins after `done` of `total` optimizer steps."""

    def stepped(self, step: int, metrics: dict[str, float]) -> None:
        """An optimizer step is done."""

    def validated(self, step: int, found: Any) -> None:
        """Held-out clips were measured after `step` optimizer steps."""


SILENT = Reporter()
